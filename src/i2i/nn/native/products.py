"""Products of matrices where torch's leave half of the processor unused, see `products.cpp`."""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from i2i.nn.native import functions, in_order, is_built_for, library, pointer
from i2i.nn.precision import full_precision

_LEAST_MULTIPLICATIONS = 1 << 16  # below, what a call costs is more than what it saves


@torch.no_grad()
def multiply(left: Tensor, right: Tensor, *, out: Tensor | None = None) -> Tensor:
    """`left @ right` without a gradient, in the type of the two, under autocast as well.

    Args:
        left: (M, K), or n of them: (n, M, K). Of any strides, like `right`.
        right: (K, N), or n of them; one with several on the other side meets each of them.
        out: Where to write, (M, N) or (n, M, N), its rows contiguous; made if it is not given.
    """
    if _is_fast(left, right):
        return _multiply(left, right, out)
    with full_precision(left):
        return torch.matmul(left, right, out=out)


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
    fits = bias.dtype == weight.dtype and bias.shape == weight.shape[:1]
    rows = x.flatten(0, -2) if x.ndim > 2 else x
    if torch.is_autocast_enabled(x.device.type) or not (fits and _is_fast(rows, weight.mT)):
        out = torch.nn.functional.linear(x, weight, bias)
        return torch.relu(out) if relu else out
    flat: Tensor = _Linear.apply(rows, weight, bias, relu)
    return flat.view(*x.shape[:-1], -1)


class Linear(nn.Linear):
    """`nn.Linear` by :func:`linear`.

    Args:
        in_features: K.
        out_features: M.
        relu: Whether what comes out is clipped at 0.

    Shape:
        (..., K) -> (..., M).
    """

    def __init__(self, in_features: int, out_features: int, *, relu: bool = False) -> None:
        super().__init__(in_features, out_features)
        self.relu = relu

    def forward(self, input: Tensor) -> Tensor:
        """(..., in_features) -> (..., out_features)."""
        return linear(input, self.weight, self.bias, relu=self.relu)

    def extra_repr(self) -> str:
        """As torch's, and whether it clips."""
        return super().extra_repr() + (", relu" if self.relu else "")


def _is_fast(left: Tensor, right: Tensor) -> bool:
    """Whether the library multiplies these, and faster than torch."""
    return (
        is_built_for(left, left.dtype)
        and is_built_for(right, left.dtype)
        and left.dtype == right.dtype
        and {left.ndim, right.ndim} <= {2, 3}
        and (left.ndim != right.ndim or left.shape[:-2] == right.shape[:-2])
        and left.numel() * right.shape[-1] >= _LEAST_MULTIPLICATIONS
        and _has_fast_products()
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
    if left.shape[-1] != right.shape[-2]:
        raise ValueError(f"no product of {tuple(left.shape)} and {tuple(right.shape)}")
    batch = left.shape[:-2] or right.shape[:-2]
    sizes = (*left.shape[-2:], right.shape[-1])
    expected = (*batch, sizes[0], sizes[2])
    if out is None:
        out = left.new_empty(expected)
    like = (out.shape, out.dtype, out.device, out.stride(-1))
    if like != (expected, left.dtype, left.device, 1):
        raise ValueError(f"expected out of shape {expected} with rows of {left.dtype}, got {like}")
    count = batch[0] if batch else 1
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
        of_left, of_right = ctx.needs_input_grad  # type: ignore[attr-defined]
        ctx.like = _layout(left), _layout(right)  # type: ignore[attr-defined]
        # As torch does: only what the wanted gradients need.
        ctx.save_for_backward(left if of_right else None, right if of_left else None)  # type: ignore[arg-type]
        return _multiply(left, right)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        left, right = ctx.saved_tensors  # type: ignore[attr-defined]
        like_left, like_right = ctx.like  # type: ignore[attr-defined]
        return (
            None if right is None else _gradient(grad, right.mT, *like_left),
            None if left is None else _gradient(left.mT, grad, *like_right),
        )


def _layout(operand: Tensor) -> tuple[int, bool]:
    """Its dimensions, and whether it lies column by column."""
    return operand.ndim, operand.stride(-2) < operand.stride(-1)


def _gradient(left: Tensor, right: Tensor, ndim: int, is_turned: bool) -> Tensor:
    """`left @ right`, which lies as the operand does; of one matrix that met several, their sum."""
    grad = product(right.mT, left.mT).mT if is_turned else product(left, right)
    return grad.sum(dim=0) if grad.ndim > ndim else grad


class _Linear(torch.autograd.Function):
    """x @ weight.T + bias, clipped at 0 if wanted."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
        out = _multiply(x, weight.mT, bias=in_order(bias), relu=relu)
        of_x, of_weight, *_ = ctx.needs_input_grad  # type: ignore[attr-defined]
        kept = [x if of_weight else None, weight if of_x else None, *([out] if relu else [])]
        ctx.save_for_backward(*kept)  # type: ignore[arg-type]
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
