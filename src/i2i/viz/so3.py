"""A distribution over rotations as a map: position, colour and area for direction, turn and mass.

A rotation is a direction and a turn about it. The direction is a place on an equal-area (Mollweide)
map of the sphere, the turn a colour, and probability mass the area of a dot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.path import Path as MarkerPath
from numpy.typing import NDArray

from i2i.geometry.symmetries import equivalents
from i2i.models.prediction import PosePrediction
from i2i.viz.heat import draw_heat
from i2i.viz.sphere import MapAxis, map_coordinates
from i2i.viz.style import (
    HEAT,
    INK,
    ImageArray,
    angle_color,
    new_figure,
    show_image,
    to_numpy,
)

MAX_DOTS = 4000
_COVERAGE = 0.999
_LARGEST_DOT = 240.0  # areas in square points
_RING = 260.0
_COVERED = 0.25  # at most this share of the map is under dots
_LINE_TURNS = 360
_ARCS = 36

_POSITION = {
    "view": "position: from where the camera looks, in the object's frame (z axis up)",
    "object": "position: where the object's z axis points, as the camera sees it",
}
_TURN = {"view": "the camera's\nup axis points", "object": "the object's\ny axis points"}


@dataclass(frozen=True)
class RotationDistribution:
    """Rotations with their probability mass; the negligible ones may be left out.

    Attributes:
        rotations: Object → camera, shape (K, 3, 3), the heaviest first.
        mass: Probability mass of each, shape (K,), falling; its sum is below 1 where some of the
            candidates were left out.
        candidates: How many there were before any were left out.
        kind: What they are, for the caption.
    """

    rotations: NDArray[np.float64]
    mass: NDArray[np.float64]
    candidates: int
    kind: str = "rotations"

    @classmethod
    def from_candidates(
        cls, rotations: ImageArray, log_prob: ImageArray, *, max_kept: int = MAX_DOTS
    ) -> RotationDistribution:
        """Keep the heaviest candidates: those that hold 99.9 % of the mass, or so many at most.

        Args:
            rotations: Object → camera, shape (K, 3, 3); the centres of the cells of a grid, or a
                network's own proposals.
            log_prob: Log of each candidate's probability mass, shape (K,).
            max_kept: At most so many are kept.

        Raises:
            ValueError: if the shapes differ or the masses do not sum to one.
        """
        turns, log_mass = torch.as_tensor(rotations), torch.as_tensor(log_prob).detach()
        if log_mass.ndim != 1 or turns.shape != (len(log_mass), 3, 3):
            raise ValueError(
                f"from_candidates wants rotations (K, 3, 3) and log_prob (K,), got "
                f"{tuple(turns.shape)} and {tuple(log_mass.shape)}: give one image's distribution."
            )
        # The choice is made where the tensors are: a fine grid should not travel whole.
        wide = torch.float32 if log_mass.device.type == "mps" else torch.float64
        everything = log_mass.to(wide).exp()
        total = float(everything.sum())
        if not abs(total - 1.0) < 0.01:
            raise ValueError(
                f"The masses sum to {total:.4g}, not to 1: give the log of each candidate's "
                "probability mass (log_softmax of its logits), not of a density."
            )
        kept = everything.topk(min(max_kept, len(everything)))
        mass = kept.values.cpu().double().numpy()
        count = min(int(np.searchsorted(np.cumsum(mass), _COVERAGE * total)) + 1, len(mass))
        chosen = turns[kept.indices[:count].to(turns.device)].detach()
        return cls(to_numpy(chosen.to("cpu").double()), mass[:count], len(everything))

    @classmethod
    def from_samples(cls, rotations: ImageArray) -> RotationDistribution:
        """Equal masses for samples (N, 3, 3)."""
        turns = to_numpy(rotations).astype(np.float64)
        return cls(turns, np.full(len(turns), 1.0 / max(len(turns), 1)), len(turns), "samples")

    @classmethod
    def from_prediction(
        cls, prediction: PosePrediction, index: int = 0, *, max_kept: int = MAX_DOTS
    ) -> RotationDistribution | None:
        """That of one image of a batch; None where the network has no distribution."""
        if prediction.log_prob is None or prediction.candidates is None:
            return None
        candidates = prediction.candidates
        own = candidates if candidates.ndim == 3 else candidates[index]
        return cls.from_candidates(own, prediction.log_prob[index], max_kept=max_kept)


@dataclass(frozen=True)
class PoseSample:
    """What is drawn about one image.

    Attributes:
        distribution: What the network believes.
        image: What it saw, shape (C, H, W) in [0, 1]; left out if None.
        true: True object → camera rotation, shape (3, 3); not marked if None.
        predicted: The network's best guess, shape (3, 3); not marked if None.
        symmetry: Of the object: the true rotation and all that look the same are marked.
        group_mass: Probability of the 60 rotations of the icosahedron, shape (60,), in the order of
            the group that the figure gets.
        group_target: Number of the true element, outlined.
        title: Text above the image.
    """

    distribution: RotationDistribution
    image: ImageArray | None = None
    true: ImageArray | None = None
    predicted: ImageArray | None = None
    symmetry: str = "none"
    group_mass: ImageArray | None = None
    group_target: int | None = None
    title: str = ""


def so3_figure(
    samples: Sequence[PoseSample] | RotationDistribution,
    *,
    axis: MapAxis = "view",
    group: ImageArray | None = None,
    heading: str = "",
) -> Figure:
    """Distributions over rotations as maps, beside their images.

    Rings mark the true rotation and all that look the same (a line where there are infinitely
    many), a cross the prediction; both have the colour of their turn in the plane. Areas compare
    within a map, not between maps: below each stands how much mass its largest dot has.

    Args:
        samples: What to draw, one row each, or two in a row where there is no group; a bare
            distribution is one sample.
        axis: What the position says, see `i2i.viz.sphere.map_coordinates`.
        group: The icosahedral group, shape (60, 3, 3), read as camera → object: with it each
            sample's `group_mass` is drawn on the icosahedron too.
        heading: Text above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: if there is nothing to draw.
    """
    if isinstance(samples, RotationDistribution):
        samples = [PoseSample(samples)]
    if not samples:
        raise ValueError("so3_figure got no samples; give at least one.")
    across = 2 if group is None and len(samples) > 1 else 1
    down = -(-len(samples) // across)
    images = any(sample.image is not None for sample in samples)
    cell = [*([1.5] if images else []), 4.0, *([4.0] if group is not None else [])]
    widths = [*cell * across, 1.35]
    figure = new_figure(sum(widths) + 0.2, 2.25 * down + 0.3 + 0.35 * bool(heading))
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    grid = figure.add_gridspec(down, len(widths), width_ratios=widths)
    norm, heat = _heat_norm(samples), []
    for number, sample in enumerate(samples):
        row, block = divmod(number, across)
        column = block * len(cell)
        if images:
            axes = figure.add_subplot(grid[row, column])
            if sample.image is None:
                axes.set_axis_off()
            else:
                show_image(axes, sample.image, title=sample.title)
        map_axes = figure.add_subplot(grid[row, column + images], projection="mollweide")
        draw_so3(map_axes, sample, axis=axis)
        if group is not None and sample.group_mass is not None:
            heat.append(figure.add_subplot(grid[row, column + images + 1]))
            draw_heat(
                heat[-1], sample.group_mass, rotations=group, norm=norm, target=sample.group_target
            )
    if heat:
        bar = figure.colorbar(
            ScalarMappable(norm, HEAT), ax=heat, shrink=0.7, pad=0.01, aspect=12 * down + 8
        )
        bar.set_label("probability\n(red: true element)", fontsize=7.5)
        bar.ax.tick_params(labelsize=6.5)
    _draw_legend(figure, figure.add_subplot(grid[:, -1]), axis=axis)
    return figure


def draw_so3(axes: Axes, sample: PoseSample, *, axis: MapAxis = "view") -> None:
    """Draw one distribution on axes with the Mollweide projection."""
    distribution = sample.distribution
    _prepare_map(axes, axis=axis)
    if len(distribution.mass):
        longitude, latitude, turn = map_coordinates(distribution.rotations, axis)
        order = np.argsort(-distribution.mass, kind="stable")  # small dots lie on large ones
        axes.scatter(
            longitude[order], latitude[order], zorder=3, linewidth=0.0, alpha=0.85,
            s=_dot_areas(axes, distribution.mass)[order], color=angle_color(turn[order]),
            clip_on=False, label="mass",
        )  # fmt: skip
    if sample.true is not None:
        _draw_true(axes, to_numpy(sample.true), symmetry=sample.symmetry, axis=axis)
    if sample.predicted is not None:
        _draw_predicted(axes, to_numpy(sample.predicted), axis=axis)
    axes.text(
        0.5, -0.07, _caption(distribution), transform=axes.transAxes, ha="center", va="top",
        fontsize=7.5, color="0.35",
    )  # fmt: skip


def _caption(distribution: RotationDistribution) -> str:
    count, drawn = distribution.candidates, len(distribution.mass)
    if not drawn:
        return "nothing to draw"
    share, largest = 100.0 * distribution.mass.sum(), 100.0 * distribution.mass.max()
    some = f"{drawn:,} of {count:,}" if drawn < count else f"{count:,}"
    return f"{some} {distribution.kind}, {share:.3g} % of the mass; largest dot {largest:.2g} %"


def _dot_areas(axes: Axes, mass: np.ndarray) -> np.ndarray:
    """Areas in square points, proportional to the masses."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    box = axes.get_position()
    width, height = figure.get_size_inches() * 72.0 * (box.width, box.height)
    ellipse = np.pi / 4.0 * min(width, 2.0 * height) ** 2 / 2.0
    scale = min(_LARGEST_DOT / mass.max(), _COVERED * ellipse / mass.sum())
    return np.asarray(scale * mass)


def _prepare_map(axes: Axes, *, axis: MapAxis) -> None:
    """Graticule and, in the camera's frame, what lies where."""
    axes.grid(visible=True, color="0.88", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_xticks(np.radians([-120, -60, 0, 60, 120]), [""] * 5)
    latitudes = [-60, -30, 0, 30, 60]
    names = [f"{value}°" for value in latitudes] if axis == "view" else [""] * 5
    axes.set_yticks(np.radians(latitudes), names)
    axes.tick_params(labelsize=6.5, colors="0.5", pad=1)
    axes.spines["geo"].set_color("0.6")
    axes.spines["geo"].set_linewidth(0.8)
    if axis == "object":
        for name, (x, y) in (("to the\nviewer", (0, 0)), ("left", (-90, 0)), ("right", (90, 0)),
                           ("up", (0, 75)), ("down", (0, -75))):  # fmt: skip
            axes.text(np.radians(x), np.radians(y), name, fontsize=6.5, color="0.6", ha="center",
                      va="center", zorder=1)  # fmt: skip


def _draw_true(axes: Axes, true: np.ndarray, *, symmetry: str, axis: MapAxis) -> None:
    """A ring for the true rotation and each that looks the same; a line where they are dense."""
    alike = equivalents(torch.from_numpy(true.astype(np.float64)), symmetry, count=_LINE_TURNS)
    longitude, latitude, turn = map_coordinates(alike, axis)
    points = np.stack([longitude, latitude], axis=1)
    if axis == "object":  # the object turns about its z axis, so all of them lie on one spot
        _draw_ring(axes, points[0], turn[:: max(len(turn) // _ARCS, 1)])
    elif len(turn) < _LINE_TURNS:
        for point, own in zip(points, turn, strict=True):
            _draw_ring(axes, point, own[None])
    else:
        pairs = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
        whole = np.abs(np.diff(pairs[:, :, 0], axis=1)[:, 0]) < np.pi  # not over the map's border
        segments = list(pairs[whole])
        for color, width in ((INK, 3.4), (angle_color(turn[whole]), 1.8)):
            line = LineCollection(
                segments, colors=color, linewidths=width, zorder=2.5, label="true", clip_on=False,
                capstyle="projecting",  # no seams between the segments
            )  # fmt: skip
            axes.add_collection(line, autolim=False)


def _draw_ring(axes: Axes, point: np.ndarray, turn: np.ndarray) -> None:
    """A ring round a spot, divided among the turns (degrees): each at the side where it points."""
    x, y = point
    axes.scatter(x, y, s=_RING, facecolor="none", edgecolor=INK, linewidth=3.4, zorder=5,
                 clip_on=False, label="true")  # fmt: skip
    half = 180.0 / len(turn)
    # Markers are scaled to their farthest point: the lone corners give all arcs the same scale.
    corners = MarkerPath([(1.0, 1.0), (-1.0, -1.0)], [MarkerPath.MOVETO] * 2)
    for middle, color in zip(turn, angle_color(turn), strict=True):
        arc = MarkerPath.make_compound_path(corners, MarkerPath.arc(middle - half, middle + half))
        axes.scatter(x, y, s=_RING, marker=arc, facecolor="none", edgecolor=color, linewidth=1.8,
                     zorder=5.5, clip_on=False, capstyle="butt", label="turn")  # fmt: skip


def _draw_predicted(axes: Axes, predicted: np.ndarray, *, axis: MapAxis) -> None:
    if not np.isfinite(predicted).all():
        return
    longitude, latitude, turn = map_coordinates(predicted[None], axis)
    axes.scatter(
        longitude, latitude, s=42.0, marker="x", color=angle_color(turn), linewidth=1.8, zorder=6,
        clip_on=False, label="predicted", path_effects=[_outline(3.8)],
    )  # fmt: skip


def _outline(width: float) -> patheffects.withStroke:
    return patheffects.withStroke(linewidth=width, foreground=INK)


def _heat_norm(samples: Sequence[PoseSample]) -> Normalize:
    masses = [to_numpy(s.group_mass) for s in samples if s.group_mass is not None]
    return Normalize(0.0, max((float(mass.max()) for mass in masses), default=1.0))


def _draw_legend(figure: Figure, wheel: Axes, *, axis: MapAxis) -> None:
    """Colour wheel and what the marks mean; below the figure, what the position means."""
    edge = np.arange(0.0, 360.0, 2.0)
    bounds = np.radians(edge[:, None] + [0.0, 2.4])
    arcs = np.stack([np.cos(bounds), np.sin(bounds)], axis=2)  # (180, 2, 2)
    pieces = np.concatenate([arcs, 0.6 * arcs[:, ::-1]], axis=1)
    wheel.add_collection(
        PolyCollection(list(pieces), facecolors=angle_color(edge + 1.0), linewidths=0.0)
    )
    sides = (
        ("east", "north", "west", "south") if axis == "view" else ("right", "up", "left", "down")
    )
    texts = [
        wheel.text(x, y, side, fontsize=6.5, ha=ha, va="center", color="0.35")
        for side, x, y, ha in zip(
            sides, (1.12, 0.0, -1.12, 0.0), (0.0, 1.25, 0.0, -1.25),
            ("left", "center", "right", "center"), strict=True,
        )
    ]  # fmt: skip
    marks = "area: probability\nring: true\ncross: predicted"
    texts += [
        wheel.text(
            0.0, 1.65, f"colour: where\n{_TURN[axis]}", ha="center", va="bottom", fontsize=7.5
        ),
        wheel.text(0.0, -1.65, marks, ha="center", va="top", fontsize=7.5),
    ]
    for text in texts:
        text.set_in_layout(False)  # or the layout would shrink the wheel to make room for them
    wheel.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal")
    wheel.set_axis_off()
    figure.supxlabel(_POSITION[axis], fontsize=8, color="0.35")
