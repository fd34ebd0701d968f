"""The icosahedral correlation in one pass over the images, see `correlation.cpp`."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from i2i.nn.native import functions, in_order, is_built_for, pointer


def can_correlate(signal: Tensor, spheres: Tensor) -> bool:
    """Whether the library takes them: of one type, not under autocast, and not traced."""
    return (
        signal.dtype == spheres.dtype
        and not torch.is_autocast_enabled(signal.device.type)
        and is_built_for(signal, signal.dtype)
        and is_built_for(spheres, signal.dtype)
    )


def correlate(signal: Tensor, spheres: Tensor, index: Tensor | None, moved: Tensor) -> Tensor:
    """`out[b, g, m] = Σ_v Σ_n spheres[index[b], moved[v, g], n] signal[b, v, n, m]`.

    Differentiable once in signal and spheres; only where :func:`can_correlate`.

    Args:
        signal: (B, H, n · m), channel `i · m + j`.
        spheres: (S, V, n).
        index: (B,), or one for all, into the spheres; None takes the first.
        moved: (H, elements), int32: the place of the sphere that an element puts against each v.

    Returns:
        (B, elements, m).

    Raises:
        IndexError: If an index has no sphere.
    """
    if index is not None:
        index = index.long().expand(len(signal))
        if not 0 <= int(index.min()) <= int(index.max()) < len(spheres):
            raise IndexError(f"spheres 0 to {len(spheres) - 1}, got the index {index.tolist()}")
    out: Tensor = _Correlate.apply(signal, spheres, index, moved)
    return out


class _Correlate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, signal: Tensor, spheres: Tensor, index: Tensor | None, moved: Tensor
    ) -> Tensor:
        signal, spheres = signal.contiguous(), spheres.contiguous()
        index = None if index is None else index.contiguous()
        outputs = signal.shape[2] // spheres.shape[2]
        out = signal.new_empty(len(signal), moved.shape[1], outputs)
        functions().i2i_correlate(
            *map(pointer, (signal, spheres, index, moved, out)), *_sizes(signal, spheres, moved)
        )
        ctx.save_for_backward(signal, spheres, index, moved)  # type: ignore[arg-type]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        signal, spheres, index, moved = ctx.saved_tensors  # type: ignore[attr-defined]
        wants_signal, wants_spheres, *_ = ctx.needs_input_grad  # type: ignore[attr-defined]
        of_signal = torch.empty_like(signal) if wants_signal else None
        of_spheres = torch.zeros_like(spheres) if wants_spheres else None
        grad = in_order(grad)  # with a name: it has to last until the call is over
        functions().i2i_correlate_backward(
            *map(pointer, (grad, signal, spheres, index, moved, of_signal, of_spheres)),
            *_sizes(signal, spheres, moved),
        )
        return of_signal, of_spheres, None, None


def _sizes(signal: Tensor, spheres: Tensor, moved: Tensor) -> tuple[object, ...]:
    """The last arguments of both functions."""
    count, places, features = spheres.shape
    batch, length, channels = signal.shape
    shape = (batch, length, features, channels // features, count, places, moved.shape[1])
    return (
        (ctypes.c_int64 * len(shape))(*shape),
        int(signal.dtype == torch.float64),
        torch.get_num_threads(),
    )
