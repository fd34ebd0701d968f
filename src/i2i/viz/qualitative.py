"""Methods side by side on the same images: each one's prediction, re-rendered."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure

from i2i.data.info import DataInfo
from i2i.geometry.rotations import geodesic_angle_rad
from i2i.rendering.mesh import RenderMesh
from i2i.viz.rerender import rerender_each
from i2i.viz.style import INK, ImageArray, error_color, new_figure, show_image, to_numpy

_TRUTH = "truth,\nre-rendered"
_SIDE = 1.3  # inches
_LETTERS_PER_INCH = 13


def qualitative_grid(
    images: ImageArray,
    methods: Mapping[str, ImageArray],
    true: ImageArray,
    *,
    info: DataInfo,
    meshes: RenderMesh | Sequence[RenderMesh | None] | None,
    error_deg: Mapping[str, ImageArray] | None = None,
    titles: Sequence[str] | None = None,
    heading: str = "",
    renderer: str = "embree",
) -> Figure:
    """Images in the rows; input, truth and each method's prediction re-rendered in the columns.

    The layout of the paper's last figure, turned by a quarter.

    Args:
        images: Inputs, shape (N, C, H, W), in [0, 1].
        methods: Predicted object → camera rotations by name, each (N, 3, 3).
        true: True ones, shape (N, 3, 3).
        info: Modality and camera to render with.
        meshes: What to render: one mesh, or one for each image; blank pictures where there is none.
        error_deg: Error of each prediction in degrees by method, each (N,); the angle between
            prediction and truth if None, which knows of no symmetry.
        titles: Text beside each row, such as the class.
        heading: Text above the figure.
        renderer: Name of the renderer; the default one needs no system library.

    Returns:
        The figure.

    Raises:
        ValueError: if there are no images, no methods, or not one rotation for each image.
    """
    count = len(images)
    if count == 0 or not methods:
        raise ValueError(
            f"qualitative_grid got {count} images and {len(methods)} methods; give at least one."
        )
    for name, rotations in {"the truth": true, **methods}.items():
        if tuple(rotations.shape) != (count, 3, 3):
            raise ValueError(
                f"{name} has rotations of shape {tuple(rotations.shape)} for {count} images; give "
                f"({count}, 3, 3)."
            )
    each = list(meshes) if isinstance(meshes, Sequence) else [meshes] * count
    if error_deg is None:
        error_deg = {name: _angles_deg(rotations, true) for name, rotations in methods.items()}
    columns = {"input": images} | {
        name: rerender_each(each, rotations, info=info, renderer=renderer)
        for name, rotations in {_TRUTH: true, **methods}.items()
    }
    width = _SIDE * len(columns) + 0.4
    lines = textwrap.wrap(heading, int(width * _LETTERS_PER_INCH))
    figure = new_figure(width, (_SIDE + 0.2) * count + 0.3 + 0.2 * len(lines))
    if lines:
        figure.suptitle("\n".join(lines), fontsize=10, color=INK)
    grid = figure.subplots(count, len(columns), squeeze=False)
    for column, (name, pictures) in enumerate(columns.items()):
        grid[0, column].set_title(name, fontsize=9, color=INK)
        for row in range(count):
            show_image(grid[row, column], pictures[row])
            if name in methods:
                error = float(error_deg[name][row])
                text = f"{error:.1f}°" if np.isfinite(error) else "not finite"
                grid[row, column].set_xlabel(
                    text, fontsize=8.5, labelpad=2, color=error_color(error)
                )
    for row, title in enumerate(titles or []):
        grid[row, 0].set_ylabel(title, fontsize=8.5)
    return figure


def _angles_deg(predicted: ImageArray, true: ImageArray) -> np.ndarray:
    """Angles between rotations, (N,) in degrees."""
    pair = (torch.as_tensor(to_numpy(r), dtype=torch.float64) for r in (predicted, true))
    return torch.rad2deg(geodesic_angle_rad(*pair)).numpy()
