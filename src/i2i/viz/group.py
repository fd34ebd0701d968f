"""The distribution over the 60 rotations of the icosahedron, as a table and on the icosahedron.

Each rotation of the group turns the camera to one of the twelve vertices, in one of five in-plane
turns. The table has a row for each vertex and a column for each turn; on the map each vertex is a
disc of five sectors, each pointing where the camera's up axis points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.path import Path as MarkerPath

from i2i.viz.sphere import compass, longitude_latitude
from i2i.viz.style import HEAT, INK, VERMILION, ImageArray, new_figure, to_numpy

_SECTOR_DEG = 72.0


@dataclass(frozen=True)
class GroupLayout:
    """Where each of the 60 rotations is drawn.

    Attributes:
        row: Shape (60,), 0 to 11: vertices from north to south, then from west to east.
        column: Shape (60,), 0 to 4: in-plane turns, counter-clockwise in steps of 72°.
        directions: Shape (12, 3), unit directions of the rows in the object frame.
        up_deg: Shape (60,): where the camera's up axis points on the map, in degrees
            counter-clockwise from east.
    """

    row: np.ndarray
    column: np.ndarray
    directions: np.ndarray
    up_deg: np.ndarray


def group_layout(rotations: ImageArray) -> GroupLayout:
    """Order the 60 rotations by vertex and in-plane turn.

    Args:
        rotations: The icosahedral group, shape (60, 3, 3), read as camera → object.

    Returns:
        Row, column and direction of each.

    Raises:
        ValueError: if the rotations are not 12 directions with five turns each.
    """
    group = to_numpy(rotations).astype(np.float64)
    axis, up = fivefold_frame(group)
    pointing, upward = group @ axis, group @ up
    rounded = np.round(pointing, 6) + 0.0  # +0.0 turns −0.0 into 0.0, or unique() tells them apart
    directions, inverse = np.unique(rounded, axis=0, return_inverse=True)
    inverse = inverse.ravel()
    if len(directions) != 12 or (np.bincount(inverse) != 5).any():
        raise ValueError(
            f"{len(group)} rotations with {len(directions)} viewing directions are not the 60 of "
            "the icosahedron (12 vertices, five turns each)."
        )
    longitude = np.round(np.arctan2(directions[:, 1], directions[:, 0]), 5)
    order = np.lexsort((longitude, -np.round(directions[:, 2], 5)))
    row = np.argsort(order)[inverse]
    east, north = compass(pointing)
    up_deg = (
        np.degrees(np.arctan2((upward * north).sum(axis=1), (upward * east).sum(axis=1))) % 360.0
    )
    column = np.empty(len(group), dtype=np.int64)
    for vertex in range(12):
        members = np.flatnonzero(row == vertex)
        column[members[np.argsort(np.round(up_deg[members], 4) % 360.0)]] = np.arange(5)
    return GroupLayout(row=row, column=column, directions=directions[order], up_deg=up_deg)


def group_figure(
    probabilities: ImageArray,
    *,
    rotations: ImageArray,
    target: int | None = None,
    heading: str = "",
) -> Figure:
    """Heat of the 60 probabilities as a 12 × 5 table and on the icosahedron (Mollweide map).

    Args:
        probabilities: Probability mass of each element, shape (60,), in the group's own order.
        rotations: The group, shape (60, 3, 3), read as camera → object.
        target: Index of the true element, outlined in red; nothing is outlined if None.
        heading: Text above the figure.

    Returns:
        The figure.
    """
    mass = to_numpy(probabilities).astype(np.float64).ravel()
    layout = group_layout(rotations)
    if mass.shape != layout.row.shape:
        raise ValueError(f"Got {mass.size} probabilities for {layout.row.size} rotations.")
    figure = new_figure(10.0, 4.4)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 2.6))
    norm = Normalize(0.0, max(float(mass.max()), 1e-6))
    _draw_table(figure.add_subplot(grid[0]), mass, layout=layout, norm=norm, target=target)
    map_axes = figure.add_subplot(grid[1], projection="mollweide")
    _draw_map(map_axes, mass, layout=layout, norm=norm, target=target)
    figure.colorbar(
        ScalarMappable(norm, HEAT), ax=map_axes, label="probability", shrink=0.7, pad=0.02
    )
    return figure


def _draw_table(
    axes: Axes, mass: np.ndarray, *, layout: GroupLayout, norm: Normalize, target: int | None
) -> None:
    table = np.zeros((12, 5))
    table[layout.row, layout.column] = mass
    axes.imshow(table, cmap=HEAT, norm=norm, aspect="auto")
    longitude, latitude = np.degrees(longitude_latitude(layout.directions))
    names = [
        f"{lat:+.0f}°" if abs(lat) > 89.0 else f"{lat:+.0f}°, {lon:+.0f}°"
        for lat, lon in zip(np.round(latitude), np.round(longitude), strict=True)
    ]
    axes.set_yticks(range(12), names, fontsize=8)
    axes.set_xticks(range(5), ["0", "72", "144", "216", "288"], fontsize=8)
    axes.set(xlabel="in-plane turn (degrees)", ylabel="camera at vertex: latitude, longitude")
    if target is not None:
        axes.plot(
            layout.column[target],
            layout.row[target],
            "s",
            markersize=13,
            markerfacecolor="none",
            markeredgecolor=VERMILION,
            markeredgewidth=2,
        )
        axes.set_title("red: true element", fontsize=9, color=VERMILION)


def _draw_map(
    axes: Axes, mass: np.ndarray, *, layout: GroupLayout, norm: Normalize, target: int | None
) -> None:
    _draw_edges(axes, layout.directions)
    color_map = ScalarMappable(norm, HEAT)
    for element, vertex in enumerate(layout.row):
        middle = layout.up_deg[element]
        sector = MarkerPath.wedge(middle - _SECTOR_DEG / 2, middle + _SECTOR_DEG / 2)
        chosen = element == target
        axes.scatter(
            *longitude_latitude(layout.directions[vertex]),
            s=900,
            marker=sector,
            color=color_map.to_rgba(mass[element]),
            edgecolor=VERMILION if chosen else "white",
            linewidth=2.0 if chosen else 0.5,
            zorder=4 if chosen else 3,
            clip_on=False,
        )
    axes.grid(visible=True, color="0.92", linewidth=0.5)
    axes.set_xticks(np.radians([-120, -60, 0, 60, 120]))
    axes.set_yticks(np.radians([-60, -30, 0, 30, 60]))
    axes.tick_params(labelsize=7, colors="0.5")
    axes.set_title(
        "camera direction in the object frame; sectors point where its up axis does",
        fontsize=9, pad=22,
    )  # fmt: skip


def _draw_edges(axes: Axes, directions: np.ndarray) -> None:
    """The icosahedron's 30 edges as great circles, broken where they cross the map's border."""
    cosines = directions @ directions.T
    for i, j in zip(
        *np.nonzero(np.triu(np.isclose(cosines, 1 / np.sqrt(5), atol=1e-3))), strict=True
    ):
        t = np.linspace(0.0, 1.0, 60)[:, None]
        arc = (1 - t) * directions[i] + t * directions[j]
        arc /= np.linalg.norm(arc, axis=1, keepdims=True)
        arc = arc[np.abs(arc[:, 2]) < 1.0 - 1e-6]  # a pole has no longitude
        longitude, latitude = longitude_latitude(arc)
        breaks = np.flatnonzero(np.abs(np.diff(longitude)) > np.pi) + 1
        for part in np.split(np.arange(len(arc)), breaks):
            axes.plot(longitude[part], latitude[part], color="0.75", linewidth=0.8, zorder=1)


def fivefold_frame(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The five-fold axis nearest to the camera's axis, and the camera's up axis beside it."""
    angle = np.arccos(np.clip((np.trace(group, axis1=1, axis2=2) - 1) / 2, -1.0, 1.0))
    turns = group[np.isclose(angle, 2 * np.pi / 5, atol=1e-4)]
    if len(turns) != 12:
        raise ValueError("The rotations are not the icosahedral group: no twelve turns by 72°.")
    axes = np.stack(
        [
            turns[:, 2, 1] - turns[:, 1, 2],
            turns[:, 0, 2] - turns[:, 2, 0],
            turns[:, 1, 0] - turns[:, 0, 1],
        ],
        axis=1,
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    axis = axes[np.argmax(np.round(axes[:, 2], 6))]
    up = np.array([0.0, 1.0, 0.0]) - axis[1] * axis
    return axis, up / np.linalg.norm(up)
