"""Which rays of a picture can meet an object: cheap to find, and never one too few.

The surface is covered with balls of one size. A pixel's ray can only meet the surface if the
pixel's centre is in the picture of a ball, so it is enough to mark the pixels of the balls' centres
and to let the marks grow by the largest radius that any ball has in the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from i2i.rendering.mesh import RenderMesh
from i2i.rendering.raygrid import RayGrid

# In units of the object, about 3 pixels of 128: smaller balls fit more closely, but are more work.
_SPACING = 0.03  # between points on the surface
_CELL = 0.04  # the points in one cell share a ball
_MAX_CELLS = 128  # along an axis; with a vertex far out, the cells are larger
_MAX_POINTS = 100_000  # meshes with more surface than this is enough for get larger balls
_MARGIN = 1.001  # rays that just touch a ball must survive rounding
_SLACK = 0.02  # pixels, for the same reason
_NEAREST = 1e-3  # what comes closer to the camera's plane, or lies behind it, has no picture


class Culling:
    """Balls around the surface of a mesh, as a camera sees them.

    Args:
        mesh: The object.
        rays: The camera's.
    """

    def __init__(self, mesh: RenderMesh, rays: RayGrid) -> None:
        self.mesh = mesh
        self.rays = rays
        centers, self._radius = covering_balls(mesh)
        self._centers = np.ascontiguousarray(centers.T, dtype=np.float32)
        # Distance of a ray from the origin = camera distance * sine of its angle to the axis.
        miss = rays.camera.distance * np.linalg.norm(rays.directions[:2], axis=0)
        inside = miss <= mesh.bounding_radius * _MARGIN
        self._inside = inside.reshape(rays.image_size, rays.image_size)

    def pixels(self, rotations: NDArray[np.float64]) -> NDArray[np.int64]:
        """Pixels whose ray can meet the object.

        Args:
            rotations: Object to camera of each view, shape (N, 3, 3).

        Returns:
            Indices into the flattened pictures of all views, ascending.
        """
        points = rotations.astype(np.float32) @ self._centers
        ahead = np.float32(self.rays.camera.distance) - points[:, 2]
        nearest = float(ahead.min()) - self._radius
        everything = np.stack([self._inside] * len(rotations))
        if nearest <= _NEAREST:
            return np.flatnonzero(everything)
        sides = points[:, :2] / ahead[:, None]
        # For a point within r of a centre (x, z): |x'/z' - x/z| <= r (1 + |x/z|) / (z - r).
        reach = self._radius * (1 + float(np.abs(sides).max())) / nearest / self.rays.pixel_width
        if reach > self.rays.image_size:  # marks are kept near the picture: none from so far
            return np.flatnonzero(everything)
        return np.flatnonzero(self._marked(sides, reach) & self._inside)

    def _marked(self, sides: NDArray[np.float32], reach: float) -> NDArray[np.bool_]:
        """Pixels near points of a plane one unit ahead, (N, 2, K); shape (N, S, S)."""
        size = self.rays.image_size
        grow = int(reach + 0.5 + _SLACK)  # a half for the mark's own rounding
        # So wide a border that what grows over the end of a row ends in the border of the next.
        border = grow + 1
        side = size + 2 * border
        scaled = sides / np.float32(self.rays.pixel_width)
        middle = np.float32(0.5 * size - 0.5 + border)
        column = np.clip(np.rint(middle + scaled[:, 0]), 0, side - 1).astype(np.intp)
        row = np.clip(np.rint(middle - scaled[:, 1]), 0, side - 1).astype(np.intp)
        marks = np.zeros(len(sides) * side * side, dtype=bool)
        marks[(row + side * np.arange(len(sides))[:, None]) * side + column] = True
        for stride in (1, side):
            marks = _grown(marks, stride, grow)
        return marks.reshape(-1, side, side)[:, border:-border, border:-border]


def _grown(marks: NDArray[np.bool_], stride: int, reach: int) -> NDArray[np.bool_]:
    """Marks together with all that are up to `reach` strides before or after one."""
    done = 0
    while done < reach:
        # Runs of 2 done + 1 marks; moved by no more than their length, they leave no gap.
        step = min(2 * done + 1, reach - done)
        wider = marks.copy()
        wider[step * stride :] |= marks[: -step * stride]
        wider[: -step * stride] |= marks[step * stride :]
        marks, done = wider, done + step
    return marks


def covering_balls(mesh: RenderMesh) -> tuple[NDArray[np.float64], float]:
    """Balls that together hold the whole surface: their centres, shape (K, 3), and radius."""
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    spacing = _SPACING
    while (parts := np.ceil(edges / spacing)).max() > 1 and _lattice_size(parts) > _MAX_POINTS:
        spacing *= 1.5
    points = [mesh.vertices]
    for count in np.unique(parts[parts > 1]).astype(int):
        # Barycentric coordinates of a triangle whose sides are cut into so many parts.
        first, second = np.indices((count + 1, count + 1)).reshape(2, -1)
        weights = np.stack([first, second, count - first - second], axis=1)
        weights = weights[weights[:, 2] >= 0] / count
        points.append((weights @ corners[parts == count]).reshape(-1, 3))
    centers, half_diagonal = _cell_centers(np.concatenate(points))
    # No point of a triangle is further from its nearest corner than longest side / sqrt(3).
    return centers, (spacing / np.sqrt(3.0) + half_diagonal) * _MARGIN


def _cell_centers(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centres of the cells of a cubic grid that hold a point, (K, 3), and half their diagonal."""
    # Numpy takes minima over long columns much faster than over rows of three.
    columns = np.ascontiguousarray(points.T)
    low, high = columns.min(axis=1), columns.max(axis=1)
    size = max(_CELL, float((high - low).max()) / _MAX_CELLS)
    first, second, third = ((columns - low[:, None]) * (1 / size)).astype(np.intp)
    shape = (int(first.max()) + 1, int(second.max()) + 1, int(third.max()) + 1)
    used = np.zeros(shape[0] * shape[1] * shape[2], dtype=bool)
    used[(first * shape[1] + second) * shape[2] + third] = True
    cells = np.stack(np.unravel_index(np.flatnonzero(used), shape), axis=1)
    return low + (cells + 0.5) * size, size * np.sqrt(3.0) / 2


def _lattice_size(parts: NDArray[np.float64]) -> float:
    """Points on triangles whose sides are cut into so many parts, shape (F,)."""
    return float(((parts + 1) * (parts + 2) / 2)[parts > 1].sum())
