"""What all figures share: colours that colour-blind readers can tell apart, canvas, saving.

Figures are built on the Agg canvas without pyplot: no global state, no display, thread-safe.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

# The palette of Okabe and Ito.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, GRAY, INK = "#CC79A7", "#56B4E9", "#7F7F7F", "#222222"
CYCLE = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, GRAY)

HEAT = "cividis"
"""Colour map of probabilities: reads the same with every kind of colour vision."""

ImageArray = np.ndarray | torch.Tensor


def _hue_circle(count: int = 256) -> np.ndarray:
    """Colours once round the hue circle of the Oklab space, (count, 3) in sRGB.

    Equal steps look equally large, no colour is as light as paper, and lightness swings once round
    too: blue is darkest, yellow lightest, so that turns by half a circle differ without hue.
    """
    hue = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + np.radians(20.0)  # starts at red
    light = 0.66 + 0.12 * np.cos(hue - np.radians(100.0))
    chroma = np.full(count, 0.15)
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    roots = np.stack([
        light + 0.3963377774 * a + 0.2158037573 * b,
        light - 0.1055613458 * a - 0.0638541728 * b,
        light - 0.0894841775 * a - 1.2914855480 * b,
    ])  # fmt: skip
    to_rgb = np.array([
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ])  # fmt: skip
    linear = np.clip(to_rgb @ roots**3, 0.0, 1.0).T
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


HUES = ListedColormap(_hue_circle(), name="hues")
"""Colour map of angles: its ends meet; 0 is red, a third green, two thirds blue."""


def angle_color(angle_deg: np.ndarray) -> np.ndarray:
    """Colours (N, 4) of angles (N,) in degrees."""
    return np.asarray(HUES((np.asarray(angle_deg) % 360.0) / 360.0))


def new_figure(width: float, height: float) -> Figure:
    """A figure of the given size in inches, with an Agg canvas and tidy spacing."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plain_axes(axes: Axes) -> None:
    """Thin axes: no frame at the top and right, a light grid behind the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def show_image(axes: Axes, image: ImageArray, *, title: str = "", color: str = INK) -> None:
    """Draw one (C, H, W) image of values in [0, 1] without axes."""
    pixels = to_numpy(image)
    if pixels.ndim == 3:
        pixels = pixels[0] if pixels.shape[0] == 1 else pixels.transpose(1, 2, 0)
    axes.imshow(pixels, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("0.8")
    if title:
        axes.set_title(title, fontsize=9, color=color)


def error_color(error_deg: float) -> str:
    """Green within 15°, orange within 30°, vermilion beyond."""
    if error_deg <= 15.0:
        return GREEN
    return ORANGE if error_deg <= 30.0 else VERMILION


def figure_to_array(figure: Figure) -> np.ndarray:
    """Pixels of a figure, shape (H, W, 3), uint8."""
    canvas = figure.canvas
    if not isinstance(canvas, FigureCanvasAgg):
        canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure; folders are made, and a reader never sees half a file.

    Args:
        figure: What to write.
        path: Where to; the suffix (.png, .pdf, .svg) chooses the format.

    Returns:
        The path.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.stem}.partial{target.suffix or '.png'}")
    figure.savefig(partial, dpi=120)
    partial.replace(target)
    return target


def to_numpy(values: ImageArray) -> np.ndarray:
    """An array on the CPU, from an array or a tensor."""
    if isinstance(values, torch.Tensor):
        return values.detach().cpu().numpy()
    return np.asarray(values)
