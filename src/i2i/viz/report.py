"""The figures of a report: methods as bars with their intervals, and recall curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from i2i.viz.errors import recall_at
from i2i.viz.style import CYCLE, GRAY, INK, ImageArray, new_figure, plain_axes

_COLUMNS = 4  # panels beside each other, at most
_LINES = ("-", "--", ":")


@dataclass(frozen=True)
class Bar:
    """A method in a bar chart.

    Attributes:
        name: What it is called.
        value: Length of the bar; None: there is none.
        low: Lower end of the interval; None: none is drawn.
        high: Upper end.
        paper: A published number to mark beside the bar.
    """

    name: str
    value: float | None = None
    low: float | None = None
    high: float | None = None
    paper: float | None = None


def bar_figure(panels: Mapping[str, Sequence[Bar]], *, unit: str, heading: str = "") -> Figure:
    """Horizontal bars of methods, a panel for each class, number of views or metric.

    Args:
        panels: The bars of each panel, the same methods in the same order.
        unit: What the bars measure, for the axis.
        heading: Text above the figure.

    Raises:
        ValueError: if there are no panels.
    """
    first = next(iter(panels.values()), ())
    figure, axes = _panels(len(panels), height=1.1 + 0.34 * len(first), heading=heading)
    marked = any(bar.paper is not None for bars in panels.values() for bar in bars)
    for index, (place, (title, bars)) in enumerate(zip(axes, panels.items(), strict=True)):
        _draw_bars(place, bars)
        place.set_title(title, fontsize=10, color=INK)
        place.set_xlabel(unit, fontsize=8)
        place.tick_params(labelsize=8)
        if index % _COLUMNS:
            place.set_yticklabels([])
    if marked:
        mark = Line2D(
            [], [], color=INK, marker="D", markersize=4.5, markerfacecolor="white",
            linestyle="none", label="published (the paper's own data)",
        )  # fmt: skip
        figure.legend(handles=[mark], loc="outside lower center", fontsize=8, frameon=False)
    return figure


def recall_figure(
    panels: Mapping[str, Mapping[str, ImageArray]],
    *,
    names: Sequence[str] = (),
    heading: str = "",
) -> Figure:
    """Fraction of views under a given error, a curve a method, a panel a class or number of views.

    Args:
        panels: Errors in degrees by method, for each panel.
        names: All methods, so that each has one colour wherever it is; else as they come.
        heading: Text above the figure.

    Raises:
        ValueError: if there are no panels.
    """
    order = list(dict.fromkeys([*names, *(name for curves in panels.values() for name in curves)]))
    figure, axes = _panels(len(panels), height=3.0, heading=heading)
    thresholds = np.linspace(0.0, 180.0, 721)
    handles: dict[str, Line2D] = {}
    for place, (title, curves) in zip(axes, panels.items(), strict=True):
        for name, errors in curves.items():
            color, style = _look(order.index(name))
            share = recall_at(errors, thresholds.tolist()) * 100.0
            (handles[name],) = place.plot(
                thresholds, share, color=color, linestyle=style, linewidth=1.5, label=name
            )
        theta = np.radians(thresholds)
        (handles["random guess"],) = place.plot(
            thresholds, (theta - np.sin(theta)) / np.pi * 100.0, color=GRAY, linestyle="--",
            linewidth=1.0, label="random guess",
        )  # fmt: skip
        place.set(xlim=(0, 180), ylim=(0, 101), xticks=[0, 30, 60, 90, 120, 150, 180])
        place.set_title(title, fontsize=10, color=INK)
        place.set_xlabel("rotation error (degrees)", fontsize=8)
        place.tick_params(labelsize=8)
        plain_axes(place)
    axes[0].set_ylabel("views under this error (%)", fontsize=8)
    shown = [handles[name] for name in [*order, "random guess"] if name in handles]
    _legend_below(figure, shown)
    return figure


def _legend_below(figure: Figure, lines: Sequence[Line2D]) -> None:
    """In as many columns as fit; the figure grows by its rows."""
    for columns in range(min(4, len(lines)), 0, -1):
        legend = figure.legend(
            handles=lines, loc="outside lower center", ncols=columns, fontsize=8, frameon=False
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
    rows = ceil(len(lines) / columns)
    figure.set_figheight(figure.get_figheight() + 0.17 * (rows - 1))


def _panels(count: int, *, height: float, heading: str) -> tuple[Figure, list[Axes]]:
    """A figure with so many axes, at most four beside each other."""
    if count == 0:
        raise ValueError("A figure of a report got no panels: there is nothing to draw.")
    across = min(count, _COLUMNS)
    down = ceil(count / across)
    figure = new_figure(max(5.2, 1.6 + 2.9 * across), 0.7 + height * down)
    if heading:
        figure.suptitle(heading, fontsize=10, color=INK, wrap=True)
    grid = figure.subplots(down, across, squeeze=False).ravel().tolist()
    for unused in grid[count:]:
        unused.remove()
    return figure, grid[:count]


def _look(index: int) -> tuple[str, str]:
    """Colour and line of a method: the colours come round with other lines."""
    colors = [color for color in CYCLE if color != GRAY]  # gray is for random guessing
    return colors[index % len(colors)], _LINES[index // len(colors) % len(_LINES)]


def _draw_bars(axes: Axes, bars: Sequence[Bar]) -> None:
    many = _look(len(bars) - 1)[1] != _LINES[0]  # colours that came round would mean nothing
    for place, bar in enumerate(bars):
        color, _ = _look(place)
        if bar.value is None:
            axes.text(0.01, place, "–", transform=axes.get_yaxis_transform(), va="center")
        else:
            axes.barh(place, bar.value, height=0.62, color=CYCLE[0] if many else color, alpha=0.85)
            if bar.low is not None and bar.high is not None:
                axes.plot([bar.low, bar.high], [place, place], color=INK, linewidth=1.4)
                axes.plot([bar.low, bar.high], [place, place], "|", color=INK, markersize=7)
        if bar.paper is not None:
            axes.plot(
                bar.paper, place, "D", color=INK, markersize=4.5, markerfacecolor="white", zorder=3
            )
    axes.set_yticks(range(len(bars)), [bar.name for bar in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)  # the first on top
    axes.set_xlim(left=0.0)
    plain_axes(axes)
    axes.grid(visible=False, axis="y")
