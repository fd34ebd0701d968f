"""Directions on maps of the sphere: longitude, latitude, and where north and east are."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from i2i.viz.style import ImageArray, to_numpy

MapAxis = Literal["view", "object"]

_POLE = 1.0 - 1e-9
# Map of the camera frame: the viewer's way (z) in its middle, right (x) is right, up (y) is up.
_MAP_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def longitude_latitude(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitude in (−π, π] and latitude in [−π/2, π/2] of unit vectors (..., 3), radians."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))


def compass(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """East and north at each direction, each (N, 3); at a pole as if it lay on longitude 0."""
    x, y, z = directions.T
    longitude = np.where(np.abs(z) > _POLE, 0.0, np.arctan2(y, x))
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=1)
    return east, np.cross(directions, east)


def map_coordinates(
    rotations: ImageArray, axis: MapAxis = "view"
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rotations lie on the map, and their turn in its plane.

    A rotation is a direction and a turn about it, ``Rz(longitude) Ry(90° − latitude) Rz(turn)`` of
    the map's frame, and both frames of an object → camera rotation can be that of the map:

    - ``"view"``: the object's frame. The position says from where the camera looks at the object,
      the turn where the camera's up axis points on the map.
    - ``"object"``: the camera's frame, the viewer's way in the middle, right on the right and up at
      the top. The position says where the object's z axis points, the turn where its y axis points.

    Args:
        rotations: Object → camera, shape (N, 3, 3).
        axis: Which of the two.

    Returns:
        Longitude and latitude in radians, and the turn in degrees in [0, 360), counter-clockwise
        from east; each (N,). At the poles east is that of longitude 0.

    Raises:
        ValueError: if the shape or the axis is another.
    """
    if axis not in get_args(MapAxis):
        raise ValueError(f"axis={axis!r} is unknown. Allowed: {', '.join(get_args(MapAxis))}.")
    turns = to_numpy(rotations).astype(np.float64)
    if turns.ndim != 3 or turns.shape[1:] != (3, 3):
        raise ValueError(f"map_coordinates wants rotations of shape (N, 3, 3), got {turns.shape}.")
    frames = turns.transpose(0, 2, 1) if axis == "view" else _MAP_FROM_CAMERA @ turns
    direction, up = frames[:, :, 2], frames[:, :, 1]
    east, north = compass(direction)
    turn = np.degrees(np.arctan2((up * north).sum(axis=1), (up * east).sum(axis=1))) % 360.0
    return *longitude_latitude(direction), np.where(turn >= 360.0, 0.0, turn)
