"""Augmentation of whole batches: pixel shifts and depth shifts.

Randomness comes from hashed counters, not from a generator with a state, so that what happens to a
sample depends on its key alone and never on how the samples were grouped or loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from i2i.geometry.seeding import uniform_hash

REFERENCE_SIZE = 128
"""Image size, in pixels, in which shifts are configured."""

BACKGROUND = 255
"""Background of every modality in the rendered store."""

_ROW, _COLUMN, _DEPTH = 1, 2, 3  # one independent random stream each


def scaled_shift(shift_px: float, image_size: int) -> float:
    """Largest shift in the image's own pixels, for a setting in pixels of a 128 px image.

    Raises:
        ValueError: if the setting is negative, or as large as the image.

    Example:
        >>> scaled_shift(3, 128), scaled_shift(5, 64), scaled_shift(0, 32)
        (3.0, 2.5, 0.0)
    """
    if not 0 <= shift_px < REFERENCE_SIZE / 2:
        raise ValueError(
            f"A pixel shift of {shift_px} is not allowed: it is in pixels of a "
            f"{REFERENCE_SIZE} px image, from 0 to {REFERENCE_SIZE // 2 - 1}."
        )
    return shift_px * image_size / REFERENCE_SIZE


def shift_images(images: np.ndarray, offsets: np.ndarray, *, fill: int = BACKGROUND) -> np.ndarray:
    """Move each image by whole pixels and fill the border that appears.

    Args:
        images: Shape (B, C, H, W).
        offsets: Shape (B, 2), integers: rows downwards, columns to the right.
        fill: Value of the border.

    Returns:
        Shape (B, C, H, W), same dtype: ``out[b, :, i + r, j + c] = images[b, :, i, j]``.
    """
    height, width = images.shape[-2:]
    shifted = np.full_like(images, fill)
    for image, target, (row, column) in zip(images, shifted, offsets.tolist(), strict=True):
        # Slices of single images are copied faster than one gather over the batch.
        target[:, max(row, 0) : height + min(row, 0), max(column, 0) : width + min(column, 0)] = (
            image[:, max(-row, 0) : height - max(row, 0), max(-column, 0) : width - max(column, 0)]
        )
    return shifted


def to_float(images: np.ndarray) -> np.ndarray:
    """Turn stored uint8 images into float32 in [0, 1], same shape."""
    return np.divide(images, np.float32(255), dtype=np.float32)


def shift_depth(images: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Move the surface of depth images along the rays, in place; the background stays 1.

    The nearest depth and the background are both 1 (as in the paper's renders), so a surface pixel
    that is stored as 1 cannot be told from the background and is left alone.

    Args:
        images: Shape (B, C, H, W), float32 in [0, 1].
        offsets: Shape (B,), in normalised depth: 1 is the object's diameter of 2 units.

    Returns:
        ``images``.
    """
    for image, offset in zip(images, offsets.astype(np.float32), strict=True):
        # Image by image, all steps stay in the processor's cache. No value may fall below its
        # floor: 1 for the background, 0 for the surface.
        floor = (image >= 1.0).astype(np.float32)
        image += offset
        np.maximum(image, floor, out=image)
        np.minimum(image, np.float32(1.0), out=image)
    return images


@dataclass(frozen=True)
class Augmentation:
    """Shifts of a batch; the same for a sample with the same key.

    Attributes:
        shift_px: Largest shift s of each axis in the image's own pixels (see `scaled_shift`): whole
            numbers, uniform from −s to s (paper: ±3 at 128 px); for s = 2.5, ±3 are half as likely.
        depth_shift: Largest shift along the rays in percent of the object's diameter; depth only.
        seed: Seed of the draws.
    """

    shift_px: float = 0.0
    depth_shift: float = 0.0
    seed: int = 0

    def __call__(self, images: np.ndarray, keys: Sequence[np.ndarray]) -> np.ndarray:
        """Shift a batch and turn it into floats.

        Args:
            images: Shape (B, C, H, W), uint8.
            keys: Integer arrays, each of shape (B,), that together name a sample.

        Returns:
            Shape (B, C, H, W), float32 in [0, 1].
        """
        if self.shift_px:
            images = shift_images(images, self.pixel_offsets(keys))
        result = to_float(images)
        return shift_depth(result, self.depth_offsets(keys)) if self.depth_shift else result

    def pixel_offsets(self, keys: Sequence[np.ndarray]) -> np.ndarray:
        """Row and column shifts of the samples with these keys, shape (B, 2), int64."""
        draws = np.stack([self._draw(stream, keys) for stream in (_ROW, _COLUMN)], axis=1)
        return np.floor(draws * (2 * self.shift_px + 1) - self.shift_px).astype(np.int64)

    def depth_offsets(self, keys: Sequence[np.ndarray]) -> np.ndarray:
        """Depth shifts of the samples with these keys, shape (B,), in normalised depth."""
        return (2.0 * self._draw(_DEPTH, keys) - 1.0) * self.depth_shift / 100.0

    def _draw(self, stream: int, keys: Sequence[np.ndarray]) -> np.ndarray:
        return uniform_hash(self.seed, np.full(len(keys[0]), stream), *keys)
