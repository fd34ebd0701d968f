"""Texture look-up with prefiltered levels, so that fine patterns do not flicker at 128 px."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class TexturePyramid:
    """A texture and its halvings (a mipmap); repeats outside [0, 1], as OBJ and glTF expect.

    Args:
        texture: sRGB picture, shape (h, w, 3), uint8, first row on top.
    """

    def __init__(self, texture: NDArray[np.uint8]) -> None:
        level = texture.astype(np.float32) / 255.0
        self.levels: list[NDArray[np.float32]] = [level]
        while min(level.shape[:2]) > 1:
            height, width = (side // 2 * 2 for side in level.shape[:2])
            even = level[:height, :width]
            level = even.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
            self.levels.append(level)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the finest level."""
        height, width = self.levels[0].shape[:2]
        return height, width

    def sample(self, uv: NDArray[np.float64], texels: NDArray[np.float64]) -> NDArray[np.float32]:
        """Bilinear colours from the level whose texels are about as large as a pixel.

        Args:
            uv: Texture coordinates, shape (N, 2): u to the right, v up from the bottom row.
            texels: Width in texels that one pixel covers, shape (N,).

        Returns:
            sRGB colours in [0, 1], shape (N, 3).
        """
        wanted = np.rint(np.log2(np.maximum(texels, 1.0))).astype(np.int64)
        chosen = np.minimum(wanted, len(self.levels) - 1)
        colors = np.empty((len(uv), 3), dtype=np.float32)
        for index in np.unique(chosen):
            here = chosen == index
            colors[here] = _bilinear(self.levels[index], uv[here])
        return colors


def _bilinear(level: NDArray[np.float32], uv: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours between the centres of the four nearest texels, shape (N, 3)."""
    height, width = level.shape[:2]
    column = (uv[:, 0] % 1.0) * width - 0.5
    row = (1.0 - uv[:, 1] % 1.0) * height - 0.5
    left = np.floor(column).astype(np.int64)
    top = np.floor(row).astype(np.int64)
    right_weight = (column - left).astype(np.float32)[:, None]
    down_weight = (row - top).astype(np.float32)[:, None]
    left, right = left % width, (left + 1) % width
    top, down = top % height, (top + 1) % height
    upper = level[top, left] * (1 - right_weight) + level[top, right] * right_weight
    lower = level[down, left] * (1 - right_weight) + level[down, right] * right_weight
    blended: NDArray[np.float32] = upper * (1 - down_weight) + lower * down_weight
    return blended


def texel_density(
    uv: NDArray[np.float64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Square root of texture area per surface area of each face, shape (F,).

    Times the texture's width (or height) it is the number of texels in a unit of length.

    Args:
        uv: Corner coordinates, shape (F, 3, 2).
        vertices: Shape (V, 3).
        faces: Shape (F, 3).
    """
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    texture_area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    surface_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    density: NDArray[np.float64] = np.sqrt(texture_area / np.maximum(surface_area, 1e-12))
    return density
