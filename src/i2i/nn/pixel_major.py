"""The layout between spectral C4 convolutions: (pixels, 4, fields, batch)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from i2i.nn import native
from i2i.nn.c4_spectral_constants import ORDER


def to_pixel_major(x: Tensor) -> Tensor:
    """Rearrange maps (B, C * 4, H, W), channel = field * 4 + g, to (H * W, 4, C, B)."""
    moved: Tensor = _TurnOver.apply(x.flatten(2), True)
    return moved


def from_pixel_major(x: Tensor) -> Tensor:
    """Rearrange (H * H, 4, C, B) to square maps (B, C * 4, H, H), contiguous."""
    side = math.isqrt(len(x))
    moved: Tensor = _TurnOver.apply(x, False)
    return moved.unflatten(2, (side, side))


def turn_max(x: Tensor) -> Tensor:
    """The largest of each field's four turns: (P, 4, C, B) -> (P, C, B)."""
    if native.is_built_for(x, x.dtype) and x.shape[1] == ORDER:
        largest: Tensor = _TurnMax.apply(x)
        return largest
    return x.amax(dim=1)


def _turn_over(x: Tensor, to_pixel_major: bool) -> Tensor:
    fits = x.shape[1] % ORDER == 0 if to_pixel_major else x.shape[1] == ORDER
    if fits and native.is_built_for(x, x.dtype):
        return native.turn_over(x, to_pixel_major=to_pixel_major)
    if to_pixel_major:
        return x.unflatten(1, (-1, ORDER)).permute(3, 2, 1, 0).contiguous()
    return x.permute(3, 2, 1, 0).flatten(1, 2).contiguous()


class _TurnOver(torch.autograd.Function):
    """(B, 4 C, P) to (P, 4, C, B), or back, which is also the way of the gradients."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, to_pixel_major: bool) -> Tensor:
        ctx.to_pixel_major = to_pixel_major  # type: ignore[attr-defined]
        return _turn_over(x, to_pixel_major)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        back: Tensor = _TurnOver.apply(grad, not ctx.to_pixel_major)  # type: ignore[attr-defined]
        return back, None


class _TurnMax(torch.autograd.Function):
    """amax over turns; torch passes several times over the maps for its gradient."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.amax(dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> Tensor:
        return native.turn_max_backward(ctx.saved_tensors[0], grad)  # type: ignore[attr-defined]
