"""Boxes with rounded edges, cushions and balls, from templates that are made once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from i2i.data.sources.synthetic.primitives import Floats, Ints, Part, signed_volume


@lru_cache(maxsize=8)
def _rounded_template(steps: int) -> tuple[Floats, Floats, Ints]:
    """Corner signs (V, 3), directions (V, 3) and faces of a rounded box, from a split sphere."""
    quarter = np.linspace(0.0, 0.5 * np.pi, steps + 1)
    longitude = np.concatenate([quarter + k * 0.5 * np.pi for k in range(4)])
    latitude = np.concatenate([quarter - 0.5 * np.pi, quarter])
    corner = np.repeat(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), steps + 1, axis=0)
    rows, columns = len(latitude), len(longitude)
    direction = np.empty((rows, columns, 3))
    direction[..., 0] = np.cos(latitude)[:, None] * np.cos(longitude)
    direction[..., 1] = np.cos(latitude)[:, None] * np.sin(longitude)
    direction[..., 2] = np.sin(latitude)[:, None]
    sign = np.empty((rows, columns, 3))
    sign[..., :2] = corner
    sign[..., 2] = np.where(np.arange(rows) <= steps, -1.0, 1.0)[:, None]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
    c, d = np.roll(index, -1, axis=1)[1:], index[1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    bottom, top = index[0, :: steps + 1], index[-1, :: steps + 1]
    faces = np.concatenate([faces, bottom[[[0, 2, 1], [0, 3, 2]]], top[[[0, 1, 2], [0, 2, 3]]]])
    return _merged(sign.reshape(-1, 3), direction.reshape(-1, 3), faces)


def _merged(sign: Floats, direction: Floats, faces: Ints) -> tuple[Floats, Floats, Ints]:
    """The template without the points that coincide at the poles, and without empty faces."""
    keys = np.round(np.concatenate([sign, direction], axis=1), 9) + 0.0
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return sign[first], direction[first], faces[whole].astype(np.int64)


def box(
    size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, radius: float = 0.004, steps: int = 1
) -> Part:
    """A box with rounded edges.

    Args:
        size: Extent along x, y and z, shape (3,).
        centre: Its centre, shape (3,).
        radius: Radius of the edges; limited to 45 % of the smallest extent.
        steps: Faces across each rounding: 1 is a bevel.
    """
    half = 0.5 * np.asarray(size, dtype=np.float64)
    radius = min(radius, 0.9 * float(half.min()))
    sign, direction, faces = _rounded_template(steps)
    return Part(np.asarray(centre) + sign * (half - radius) + radius * direction, faces)


def span(low: ArrayLike, high: ArrayLike, *, radius: float = 0.004, steps: int = 1) -> Part:
    """A box with rounded edges, by its lowest and its highest corner."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return box(b - a, 0.5 * (a + b), radius=radius, steps=steps)


@lru_cache(maxsize=8)
def _cube_grid(steps: int) -> tuple[Floats, Ints]:
    """Surface of the cube [−1, 1]³ in steps × steps squares a side."""
    line = np.tan(np.linspace(-1.0, 1.0, steps + 1) * np.pi / 4)
    u, v = np.meshgrid(line, line, indexing="ij")
    index = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    square = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    points: list[Floats] = []
    faces: list[Ints] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.empty((steps + 1, steps + 1, 3))
            side[..., axis], side[..., (axis + 1) % 3], side[..., (axis + 2) % 3] = sign, u, v
            faces.append((square if sign > 0 else square[:, ::-1]) + len(points) * (steps + 1) ** 2)
            points.append(side.reshape(-1, 3))
    cloud = np.concatenate(points)
    merged, _, joined = _merged(cloud, cloud, np.concatenate(faces))
    return merged, joined


def cushion(
    size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, power: float = 5.0, steps: int = 6
) -> Part:
    """A stuffed box: |x/a|^power + |y/b|^power + |z/c|^power = 1.

    Args:
        size: Extent along x, y and z, shape (3,).
        centre: Its centre, shape (3,).
        power: 2 is an ellipsoid, 4 a soft pillow, 10 a firm one.
        steps: Squares along each edge.
    """
    grid, faces = _cube_grid(steps)
    radius = (np.abs(grid) ** power).sum(axis=1, keepdims=True) ** (-1.0 / power)
    return Part(
        np.asarray(centre) + 0.5 * np.asarray(size, dtype=np.float64) * grid * radius, faces
    )


def ball(radius: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, steps: int = 4) -> Part:
    """A ball, or an ellipsoid of three radii."""
    return cushion(
        2.0 * np.asarray(radius, dtype=np.float64) * np.ones(3), centre, power=2.0, steps=steps
    )


def ring(path: ArrayLike, section: ArrayLike) -> Part:
    """A level hoop: a section carried along a closed path.

    Args:
        path: Closed, at one height or nearly so, counter-clockwise seen from above, shape (P, 3).
        section: Closed outline, shape (K, 2): offsets (outwards, up).
    """
    line = np.asarray(path, dtype=np.float64)
    outline = np.asarray(section, dtype=np.float64)
    tangent = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    outwards = np.column_stack([tangent[:, 1], -tangent[:, 0], np.zeros(len(line))])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    vertices = line[:, None] + outline[None, :, :1] * outwards[:, None]
    vertices[..., 2] += outline[None, :, 1]
    index = np.arange(len(line) * len(outline)).reshape(len(line), len(outline))
    a, b = index, np.roll(index, -1, axis=0)
    c, d = np.roll(b, -1, axis=1), np.roll(index, -1, axis=1)
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    part = Part(vertices.reshape(-1, 3), faces)
    return part if signed_volume(part) > 0.0 else Part(part.vertices, faces[:, ::-1])
