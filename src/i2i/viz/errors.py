"""How rotation errors are distributed: histogram and recall curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from i2i.viz.style import CYCLE, GRAY, INK, ImageArray, new_figure, plain_axes, to_numpy

_BIN_DEG = 5.0


def error_figure(error_deg: ImageArray | Mapping[str, ImageArray], *, heading: str = "") -> Figure:
    """Histogram of rotation errors beside the recall curve.

    Args:
        error_deg: Errors in degrees, shape (N,), or several such arrays by name (runs, classes).
        heading: Text above the figure.

    Returns:
        The figure. The dashed line is what random guessing gives: density (1 − cos θ)/π and
        distribution (θ − sin θ)/π of the angle between two uniform rotations.

    Raises:
        ValueError: if there are no finite errors.
    """
    named = error_deg if isinstance(error_deg, Mapping) else {"": error_deg}
    series = {name: _finite(values, name=name) for name, values in named.items()}
    # The curves of several methods fill the axes, so their names go below.
    below = 0.0 if len(series) == 1 else 0.2 * (len(series) + 1)
    figure = new_figure(9.0, 3.4 + below)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    histogram, recall = figure.subplots(1, 2)
    _draw_histogram(histogram, series)
    _draw_recall(recall, series)
    return figure


def recall_at(error_deg: ImageArray, thresholds_deg: Sequence[float]) -> np.ndarray:
    """Share of errors that are at most each threshold.

    Example:
        >>> recall_at(np.array([5.0, 20.0]), [15.0, 30.0]).tolist()
        [0.5, 1.0]
    """
    ordered = np.sort(to_numpy(error_deg))
    return np.searchsorted(ordered, np.asarray(thresholds_deg), side="right") / len(ordered)


def _finite(values: ImageArray, *, name: str) -> np.ndarray:
    """Finite errors of one series as float64."""
    array = to_numpy(values).astype(np.float64).ravel()
    array = array[np.isfinite(array)]
    if array.size == 0:
        raise ValueError(f"No finite errors to draw{f' for {name!r}' if name else ''}.")
    return array


def _draw_histogram(axes: Axes, series: Mapping[str, np.ndarray]) -> None:
    edges = np.arange(0.0, 180.0 + _BIN_DEG, _BIN_DEG)
    single = len(series) == 1
    for color, (name, values) in zip(_cycle(len(series)), series.items(), strict=True):
        share = np.histogram(values, bins=edges)[0] / len(values) * 100.0
        median = np.quantile(values, 0.5)
        axes.stairs(share, edges, fill=single, color=color, alpha=0.75 if single else 1.0)
        axes.axvline(
            median,
            color=color if not single else INK,
            linewidth=1.2,
            label=f"{name + ': ' if name else ''}median {median:.1f}°",
        )
    theta = np.radians(edges)
    chance = np.diff((theta - np.sin(theta)) / np.pi) * 100.0
    axes.stairs(chance, edges, color=GRAY, linestyle="--", label="random guess")
    axes.set(
        xlabel="rotation error (degrees)", ylabel=f"share per {_BIN_DEG:g}° (%)", xlim=(0, 180)
    )
    _finish(axes, legend="upper right" if single else "below")


def _draw_recall(axes: Axes, series: Mapping[str, np.ndarray]) -> None:
    thresholds = np.linspace(0.0, 180.0, 721)
    for color, (name, values) in zip(_cycle(len(series)), series.items(), strict=True):
        within = recall_at(values, [15.0, 30.0]) * 100.0
        axes.plot(
            thresholds,
            recall_at(values, thresholds.tolist()) * 100.0,
            color=color,
            label=f"{name + ': ' if name else ''}{within[0]:.0f} % ≤ 15°, {within[1]:.0f} % ≤ 30°",
        )
    theta = np.radians(thresholds)
    axes.plot(
        thresholds,
        (theta - np.sin(theta)) / np.pi * 100.0,
        color=GRAY,
        linestyle="--",
        label="random guess",
    )
    for threshold in (15.0, 30.0):
        axes.axvline(threshold, color="0.8", linewidth=0.8, zorder=0)
    axes.set(
        xlabel="threshold (degrees)",
        ylabel="share with error ≤ threshold (%)",
        xlim=(0, 180),
        ylim=(0, 101),
    )
    axes.set_xticks([0, 15, 30, 60, 90, 120, 150, 180])
    _finish(axes, legend="lower right" if len(series) == 1 else "below")


def _cycle(count: int) -> list[str]:
    return [CYCLE[index % len(CYCLE)] for index in range(count)]


def _finish(axes: Axes, *, legend: Literal["upper right", "lower right", "below"]) -> None:
    plain_axes(axes)
    axes.xaxis.set_tick_params(labelsize=8)
    axes.yaxis.set_tick_params(labelsize=8)
    if legend == "below":
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), fontsize=8, frameon=False)
    else:
        axes.legend(loc=legend, fontsize=8, edgecolor="none", framealpha=0.85)
