"""How equivariant each layer of a network is: error and negative control side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from i2i.testing.measured import Measurement
from i2i.viz.style import BLUE, GRAY, INK, SKY, VERMILION, new_figure, plain_axes

FLOOR = 1e-8
"""Where the axis begins: an error of zero has no logarithm."""


_CAPTION = (
    "error: of the layer alone, largest over the elements; image turned: at this layer when the "
    "image is turned; control: the output turned by another element; tolerance {:g}. "
    "In brackets: not claimed."
)


def equivariance_figure(
    rows: Sequence[Measurement], *, tolerance: float, heading: str = ""
) -> Figure:
    """A group of bars for each layer on a logarithmic scale.

    Dark: the layer alone, the largest error over the elements. Light: the same with the image
    turned. Gray: the smallest control. The line is the tolerance.

    Args:
        rows: Measurements in the order of the network.
        tolerance: Largest relative error that counts as exact.
        heading: Text above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: If there is nothing to draw.
    """
    if not rows:
        raise ValueError("no measurements to draw")
    figure = new_figure(8.0, 1.4 + 0.36 * len(rows))
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    axes = figure.add_subplot()
    plain_axes(axes)
    axes.grid(visible=False, axis="y")
    places = np.arange(len(rows))
    from_image = [np.nan if row.max_from_image is None else row.max_from_image for row in rows]
    _bars(axes, places - 0.27, [row.max_error for row in rows], BLUE, "error of the layer alone")
    _bars(axes, places, from_image, SKY, "error with the image turned")
    _bars(axes, places + 0.27, [row.min_control for row in rows], GRAY, "control: a wrong turn")
    axes.axvline(tolerance, color=VERMILION, linewidth=1, label=f"tolerance {tolerance:g}")
    axes.set_xscale("log")
    axes.set_xlim(FLOOR, 4.0)
    axes.set_yticks(places, [f"{row.layer}  ({row.group})" for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("relative error, largest over the elements")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def equivariance_table(rows: Sequence[Measurement], *, tolerance: float) -> Table:
    """The same for the terminal: one line for each layer and group."""
    made = Table(caption=_CAPTION.format(tolerance))
    for name in ("layer", "claim", "group"):
        made.add_column(name, no_wrap=name == "layer")
    for name in ("error", "image turned", "control"):
        made.add_column(name, justify="right")
    made.add_column("verdict")
    colors = {"exact": "green", "approximate": "yellow", "none": "red", "undecided": "magenta"}
    for row in rows:
        verdict = row.verdict(tolerance)
        made.add_row(
            row.layer,
            row.claim if row.claimed else f"({row.claim})",
            row.group,
            f"{row.max_error:.1e}",
            "" if row.max_from_image is None else f"{row.max_from_image:.1e}",
            f"{row.min_control:.1e}",
            f"[{colors[verdict]}]{verdict}",
        )
    return made


def _bars(axes: Axes, places: np.ndarray, values: Sequence[float], color: str, label: str) -> None:
    known = np.array(values, dtype=np.float64)
    widths = np.where(np.isfinite(known), np.maximum(known, 1.15 * FLOOR), FLOOR)
    axes.barh(places, widths - FLOOR, left=FLOOR, height=0.26, color=color, label=label)
