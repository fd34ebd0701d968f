"""Parts that objects are put together from: lofts, lathes, swept tubes, boxes, cushions, sheets.

Every part is a closed surface with its faces wound outwards, made of arrays only: no boolean
operations and no mesh library, so that an object of thirty parts takes a few milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Part:
    """A closed surface.

    Attributes:
        vertices: Positions, shape (V, 3), float64.
        faces: Triangles, shape (F, 3), int64, counter-clockwise seen from outside.
    """

    vertices: Floats
    faces: Ints

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Part:
        """The part shifted by (x, y, z)."""
        return Part(self.vertices + np.array([x, y, z]), self.faces)

    def rotated(self, axis: str, angle_deg: float) -> Part:
        """The part turned about a coordinate axis ("x", "y" or "z") through the origin."""
        k = _AXES[axis]
        i, j = (k + 1) % 3, (k + 2) % 3
        cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        vertices = self.vertices.copy()
        vertices[:, i] = cos * self.vertices[:, i] - sin * self.vertices[:, j]
        vertices[:, j] = sin * self.vertices[:, i] + cos * self.vertices[:, j]
        return Part(vertices, self.faces)

    def mirrored(self, axis: str = "x") -> Part:
        """The mirror image in the plane through the origin across an axis; still wound outwards."""
        vertices = self.vertices.copy()
        vertices[:, _AXES[axis]] *= -1.0
        return Part(vertices, self.faces[:, ::-1])

    def half_turned(self) -> Part:
        """The part turned by 180° about z, exactly: (x, y, z) becomes (−x, −y, z)."""
        return Part(self.vertices * np.array([-1.0, -1.0, 1.0]), self.faces)


def signed_volume(part: Part) -> float:
    """Volume enclosed by a part; positive if its faces are wound outwards."""
    a, b, c = (part.vertices - part.vertices.mean(axis=0))[part.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _outward(part: Part) -> Part:
    return part if signed_volume(part) >= 0.0 else Part(part.vertices, part.faces[:, ::-1])


# === outlines and paths ===


def vec(x: float, y: float, z: float) -> Floats:
    """A point or a shift, shape (3,)."""
    return np.array([x, y, z], dtype=np.float64)


def circle(segments: int = 10) -> Floats:
    """Unit circle, shape (segments, 2)."""
    angle = 2.0 * np.pi * np.arange(segments) / segments
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def superellipse(
    half_width: float,
    half_depth: float,
    *,
    power: float = 4.0,
    taper: float = 0.0,
    segments: int = 24,
) -> Floats:
    """A rounded rectangle, |x/a|^power + |y/b|^power = 1; shape (segments, 2).

    Args:
        half_width: a.
        half_depth: b.
        power: 2 is an ellipse, large is a sharp rectangle.
        taper: The width at +y is (1 + taper) times, at −y (1 − taper) times the given one.
        segments: Number of points.
    """
    # Equal steps of angle would crowd the corners of a long rectangle; the half-step offset keeps
    # the points mirror-symmetric in both axes.
    angle = 2.0 * np.pi * (np.arange(segments) + 0.5) / segments
    cos, sin = np.cos(angle), np.sin(angle)
    radius = (np.abs(cos) ** power + np.abs(sin) ** power) ** (-1.0 / power)
    x, y = radius * cos, radius * sin
    return np.stack([half_width * x * (1.0 + taper * y), half_depth * y], axis=1)


def spline(points: ArrayLike, count: int) -> Floats:
    """A smooth path through points, shape (count, D), by Catmull-Rom pieces.

    The tangents at the ends are those of the first and the last chord.
    """
    knots = np.asarray(points, dtype=np.float64)
    lengths = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(np.maximum(lengths, 1e-9))])
    slope = np.gradient(knots, at, axis=0)
    where = np.linspace(0.0, at[-1], count)
    piece = np.clip(np.searchsorted(at, where, side="right") - 1, 0, len(knots) - 2)
    step = (at[piece + 1] - at[piece])[:, None]
    t = (where[:, None] - at[piece][:, None]) / step
    return np.asarray(
        (2 * t**3 - 3 * t**2 + 1) * knots[piece]
        + (t**3 - 2 * t**2 + t) * step * slope[piece]
        + (3 * t**2 - 2 * t**3) * knots[piece + 1]
        + (t**3 - t**2) * step * slope[piece + 1]
    )


def fillet(points: ArrayLike, radius: float, *, steps: int = 4) -> Floats:
    """A polyline with its inner corners rounded, as a bent metal tube has them; shape (N, 3)."""
    corners = np.asarray(points, dtype=np.float64)
    path = [corners[:1]]
    t = np.linspace(0.0, 1.0, steps + 1)[:, None]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        to_before, to_after = before - corner, after - corner
        reach = min(
            radius, 0.45 * float(np.linalg.norm(to_before)), 0.45 * float(np.linalg.norm(to_after))
        )
        start = corner + to_before * (reach / np.linalg.norm(to_before))
        end = corner + to_after * (reach / np.linalg.norm(to_after))
        path.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    path.append(corners[-1:])
    return np.concatenate(path)


# === lofts and what follows from them ===


@lru_cache(maxsize=512)
def _loft_faces(sections: int, points: int) -> Ints:
    """Faces of a loft: the bands in order, 2·points each, then the start cap, then the end cap."""
    row = np.arange(sections - 1)[:, None] * points
    k = np.arange(points)[None, :]
    after = (k + 1) % points
    a, b, c, d = row + k, row + after, row + points + after, row + points + k
    bands = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    k, after = k[0], after[0]
    tip = sections * points
    last = (sections - 1) * points
    start = np.stack([np.full(points, tip), after, k], -1)
    end = np.stack([np.full(points, tip + 1), last + k, last + after], -1)
    return np.concatenate([bands, start, end]).astype(np.int64)


def band_of_face(sections: int, points: int) -> Ints:
    """Which band of a loft each face belongs to; the caps are −1 (start) and sections − 1 (end)."""
    bands = np.repeat(np.arange(sections - 1), 2 * points)
    return np.concatenate([bands, np.full(points, -1), np.full(points, sections - 1)])


def loft(
    rings: ArrayLike, *, tip_start: ArrayLike | None = None, tip_end: ArrayLike | None = None
) -> Part:
    """A surface through closed sections, capped at both ends.

    Args:
        rings: The sections, shape (S, K, 3), corresponding points under the same index.
        tip_start: Centre of the first cap, shape (3,); the mean of the first section by default.
        tip_end: The same of the last.
    """
    sections = np.asarray(rings, dtype=np.float64)
    start = (
        sections[0].mean(axis=0) if tip_start is None else np.asarray(tip_start, dtype=np.float64)
    )
    end = sections[-1].mean(axis=0) if tip_end is None else np.asarray(tip_end, dtype=np.float64)
    vertices = np.concatenate([sections.reshape(-1, 3), start[None], end[None]])
    return _outward(Part(vertices, _loft_faces(sections.shape[0], sections.shape[1])))


def lathe(profile: ArrayLike, *, segments: int = 24) -> Part:
    """A surface of revolution about z.

    Args:
        profile: (radius, z) from one end to the other, shape (P, 2); a radius of 0 is allowed at
            the ends only, and is then the tip of the cap.
        segments: Number of steps around; turning by 360°/segments maps the part to itself.
    """
    line = np.asarray(profile, dtype=np.float64)
    tips = [np.array([0.0, 0.0, line[end, 1]]) for end in (0, -1)]
    line = line[int(line[0, 0] <= 0.0) : len(line) - int(line[-1, 0] <= 0.0)]
    around = circle(segments)
    rings = np.empty((len(line), segments, 3))
    rings[..., :2] = line[:, None, :1] * around
    rings[..., 2] = line[:, None, 1]
    return loft(rings, tip_start=tips[0], tip_end=tips[1])


def sweep(
    path: ArrayLike, section: ArrayLike, *, scale: ArrayLike = 1.0, side: ArrayLike | None = None
) -> Part:
    """A section carried along a path.

    Args:
        path: Centre line, shape (P, 3).
        section: Closed outline, shape (K, 2): offsets along (side, tangent × side).
        scale: Factor of the section: one number, shape (P,), or shape (P, 2) for both directions.
        side: Direction that the section's first axis keeps to, shape (3,); by default the
            coordinate axis that the path runs along the least.
    """
    line = np.asarray(path, dtype=np.float64)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    if side is None:
        hint = np.zeros(3)
        hint[int(np.argmin(np.abs(tangent).max(axis=0)))] = 1.0
    else:
        hint = np.asarray(side, dtype=np.float64)
    first = hint - tangent * (tangent @ hint)[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    factor = np.asarray(scale, dtype=np.float64)
    factor = np.broadcast_to(factor[..., None] if factor.ndim == 1 else factor, (len(line), 2))
    outline = np.asarray(section, dtype=np.float64)[None] * factor[:, None, :]  # (P, K, 2)
    return loft(
        line[:, None] + outline[..., :1] * first[:, None] + outline[..., 1:] * second[:, None]
    )


def tube(path: ArrayLike, radius: ArrayLike, *, segments: int = 10) -> Part:
    """A round tube of one radius, or of one radius for each point of the path."""
    return sweep(path, circle(segments), scale=radius)


def rod(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    radius_end: float | None = None,
    *,
    segments: int = 10,
) -> Part:
    """A straight, possibly tapered round rod between two points."""
    return tube(
        np.stack([np.asarray(start, float), np.asarray(end, float)]),
        np.array([radius, radius if radius_end is None else radius_end]),
        segments=segments,
    )


def bar(
    path: ArrayLike,
    width: ArrayLike,
    depth: ArrayLike,
    *,
    side: ArrayLike = (1.0, 0.0, 0.0),
    power: float = 5.0,
) -> Part:
    """A bar of rounded rectangular section; `width` is measured along `side`.

    Width and depth are each one number or one for each point of the path.
    """
    line = np.asarray(path, dtype=np.float64)
    ones = np.ones(len(line))
    scale = np.stack([0.5 * np.asarray(width) * ones, 0.5 * np.asarray(depth) * ones], axis=1)
    return sweep(line, superellipse(1.0, 1.0, power=power, segments=12), scale=scale, side=side)


def slab(grid: ArrayLike, thickness: ArrayLike) -> Part:
    """A curved sheet: a grid of points given a thickness along its normals, half on either side.

    Args:
        grid: Middle surface, shape (M, N, 3).
        thickness: One number, or shape (M, N).
    """
    middle = np.asarray(grid, dtype=np.float64)
    normal = np.cross(np.gradient(middle, axis=0), np.gradient(middle, axis=1))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    offset = (
        0.5
        * np.broadcast_to(np.asarray(thickness, dtype=np.float64), middle.shape[:2])[..., None]
        * normal
    )
    return loft(np.concatenate([middle + offset, (middle - offset)[:, ::-1]], axis=1))


def plate(
    outline: ArrayLike, z_low: float, z_high: float, *, bevel: float = 0.0, dome: float = 0.0
) -> Part:
    """An outline in x and y given a height, with bevelled rims.

    Args:
        outline: Star-shaped about its centroid, shape (K, 2).
        z_low: Height of the underside.
        z_high: Height of the rim of the upper side.
        bevel: Width of the rounding at the rims; 0 for sharp ones.
        dome: How much the middle of the upper side stands above (or, negative, below) its rim.
    """
    points = np.asarray(outline, dtype=np.float64)
    centre = points.mean(axis=0)
    reach = float(np.abs(points - centre).max())
    levels = [(0.0, z_low), (0.0, z_high)]
    if bevel > 0.0:
        levels = [(1.0, z_low), (0.3, z_low + 0.3 * bevel), (0.0, z_low + bevel)]
        levels += [(0.0, z_high - bevel), (0.3, z_high - 0.3 * bevel), (1.0, z_high)]
    shrink = [(1.0 - inset * bevel / reach, z) for inset, z in levels]
    if dome != 0.0:
        shrink += [(shrink[-1][0] * f, z_high + dome * (1.0 - f * f)) for f in (0.75, 0.45)]
    rings = [
        np.column_stack([centre + (points - centre) * f, np.full(len(points), z)])
        for f, z in shrink
    ]
    return loft(np.stack(rings), tip_end=(*centre, z_high + dome))
