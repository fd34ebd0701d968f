"""What a network saw as pictures: an image as it is, a cloud from the front, views side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from i2i.viz.style import ImageArray, to_numpy

_CLOUD_SIZE = 96
_DOT = 1  # pixels around a point that it fills
_FARTHEST, _NEAREST = 0.75, 0.1  # gray values of a cloud's points


def input_pictures(batch: Mapping[str, ImageArray]) -> np.ndarray:
    """One picture for each sample of a batch.

    Args:
        batch: With `image` (B, C, H, W) or `views` (B, V, C, H, W), both in [0, 1], or `points`
            (B, P, 3) in the camera's axes, of norm at most 1.

    Returns:
        Shape (B, C, S, S') in [0, 1]; clouds are seen along the camera's axis, near points dark.

    Raises:
        ValueError: if the batch has none of them.
    """
    if "image" in batch:
        return to_numpy(batch["image"])
    if "points" in batch:
        return np.stack([cloud_picture(points) for points in to_numpy(batch["points"])])
    if "views" in batch:
        return tiled(to_numpy(batch["views"]))
    raise ValueError(
        f"a batch of {', '.join(batch)} has nothing to draw: no image, points or views"
    )


def cloud_picture(points: np.ndarray, size: int = _CLOUD_SIZE) -> np.ndarray:
    """Orthographic picture of points (P, 3) in the unit ball, shape (1, size, size), float32."""
    picture = np.ones((size, size), np.float32)
    order = np.argsort(points[:, 2])  # far ones first: near ones are drawn over them
    x, y, z = points[order].T
    column, row = (((axis + 1) / 2 * (size - 1)).round().astype(int) for axis in (x, -y))
    gray = _FARTHEST + (_NEAREST - _FARTHEST) * np.clip((z + 1) / 2, 0, 1)
    offsets = range(-_DOT, _DOT + 1)
    for down in offsets:
        for right in offsets:
            places = (np.clip(row + down, 0, size - 1), np.clip(column + right, 0, size - 1))
            picture[places] = gray
    return picture[None]


def tiled(views: np.ndarray) -> np.ndarray:
    """Views (B, V, C, H, W) side by side in nearly square tables: (B, C, rows·H, columns·W)."""
    batch, count, channels, height, width = views.shape
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    table = np.ones((batch, rows * columns, channels, height, width), views.dtype)
    table[:, :count] = views
    table = table.reshape(batch, rows, columns, channels, height, width)
    return table.transpose(0, 3, 1, 4, 2, 5).reshape(
        batch, channels, rows * height, columns * width
    )
