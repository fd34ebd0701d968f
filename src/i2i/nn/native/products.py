"""Products of matrices where torch's leave half of the processor unused, see `products.cpp`."""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from i2i.nn.native import functions, is_built_for, library, pointer

_LEAST_MULTIPLICATIONS = 1 << 16  # below, what a call costs is more than what it saves


def multiply(left: Tensor, right: Tensor, *, out: Tensor | None = None) -> Tensor:
    """`left @ right` without a gradient.

    Args:
        left: (M, K), or n of them: (n, M, K). Of any strides, like `right`.
        right: (K, N), or n of them; one with several on the other side meets each of them.
        out: Where to write, (M, N) or (n, M, N), its rows contiguous; made if it is not given.
    """
    if not _is_fast(left, right):
        return torch.matmul(left, right, out=out)
    return _multiply(left, right, out)


def product(left: Tensor, right: Tensor) -> Tensor:
    """`left @ right` as in `multiply`, differentiable; under autocast as torch does it."""
    if torch.is_autocast_enabled(left.device.type) or not _is_fast(left, right):
        return left @ right
    result: Tensor = _Product.apply(left, right)
    return result


def linear(x: Tensor, weight: Tensor, bias: Tensor, *, relu: bool = False) -> Tensor:
    """`torch.nn.functional.linear`, clipped at 0 if wanted: x (..., K) -> (..., M).

    Args:
        x: (..., K).
        weight: (M, K).
        bias: (M,).
        relu: Whether to clip.
    """
    rows = x.flatten(0, -2)
    is_fast = _is_fast(rows, weight.mT) and bias.dtype == weight.dtype
    if torch.is_autocast_enabled(x.device.type) or not is_fast:
        out = torch.nn.functional.linear(x, weight, bias)
        return torch.relu(out) if relu else out
    flat: Tensor = _Linear.apply(rows, weight, bias, relu)
    return flat.view(*x.shape[:-1], -1)


def _is_fast(left: Tensor, right: Tensor) -> bool:
    """Whether the library multiplies these, and faster than torch."""
    return (
        _has_fast_products()
        and left.dtype == right.dtype
        and left.numel() * right.shape[-1] >= _LEAST_MULTIPLICATIONS
        and is_built_for(left, left.dtype)
        and is_built_for(right, right.dtype)
    )


@functools.cache
def _has_fast_products() -> bool:
    found = library()
    return found is not None and bool(found.i2i_has_fast_products())


def _multiply(
    left: Tensor,
    right: Tensor,
    out: Tensor | None = None,
    *,
    bias: Tensor | None = None,
    relu: bool = False,
) -> Tensor:
    batches = {len(part) for part in (left, right) if part.ndim == 3}
    if left.shape[-1] != right.shape[-2] or len(batches) > 1:
        raise ValueError(f"no product of {tuple(left.shape)} and {tuple(right.shape)}")
    sizes = (*left.shape[-2:], right.shape[-1])
    expected = (*batches, sizes[0], sizes[2])
    if out is None:
        out = left.new_empty(expected)
    elif out.shape != expected or out.dtype != left.dtype or out.stride(-1) != 1:
        raise ValueError(f"expected out of shape {expected} with rows of {left.dtype}")
    count = out.shape[0] if batches else 1
    # The one matrix of a side is met again and again: the step to the next is 0.
    steps = [
        part.stride() if part.ndim == 3 else (0, *part.stride()) for part in (left, right, out)
    ]
    shape = (count, *sizes, *steps[0], *steps[1], *steps[2][:2])
    functions().i2i_products(
        *map(pointer, (left, right, out, bias)),
        int(relu),
        (ctypes.c_int64 * len(shape))(*shape),
        int(left.dtype == torch.float64),
        torch.get_num_threads(),
    )
    return out


class _Product(torch.autograd.Function):
    """left @ right."""

    @staticmethod
    def forward(ctx: FunctionCtx, left: Tensor, right: Tensor) -> Tensor:
        ctx.save_for_backward(left, right)
        return _multiply(left, right)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        left, right = ctx.saved_tensors  # type: ignore[attr-defined]
        of_left = of_right = None
        if ctx.needs_input_grad[0]:  # type: ignore[attr-defined]
            of_left = _gradient(grad, right.mT, left)
        if ctx.needs_input_grad[1]:  # type: ignore[attr-defined]
            of_right = _gradient(left.mT, grad, right)
        return of_left, of_right


def _gradient(left: Tensor, right: Tensor, like: Tensor) -> Tensor:
    """`left @ right`, which lies as `like` does; of one matrix that met several, their sum."""
    is_turned = like.stride(-2) < like.stride(-1)
    grad = product(right.mT, left.mT).mT if is_turned else product(left, right)
    return grad.sum(dim=0) if grad.ndim > like.ndim else grad


class _Linear(torch.autograd.Function):
    """x @ weight.T + bias, clipped at 0 if wanted."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
        out = _multiply(x, weight.mT, bias=bias.contiguous(), relu=relu)
        ctx.save_for_backward(x, weight, *((out,) if relu else ()))
        return out

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, *clipped = ctx.saved_tensors  # type: ignore[attr-defined]
        for out in clipped:
            grad = torch.ops.aten.threshold_backward(grad, out, 0.0)
        of_x, of_weight, of_bias, _ = ctx.needs_input_grad  # type: ignore[attr-defined]
        return (
            product(grad, weight) if of_x else None,
            product(grad.mT, x) if of_weight else None,
            grad.sum(dim=0) if of_bias else None,
            None,
        )
