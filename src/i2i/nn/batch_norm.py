"""Batch norm whose statistics are those of the whole batch, also where processes share it.

With one process these are torch's own layers. With several (DDP) each has a part of the batch, and
the moments are taken over all parts, so that a run computes what one process with the joint batch
does; `torch.nn.SyncBatchNorm` does so too, but refuses tensors of a CPU and knows no C4 fields.
"""

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx, once_differentiable
from torch.nn.modules.batchnorm import _NormBase

from i2i.nn.precision import at_least_float32
from i2i.nn.processes import gather_from_processes, num_processes, sum_over_processes


@torch.no_grad()
def update_running(
    norm: nn.BatchNorm1d | nn.BatchNorm2d, mean: Tensor, var: Tensor, *, count: Tensor
) -> None:
    """Running statistics as torch keeps them: with the unbiased variance.

    Args:
        norm: Whose statistics.
        mean: (C,) of the batch.
        var: (C,) of the batch, biased.
        count: How many numbers of a channel they were taken from.
    """
    if norm.running_mean is None or norm.running_var is None or norm.num_batches_tracked is None:
        return
    norm.num_batches_tracked.add_(1)
    momentum = norm.momentum
    if momentum is None:
        momentum = 1.0 / float(norm.num_batches_tracked)
    unbiased = var * (count / (count - 1).clamp(min=1))
    norm.running_mean.lerp_(mean.to(norm.running_mean), momentum)
    norm.running_var.lerp_(unbiased.to(norm.running_var), momentum)


class _Joint:
    """Forward of a batch norm in training over several processes; torch's own otherwise."""

    def forward(self, input: Tensor) -> Tensor:
        """Normalise `input` (N, C, ...)."""
        if not self.training or num_processes() == 1:  # type: ignore[attr-defined]
            normalised: Tensor = super().forward(input)  # type: ignore[misc]
            return normalised
        self._check_input_dim(input)  # type: ignore[attr-defined]
        return _joint_batch_norm(self, input)  # type: ignore[arg-type]


class JointBatchNorm1d(_Joint, nn.BatchNorm1d):
    """`nn.BatchNorm1d` over the batch of all processes.

    Example:
        >>> JointBatchNorm1d(3)(torch.randn(5, 3)).shape
        torch.Size([5, 3])
    """


class JointBatchNorm2d(_Joint, nn.BatchNorm2d):
    """`nn.BatchNorm2d` over the batch of all processes.

    Example:
        >>> JointBatchNorm2d(3)(torch.randn(2, 3, 4, 4)).shape
        torch.Size([2, 3, 4, 4])
    """


def statistics_are_joint(module: nn.Module) -> bool:
    """Whether no norm within keeps statistics of its own process's part of a batch."""
    return not any(
        isinstance(part, _NormBase) and not isinstance(part, _Joint) for part in module.modules()
    )


def _joint_batch_norm(norm: nn.BatchNorm1d | nn.BatchNorm2d, x: Tensor) -> Tensor:
    channels = x.shape[1]
    weight = x.new_ones(channels) if norm.weight is None else norm.weight
    bias = x.new_zeros(channels) if norm.bias is None else norm.bias
    mean, var, count = _joint_moments(x.detach())
    update_running(norm, mean, var, count=count)
    normalised: Tensor = _Normalise.apply(x, weight, bias, mean, (var + norm.eps).rsqrt(), count)
    return normalised


def _joint_moments(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and biased variance of each channel over all processes, float64, and the count."""
    var, mean = torch.var_mean(at_least_float32(x), _others(x), correction=0)
    return joint_moments(mean, var, x.numel() // x.shape[1])


def joint_moments(mean: Tensor, var: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The moments over all processes, float64, from those of this one, (C,); and the joint count.

    Every process tells its own two and they are put together: var = E[var_r + (mean_r − mean)²],
    which keeps the digits that E[x²] − mean² would lose.
    """
    ours = torch.cat([mean.double(), var.double(), mean.new_full((1,), count, dtype=torch.float64)])
    together = gather_from_processes(ours)
    means, variances = together[:, :-1].unflatten(1, (2, -1)).unbind(dim=1)  # (processes, C)
    total = together[:, -1].sum()
    shares = together[:, -1:] / total
    joint = (shares * means).sum(dim=0)
    return joint, (shares * (variances + (means - joint).square())).sum(dim=0), total


def _others(x: Tensor) -> list[int]:
    """The dimensions that are not the channels."""
    return [0, *range(2, x.dim())]


def _along_channels(values: Tensor, x: Tensor) -> Tensor:
    """(C,) in the shape that multiplies (N, C, ...), at least float32 as x is computed with."""
    return values.to(at_least_float32(x.new_empty(0)).dtype).view(-1, *[1] * (x.dim() - 2))


class _Normalise(torch.autograd.Function):
    """weight · (x − mean) / std + bias; mean and std are functions of all processes' x."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        x: Tensor,
        weight: Tensor,
        bias: Tensor,
        mean: Tensor,
        inverse_std: Tensor,
        count: Tensor,
    ) -> Tensor:
        scale = weight.double() * inverse_std
        shift = bias.double() - scale * mean
        ctx.save_for_backward(x, weight, mean, inverse_std, count)
        out = torch.addcmul(
            _along_channels(shift, x), at_least_float32(x), _along_channels(scale, x)
        )
        return out.to(x.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, mean, inverse_std, count = ctx.saved_tensors  # type: ignore[attr-defined]
        grad, wide = at_least_float32(grad), at_least_float32(x)
        centred = wide - _along_channels(mean, x)
        of_bias = grad.sum(dim=_others(x)).double()
        product = (grad * centred).sum(dim=_others(x)).double()
        # Of the losses of all processes: every one of them changes with the shared moments. The
        # same sums as the compiled form's (`c4_norm`), which another process may have.
        all_bias, all_product = sum_over_processes(of_bias, product)
        scale = weight.double() * inverse_std
        of_x = torch.addcmul(
            grad - _along_channels(all_bias / count, x),
            centred,
            _along_channels(all_product * inverse_std.square() / count, x),
            value=-1,
        ).mul_(_along_channels(scale, x))
        of_weight = product * inverse_std
        return of_x.to(x.dtype), of_weight.to(weight), of_bias.to(weight), None, None, None
