"""Batch norm of regular C4 fields, in both layouts."""

from functools import partial

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from i2i.nn import native
from i2i.nn.batch_norm import JointBatchNorm2d, joint_moments, update_running
from i2i.nn.c4_basis import TURNS
from i2i.nn.processes import num_processes, sum_over_processes


class C4BatchNorm(JointBatchNorm2d):
    """Batch norm with one affine pair per regular field, statistics pooled over the four turns.

    Where processes share a batch, the statistics are those of all of it.

    Shape:
        (B, 4 · num_fields, H, W) -> the same.

    Example:
        >>> C4BatchNorm(3)(torch.randn(2, 12, 5, 5)).shape
        torch.Size([2, 12, 5, 5])
    """

    def forward(self, input: Tensor) -> Tensor:
        """Normalise `input` (B, 4 · num_fields, H, W)."""
        batch, channels, height, width = input.shape
        # One row per field: (B, F, 4·H, W), a view of a contiguous tensor. torch's channels-last
        # batch norm is much less accurate in float32: rows are made contiguous where they are not.
        rows = input.reshape(batch, channels // TURNS, TURNS * height, width)
        return super().forward(rows).view(batch, channels, height, width)

    def pixel_major(
        self, x: Tensor, *, shortcut: Tensor | None = None, relu: bool = False
    ) -> Tensor:
        """The same on pixel-major maps (pixels, 4, num_fields, B), then add and clip."""
        if self._is_compiled(x, shortcut):
            return self._compiled(x, shortcut, relu=relu)
        out = super().forward(x.flatten(0, 1)[..., None])
        if shortcut is not None:
            out = out.add_(shortcut.view(out.shape))
        # Before the view: autograd would copy around an operation in place on one.
        return (torch.relu_(out) if relu else out).view(x.shape)

    def _is_compiled(self, x: Tensor, shortcut: Tensor | None) -> bool:
        """Whether `native` does it: not where a gradient passes and the moments are constants."""
        if self.running_mean is None or self.weight is None:
            return False
        fits = x.dtype == self.weight.dtype and x.shape[-2] == self.num_features
        if shortcut is not None:
            fits &= (shortcut.shape, shortcut.dtype) == (x.shape, x.dtype)
        if not fits or not native.is_built_for(x, x.dtype):
            return False
        return self.training or not torch.is_grad_enabled()

    def _compiled(self, x: Tensor, shortcut: Tensor | None, *, relu: bool) -> Tensor:
        if not self.training:
            mean, var = self.running_mean, self.running_var
            assert mean is not None
            assert var is not None
            moments = torch.stack([mean, var]).double()
            return native.norm(
                x, shortcut, self.weight, self.bias, moments, eps=self.eps, relu=relu, fresh=False
            )
        batch = _Batch()
        out: Tensor = _Norm.apply(x, shortcut, self.weight, self.bias, batch, self.eps, relu)
        update_running(self, *batch.moments, count=batch.moments.new_tensor(batch.count))
        return out


class _Batch:
    """What `_Norm` finds: mean and biased variance (2, F), float64, and of how many numbers."""

    moments: Tensor
    count: float


class _Norm(torch.autograd.Function):
    """relu(norm(x) + shortcut), with the moments of the batch of all processes."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        x: Tensor,
        shortcut: Tensor | None,
        weight: Tensor,
        bias: Tensor,
        batch: _Batch,
        eps: float,
        relu: bool,
    ) -> Tensor:
        x = x.contiguous()
        fields = len(weight)
        batch.count = x.numel() / fields
        is_shared = num_processes() > 1
        if is_shared:
            mean, var = native.norm_moments(x)
            mean, var, total = joint_moments(mean, var, x.numel() // fields)
            batch.moments, batch.count = torch.stack([mean, var]), total.item()
        else:
            batch.moments = x.new_empty(2, fields, dtype=torch.float64)
        options = {"eps": eps, "relu": relu, "fresh": not is_shared}
        y = native.norm(x, shortcut, weight, bias, batch.moments, **options)  # type: ignore[arg-type]
        ctx.save_for_backward(x, weight, batch.moments, *([y] if relu else []))
        ctx.eps, ctx.count = eps, batch.count  # type: ignore[attr-defined]
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, moments, *clipped = ctx.saved_tensors  # type: ignore[attr-defined]
        eps, has_shortcut = ctx.eps, ctx.needs_input_grad[1]  # type: ignore[attr-defined]
        backward = partial(
            native.norm_backward, grad, clipped[0] if clipped else None, x, weight, moments, eps=eps
        )
        if num_processes() > 1:
            # Of the losses of all processes: every one of them changes with the shared moments.
            *_, sums = backward(wants=(False, False))
            given = (*sum_over_processes(sums), ctx.count)  # type: ignore[attr-defined]
            of_x, of_shortcut, _ = backward(wants=(True, has_shortcut), given=given)
        else:
            of_x, of_shortcut, sums = backward(wants=(True, has_shortcut))
        of_weight = (sums[1] / (moments[1] + eps).sqrt()).to(weight)
        return of_x, of_shortcut, of_weight, sums[0].to(weight), None, None, None
