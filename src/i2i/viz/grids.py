"""Grids of pictures: input beside the mesh re-rendered in the predicted and true orientation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from i2i.viz.style import INK, ImageArray, error_color, new_figure, show_image

_PER_BAND = 8


def prediction_grid(
    images: ImageArray,
    *,
    predicted: ImageArray | None = None,
    true: ImageArray | None = None,
    error_deg: ImageArray | None = None,
    titles: Sequence[str] | None = None,
    heading: str = "",
) -> Figure:
    """Inputs in one row, below them the re-rendered predictions and truths, one column a sample.

    Args:
        images: Inputs, shape (N, C, H, W), in [0, 1].
        predicted: Meshes rendered in the predicted orientations, same shape; left out if None.
        true: Meshes rendered in the true orientations, same shape; left out if None.
        error_deg: Angle between prediction and truth in degrees, shape (N,); the column's title.
        titles: Text above each column, before the error.
        heading: Text above the whole figure.

    Returns:
        The figure; more than eight samples continue in a further band below.
    """
    rows = [
        (label, pictures)
        for label, pictures in (("input", images), ("predicted", predicted), ("true", true))
        if pictures is not None
    ]
    count = len(images)
    if count == 0:
        raise ValueError("prediction_grid got no images; give at least one.")
    columns = min(count, _PER_BAND)
    bands = -(-count // columns)
    figure = new_figure(
        0.5 + 1.35 * columns, (0.3 if heading else 0.0) + bands * (0.35 + 1.35 * len(rows))
    )
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    grid = figure.subplots(bands * len(rows), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for sample in range(count):
        band, column = divmod(sample, columns)
        for row, (label, pictures) in enumerate(rows):
            axes = grid[band * len(rows) + row, column]
            axes.set_axis_on()
            show_image(axes, pictures[sample])
            if column == 0:
                axes.set_ylabel(label, fontsize=9)
            if row == 0:
                _column_title(axes, sample, titles=titles, error_deg=error_deg)
    return figure


def _column_title(
    axes: object, sample: int, *, titles: Sequence[str] | None, error_deg: ImageArray | None
) -> None:
    """Title of one sample's column: its name, and the error in degrees."""
    parts = [titles[sample]] if titles is not None else []
    color = INK
    if error_deg is not None:
        error = float(error_deg[sample])
        parts.append(f"{error:.1f}°" if np.isfinite(error) else "not finite")
        color = error_color(error)
    axes.set_title("\n".join(parts), fontsize=9, color=color)  # type: ignore[attr-defined]


def class_grid(
    images: ImageArray,
    *,
    predicted: Sequence[str],
    true: Sequence[str] | None = None,
    heading: str = "",
) -> Figure:
    """Inputs with the predicted class above each, and the true one where it differs.

    Args:
        images: Inputs, shape (N, C, H, W), in [0, 1].
        predicted: Predicted class names.
        true: True class names.
        heading: Text above the whole figure.
    """
    count = len(images)
    columns = min(count, _PER_BAND)
    bands = -(-count // columns)
    figure = new_figure(0.3 + 1.5 * columns, 0.3 + 1.9 * bands)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    grid = figure.subplots(bands, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for sample, axes in zip(range(count), grid.flat, strict=False):
        axes.set_axis_on()
        title, color = predicted[sample], INK
        if true is not None:
            right = predicted[sample] == true[sample]
            color = error_color(0.0 if right else 180.0)
            title = title if right else f"{title}\n(is {true[sample]})"
        show_image(axes, images[sample], title=title, color=color)
    return figure
