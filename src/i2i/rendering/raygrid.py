"""The rays of a square picture, and its edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from i2i.geometry.cameras import Camera

# Four samples of a pixel, as offsets from its centre in pixels (right, down): the rotated grid of
# OpenGL's multisampling. A quarter turn maps the set onto itself, so that a turned view is exactly
# the turned picture.
SAMPLE_OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))


class RayGrid:
    """Rays through the pixels of a square picture.

    Args:
        camera: Distance and field of view.
        image_size: Side of the picture in pixels.
    """

    def __init__(self, camera: Camera, image_size: int) -> None:
        self.camera = camera
        self.image_size = image_size
        half_width = float(np.tan(np.radians(camera.fov_deg) / 2))
        #: Width of a pixel on a plane one unit in front of the camera.
        self.pixel_width = 2 * half_width / image_size
        #: Unit directions in the camera frame of all pixels' centres, shape (3, S * S).
        self.directions = np.ascontiguousarray(camera.rays(image_size).reshape(-1, 3).T)
        self._samples: NDArray[np.float64] | None = None

    def samples(self, pixel: NDArray[np.int64]) -> NDArray[np.float64]:
        """Directions to the four samples of some pixels.

        Args:
            pixel: Indices into the flattened picture, shape (K,).

        Returns:
            Unit directions in the camera frame, shape (3, K, 4).
        """
        if self._samples is None:
            self._samples = self._all_samples()
        return self._samples.take(pixel, axis=1)

    def _all_samples(self) -> NDArray[np.float64]:
        """Directions to the samples of all pixels, shape (3, S * S, 4)."""
        row, column = np.divmod(np.arange(self.image_size**2), self.image_size)
        offsets = np.array(SAMPLE_OFFSETS)
        middle = 0.5 * self.image_size - 0.5
        x = (column[:, None] - middle + offsets[:, 0]) * self.pixel_width
        y = -(row[:, None] - middle + offsets[:, 1]) * self.pixel_width
        scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
        return np.stack([x * scale, y * scale, -scale])


def edge_pixels(pictures: NDArray[np.float32], threshold: float) -> NDArray[np.int64]:
    """Pixels that differ from a neighbour above, below, left or right.

    Args:
        pictures: Shape (C, N, S, S): channel, picture, row, column.
        threshold: Smallest difference in any channel that counts.

    Returns:
        Indices into the flattened pictures, ascending.
    """
    size = pictures.shape[-1]
    edge = np.zeros(pictures.shape[1:], dtype=bool)
    for stride, last in ((size, np.s_[:, -1]), (1, np.s_[..., -1])):
        # From each pixel to the next one below, or to the right, in one piece without rows; the
        # last row or column has none.
        differs = _differs(pictures.reshape(len(pictures), -1), stride, threshold)
        differs.reshape(edge.shape)[last] = False
        edge |= differs.reshape(edge.shape)
        edge.reshape(-1)[stride:] |= differs[:-stride]
    return np.flatnonzero(edge)


def _differs(values: NDArray[np.float32], stride: int, threshold: float) -> NDArray[np.bool_]:
    """Whether a pixel differs from the one `stride` further on, shape (P,) from (C, P)."""
    result = np.zeros(values.shape[1], dtype=bool)
    for channel in values:
        step = channel[stride:] - channel[:-stride]
        np.abs(step, out=step)
        result[:-stride] |= step > threshold
    return result
