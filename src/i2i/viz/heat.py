"""The distribution over the 60 rotations on the icosahedron itself.

The icosahedron has 20 faces of three corners each, and the 60 rotations of its group move one
corner of a face to every other in exactly one way. So each corner is a rotation: the camera above
that vertex, turned so that its up axis points into that face.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from i2i.viz.group import fivefold_frame, group_layout
from i2i.viz.style import HEAT, INK, VERMILION, ImageArray, new_figure, to_numpy

_VIEWS_APART = 2.15  # circumscribed radii between the centres of the two views
_NUDGE_DEG = 1.0  # decides to which face an up axis along an edge belongs


def corner_kites(rotations: ImageArray) -> np.ndarray:
    """The part of the icosahedron's surface that belongs to each rotation.

    Args:
        rotations: The icosahedral group, shape (60, 3, 3), read as camera → object.

    Returns:
        Shape (60, 4, 3): the vertex above which the camera is, the middle of an edge, the middle
        of the face into which its up axis points, the middle of the other edge; counter-clockwise
        from outside. The 60 kites are congruent and cover the surface.

    Raises:
        ValueError: if the rotations are not the icosahedral group.
    """
    group = to_numpy(rotations).astype(np.float64)
    directions = group_layout(group).directions
    axis, up = fivefold_frame(group)
    start = int(np.argmax(directions @ axis))
    near = directions[
        np.flatnonzero(np.isclose(directions @ directions[start], 5**-0.5, atol=1e-3))
    ]
    right = np.cross(up, axis)
    angle = np.degrees(np.arctan2(near @ up, near @ right))  # of the five edges, from the right
    near = near[np.argsort(angle % 360.0)]
    middles = near + np.roll(near, -1, axis=0)  # of the five faces, up to length
    away = np.degrees(np.arctan2(middles @ right, middles @ up)) + _NUDGE_DEG
    face = int(np.argmin(np.abs((away + 180.0) % 360.0 - 180.0)))
    vertex, first, second = directions[start], near[face], near[(face + 1) % 5]
    kite = np.stack([
        vertex, (vertex + first) / 2, (vertex + first + second) / 3, (vertex + second) / 2,
    ])  # fmt: skip
    turns: np.ndarray = np.einsum("gij,kj->gki", group, kite)
    return turns


def heat_figure(
    probabilities: ImageArray,
    *,
    rotations: ImageArray,
    target: int | None = None,
    heading: str = "",
) -> Figure:
    """The icosahedron from two opposite sides, each corner of its faces coloured by its rotation.

    Args:
        probabilities: Probability mass of each element, shape (60,), in the group's own order.
        rotations: The group, shape (60, 3, 3), read as camera → object.
        target: Number of the true element, outlined in red; the front view looks at its face.
        heading: Text above the figure.

    Returns:
        The figure.
    """
    mass = to_numpy(probabilities).astype(np.float64).ravel()
    figure = new_figure(7.6, 3.9)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    norm = Normalize(0.0, max(float(mass.max()), 1e-6))
    axes = figure.subplots()
    draw_heat(axes, mass, rotations=rotations, norm=norm, target=target)
    axes.set_title(
        "each corner of a face: camera above that vertex, its up axis into that face"
        + ("; red: true element" if target is not None else ""),
        fontsize=9, color=INK,
    )  # fmt: skip
    figure.colorbar(ScalarMappable(norm, HEAT), ax=axes, label="probability", shrink=0.8, pad=0.01)
    return figure


def draw_heat(
    axes: Axes,
    probabilities: ImageArray,
    *,
    rotations: ImageArray,
    norm: Normalize,
    target: int | None = None,
) -> None:
    """Draw both sides of the icosahedron into one pair of axes.

    Args:
        axes: Where to; they lose their ticks and frame.
        probabilities: Shape (60,), in the group's own order.
        rotations: The group, shape (60, 3, 3), read as camera → object.
        norm: Range of the colours.
        target: Number of the element that is outlined and looked at; the most probable one is
            looked at if None.

    Raises:
        ValueError: if there are not 60 probabilities.
    """
    mass = to_numpy(probabilities).astype(np.float64).ravel()
    kites = corner_kites(rotations)
    if mass.shape != (len(kites),):
        raise ValueError(f"Got {mass.size} probabilities for {len(kites)} rotations.")
    face = kites[int(mass.argmax()) if target is None else target][2]
    frame = _looking_at(face)
    color = ScalarMappable(norm, HEAT)
    for sign, name, x in ((1.0, "front", 0.0), (-1.0, "back", _VIEWS_APART)):
        screen = kites @ (frame * np.array([[sign], [1.0], [sign]])).T  # (60, 4, 3): right, up, out
        seen = np.flatnonzero(screen[:, 2, 2] > 0.0)
        outlines = screen[seen, :, :2] + (x, 0.0)
        axes.add_collection(PolyCollection(
            list(outlines), facecolors=color.to_rgba(mass[seen]), edgecolors=(1, 1, 1, 0.45),
            linewidths=0.5, label=name,
        ))  # fmt: skip
        _draw_edges(axes, kites[:, 0], frame=frame, sign=sign, x=x)
        if target in seen:
            chosen = outlines[np.flatnonzero(seen == target)]
            axes.add_collection(PolyCollection(
                list(chosen), facecolors="none", edgecolors=VERMILION, linewidths=2.0, zorder=4
            ))  # fmt: skip
        axes.text(x - 0.98, -0.95, name, ha="left", va="center", fontsize=7.5, color="0.35")
        _mark_pole(axes, frame=frame, sign=sign, x=x)
    axes.set(xlim=(-1.05, _VIEWS_APART + 1.05), ylim=(-1.2, 1.1), aspect="equal")
    axes.set_axis_off()


def _looking_at(direction: np.ndarray) -> np.ndarray:
    """Rows: what is right, up and towards the reader when one looks at a direction, z axis up."""
    out = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) - out[2] * out
    if np.linalg.norm(up) < 1e-6:
        up = np.array([0.0, 1.0, 0.0]) - out[1] * out
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, out), up, out])


def _draw_edges(
    axes: Axes, corners: np.ndarray, *, frame: np.ndarray, sign: float, x: float
) -> None:
    """The edges of the ten faces that are seen."""
    vertices = np.unique(np.round(corners, 6), axis=0)
    near = np.isclose(vertices @ vertices.T, 5**-0.5, atol=1e-3)
    screen = vertices @ (frame * np.array([[sign], [1.0], [sign]])).T
    seen = []
    for i, j in zip(*np.nonzero(np.triu(near)), strict=True):
        faces = screen[near[i] & near[j]] + screen[i] + screen[j]  # middles of the two beside it
        if (faces[:, 2] > 0.0).any():
            seen.append(screen[[i, j], :2] + (x, 0.0))
    axes.add_collection(LineCollection(seen, colors="white", linewidths=1.6, zorder=3))


def _mark_pole(axes: Axes, *, frame: np.ndarray, sign: float, x: float) -> None:
    """A small label where the object's z axis leaves the surface, if that is seen."""
    for name, height in (("+z", 1.0), ("−z", -1.0)):
        right, up, out = frame[:, 2] * height * (sign, 1.0, sign)
        if out > 0.15:
            box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.85,
                   "edgecolor": "0.6", "linewidth": 0.5}  # fmt: skip
            axes.text(
                right + x, up, name, fontsize=7, ha="center", va="center", color=INK, zorder=5,
                bbox=box,
            )  # fmt: skip
