"""The layout between spectral C4 convolutions: (pixels, 4, fields, batch)."""

from __future__ import annotations

import math

from torch import Tensor

from i2i.nn.c4_spectral_constants import ORDER


def to_pixel_major(x: Tensor) -> Tensor:
    """Rearrange maps (B, C * 4, H, W), channel = field * 4 + g, to (H * W, 4, C, B)."""
    batch, channels, height, width = x.shape
    fields = x.reshape(batch, channels // ORDER, ORDER, height * width)
    return fields.permute(3, 2, 1, 0).contiguous()


def from_pixel_major(x: Tensor) -> Tensor:
    """Rearrange (H * H, 4, C, B) to square maps (B, C * 4, H, H), contiguous."""
    pixels, order, fields, batch = x.shape
    side = math.isqrt(pixels)
    return x.permute(3, 2, 1, 0).reshape(batch, fields * order, side, side)
