"""The rays of a square picture, and which of them can meet an object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from i2i.geometry.cameras import Camera

# Four samples of a pixel, as offsets from its centre in pixels (right, down): the rotated grid of
# OpenGL's multisampling. A quarter turn maps the set onto itself, so that a turned view is exactly
# the turned picture.
SAMPLE_OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))

_CULL_MARGIN = 1.001  # rays that touch the bounding sphere must survive rounding
_BOX_SLACK = 0.01  # pixels, for the same reason


class RayGrid:
    """Rays through the pixel centres, and which of them can meet an object in a sphere.

    Args:
        camera: Distance and field of view.
        image_size: Side of the picture in pixels.
        radius: Of the sphere that holds the object.
    """

    def __init__(self, camera: Camera, image_size: int, radius: float) -> None:
        self.camera = camera
        self.image_size = image_size
        self.radius = radius
        self.half_width = float(np.tan(np.radians(camera.fov_deg) / 2))
        #: Width of a pixel on a plane one unit in front of the camera.
        self.pixel_width = 2 * self.half_width / image_size
        directions = camera.rays(image_size).reshape(-1, 3)
        # Distance of a ray from the origin = camera distance * sine of its angle to the axis.
        miss = camera.distance * np.linalg.norm(directions[:, :2], axis=1)
        self._inside = (miss <= radius * _CULL_MARGIN).reshape(image_size, image_size)
        #: Unit directions in the camera frame of all pixels, shape (S * S, 3).
        self.directions = directions

    def around(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Pixels whose ray can meet an object: in the sphere, and in the box around its picture.

        Args:
            points: The object's vertices relative to the camera, in its axes, shape (V, 3).

        Returns:
            Indices into the flattened picture, ascending.
        """
        size = self.image_size
        ahead = -points[:, 2]
        if ahead.min() <= 1e-3:  # something beside or behind the camera: its picture has no box
            return np.flatnonzero(self._inside)
        middle = 0.5 * size - 0.5
        column = middle + points[:, 0] / ahead / self.pixel_width
        row = middle - points[:, 1] / ahead / self.pixel_width
        low = np.floor([row.min() - _BOX_SLACK, column.min() - _BOX_SLACK])
        high = np.ceil([row.max() + _BOX_SLACK, column.max() + _BOX_SLACK])
        top, left = np.clip(low, 0, size).astype(int)
        bottom, right = np.clip(high + 1, 0, size).astype(int)
        rows, columns = np.nonzero(self._inside[top:bottom, left:right])
        return (rows + top) * size + columns + left

    def samples(self, pixel: NDArray[np.int64]) -> NDArray[np.float64]:
        """Directions to the four samples of some pixels.

        Args:
            pixel: Indices into the flattened picture, shape (K,).

        Returns:
            Unit directions in the camera frame, shape (K, 4, 3).
        """
        row, column = np.divmod(pixel, self.image_size)
        offsets = np.array(SAMPLE_OFFSETS)
        middle = 0.5 * self.image_size - 0.5
        x = (column[:, None] - middle + offsets[:, 0]) * self.pixel_width
        y = -(row[:, None] - middle + offsets[:, 1]) * self.pixel_width
        scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
        return np.stack([x * scale, y * scale, -scale], axis=-1)


def edge_pixels(picture: NDArray[np.float32], threshold: float) -> NDArray[np.int64]:
    """Pixels that differ from a neighbour above, below, left or right.

    Args:
        picture: Shape (C, S, S).
        threshold: Smallest difference in any channel that counts.

    Returns:
        Indices into the flattened picture.
    """
    edge = np.zeros(picture.shape[1:], dtype=bool)
    below = (np.abs(picture[:, 1:] - picture[:, :-1]) > threshold).any(axis=0)
    beside = (np.abs(picture[:, :, 1:] - picture[:, :, :-1]) > threshold).any(axis=0)
    edge[1:] |= below
    edge[:-1] |= below
    edge[:, 1:] |= beside
    edge[:, :-1] |= beside
    return np.flatnonzero(edge)
