"""The picture of one answer: input, predicted orientation, alternatives; or class probabilities."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from i2i.viz.style import (
    BLUE,
    GRAY,
    INK,
    SKY,
    VERMILION,
    ImageArray,
    new_figure,
    plain_axes,
    show_image,
)

_SHOWN_CLASSES = 8


def pose_figure(
    image: ImageArray,
    *,
    views: ImageArray | None,
    class_name: str,
    euler_deg: Sequence[float] | ImageArray,
    probabilities: Sequence[float | None],
    warnings: Sequence[str] = (),
) -> Figure:
    """Input beside the reference mesh in the predicted orientation and in the alternatives.

    Args:
        image: What the network saw, shape (C, S, S), in [0, 1].
        views: The mesh in the prediction and in each alternative, shape (1 + A, C, S', S'); None
            where there is no mesh.
        class_name: Class of the object.
        euler_deg: (a, b, c) of the prediction in degrees, extrinsic xyz.
        probabilities: Of the prediction and of each alternative; None where not known.
        warnings: Sentences shown below.

    Returns:
        The figure.
    """
    shown = [] if views is None else list(views)
    figure = new_figure(2.3 * (2 + max(len(shown) - 1, 0) * 0.75) + 0.2, 3.0 + 0.28 * len(warnings))
    widths = [1.0, 1.0, *[0.75] * max(len(shown) - 1, 0)]
    panels = figure.subplots(1, len(widths), gridspec_kw={"width_ratios": widths}, squeeze=False)[0]
    show_image(panels[0], image, title=f"input: {class_name}")
    a, b, c = (float(angle) for angle in euler_deg)
    angles = f"Euler xyz {a:.0f}°, {b:.0f}°, {c:.0f}°"
    best = probabilities[0]
    title = "prediction" if best is None else f"prediction, {_percent(best)}"
    if shown:
        show_image(panels[1], shown[0], title=f"{title}\n{angles}", color=BLUE)
    else:
        panels[1].set_axis_off()
        panels[1].text(
            0.5, 0.5, f"{title}\n{angles}\n\n(no reference mesh to draw)", ha="center",
            va="center", fontsize=9, color=INK, transform=panels[1].transAxes,
        )  # fmt: skip
    for number, axes in enumerate(panels[2:], start=1):
        probability = probabilities[number] if number < len(probabilities) else None
        label = f"alternative {number}"
        label = label if probability is None else f"{label}\n{_percent(probability)}"
        show_image(axes, shown[number], title=label, color=GRAY)
    _write_warnings(figure, warnings)
    return figure


def class_figure(
    image: ImageArray, *, probabilities: Mapping[str, float], warnings: Sequence[str] = ()
) -> Figure:
    """Input beside a bar for each of the most probable classes.

    Args:
        image: What the network saw, shape (C, S, S), in [0, 1].
        probabilities: By class name, the most probable first.
        warnings: Sentences shown below.

    Returns:
        The figure.
    """
    shown = list(probabilities.items())[:_SHOWN_CLASSES]
    figure = new_figure(6.4, 2.8 + 0.28 * len(warnings))
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.0, 1.3]})
    show_image(left, image, title="input")
    names = [name for name, _ in shown]
    shares = [100.0 * probability for _, probability in shown]
    bars = right.barh(names, shares, color=[BLUE, *[SKY] * (len(shown) - 1)])
    right.bar_label(bars, fmt="%.0f %%", padding=2, fontsize=8)
    right.invert_yaxis()
    right.set(xlabel="probability (%)", xlim=(0, 112), title=f"prediction: {names[0]}")
    right.title.set_fontsize(9)
    right.tick_params(labelsize=8)
    plain_axes(right)
    _write_warnings(figure, warnings)
    return figure


def _percent(probability: float) -> str:
    return f"{100.0 * probability:.0f} %" if probability >= 0.01 else "< 1 %"


def _write_warnings(figure: Figure, warnings: Sequence[str]) -> None:
    """Warnings in red below the panels, wrapped to the figure's width."""
    if not warnings:
        return
    width = int(figure.get_size_inches()[0] * 15)
    text = "\n".join(textwrap.fill(f"Warning: {sentence}", width) for sentence in warnings)
    figure.supxlabel(text, fontsize=8, color=VERMILION, ha="left", x=0.01)
