"""Training curves: any logged number against the optimiser step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from i2i.viz.style import CYCLE, INK, new_figure, plain_axes

Curve = tuple[Sequence[float], Sequence[float]]
"""Steps and values of one logged number."""

_SMOOTHED_FROM = 50  # points
_UNITS = {"_deg": "degrees", "_rad": "radians", "lr": "learning rate", "loss": "loss"}


def training_figure(
    curves: Mapping[str, Curve], *, heading: str = "", smooth: float = 0.0
) -> Figure:
    """One panel for each unit, the curves of that unit together in it.

    Args:
        curves: Steps and values by logged name, such as ``"train/loss"``.
        heading: Text above the figure.
        smooth: Weight of the past in an exponential moving average, 0 (none) to below 1, for
            curves of 50 points and more; the raw curve stays visible behind.

    Returns:
        The figure.

    Raises:
        ValueError: if there are no curves.
    """
    if not curves:
        raise ValueError("training_figure got no curves: nothing was logged, or no name matched.")
    if not 0.0 <= smooth < 1.0:
        raise ValueError(f"smooth={smooth} was given; it must be at least 0 and below 1.")
    panels: dict[str, list[str]] = {}
    for name in curves:
        panels.setdefault(_unit(name), []).append(name)
    figure = new_figure(4.6 * len(panels), 3.2)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    for axes, (unit, names) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for index, name in enumerate(names):
            steps, values = curves[name]
            color = CYCLE[index % len(CYCLE)]
            marker = "o" if len(values) < 12 else None
            # Few points are means over a whole validation already: smoothing would only delay them.
            weight = smooth if len(values) >= _SMOOTHED_FROM else 0.0
            if weight:
                axes.plot(steps, values, color=color, alpha=0.25, linewidth=0.8)
            axes.plot(
                steps,
                moving_average(values, weight),
                color=color,
                label=name,
                marker=marker,
                markersize=3,
                linewidth=1.3,
            )
        everything = [value for name in names for value in curves[name][1]]
        if unit == "loss" and min(everything) > 0 and max(everything) > 5 * min(everything):
            axes.set_yscale("log")
        axes.set(xlabel="optimiser step", ylabel=unit)
        plain_axes(axes)
        axes.legend(frameon=False, fontsize=8)
    return figure


def moving_average(values: Sequence[float], weight: float) -> np.ndarray:
    """Exponential moving average without the bias towards zero at the start.

    Example:
        >>> moving_average([2.0, 2.0, 2.0], 0.9).round(6).tolist()
        [2.0, 2.0, 2.0]
    """
    average, norm = 0.0, 0.0
    smoothed = []
    for value in values:
        average = weight * average + (1.0 - weight) * float(value)
        norm = weight * norm + (1.0 - weight)
        smoothed.append(average / norm)
    return np.asarray(smoothed)


def read_curves(run_dir: str | Path, names: Sequence[str] | None = None) -> dict[str, Curve]:
    """Read logged numbers from the TensorBoard events of a run folder.

    Args:
        run_dir: Folder with event files, directly or below.
        names: Which to read; all of them if None.

    Returns:
        Steps and values by name, in the order of the names; a name that was not logged is left
        out.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    merged: dict[str, dict[int, float]] = {}
    folders = {path.parent for path in Path(run_dir).rglob("events.out.tfevents.*")}
    for folder in sorted(folders):
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        events.Reload()
        for name in events.Tags()["scalars"]:
            for event in events.Scalars(name):
                merged.setdefault(name, {})[event.step] = event.value  # a resumed run repeats steps
    chosen = sorted(merged) if names is None else [name for name in names if name in merged]
    return {
        name: (sorted(merged[name]), [merged[name][step] for step in sorted(merged[name])])
        for name in chosen
    }


def _unit(name: str) -> str:
    """Axis label of a logged name, from its ending."""
    for ending, unit in _UNITS.items():
        if ending in name.rsplit("/", 1)[-1]:
            return unit
    return "share" if "acc" in name else name.rsplit("/", 1)[-1]
