"""The first convolution, its batch norm, max-pool and ReLU as one product with image patches.

The first map is the largest of the network (160 MB for 64 images of 128 px), and little is
computed for it: what it costs is being written and read. But it is linear in the image, so that
the mean and the variance of each of its fields are those of the image's patches u, seen by the
kernel w:

    mean = w · E[u],        E[y²] = wᵀ E[u uᵀ] w.

The batch norm is then known before the map is, folds into the kernel, and a few images at a time
are convolved, pooled and clipped while they are in the cache. The gradient of the folded kernel
passes on to weights, scale and shift through the two lines above.
"""

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx, once_differentiable
from torch.nn import functional

from i2i.nn.batch_norm import update_running
from i2i.nn.c4 import TURNS, C4Conv
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.precision import full_precision
from i2i.nn.processes import sum_over_processes

_IMAGES_AT_ONCE = 4


def stem_map(image: Tensor, conv: C4Conv, norm: C4BatchNorm, pool: nn.Module) -> Tensor:
    """ReLU(pool(norm(conv(image)))), in full precision, without a gradient for the image.

    Args:
        image: (B, C, H, W).
        conv: From trivial to regular fields, without a bias.
        norm: Its running statistics are updated in training mode.
        pool: `nn.MaxPool2d`, or `nn.Identity`.

    Returns:
        (B, conv.out_type.size, H', W'), channels last.
    """
    with full_precision(image):
        image = image.to(conv.weights.dtype)
        size, step, padding = conv.kernel_size, conv.stride, conv.padding
        patches = functional.unfold(image, size, padding=padding, stride=step)  # (B, K, L)
        kernel = conv.expand_parameters()[0].flatten(1)  # (4F, K)
        weight, bias = _fold(kernel, norm, patches)
        height = (image.shape[2] + 2 * padding - size) // step + 1
        geometry = (0, 1, 0)
        if isinstance(pool, nn.MaxPool2d):
            geometry = (int(pool.kernel_size), int(pool.stride), int(pool.padding))  # type: ignore[arg-type]
        return _PooledProduct.apply(patches, weight, bias, height, geometry)


def _fold(kernel: Tensor, norm: C4BatchNorm, patches: Tensor) -> tuple[Tensor, Tensor]:
    """Kernel (4F, K) and bias (4F,) of convolution and batch norm together."""
    if norm.training or norm.running_mean is None or norm.running_var is None:
        mean, var, count = _field_moments(kernel, patches, shared=norm.training)
        if norm.training:
            update_running(norm, mean, var, count=count)
    else:
        mean, var = norm.running_mean.double(), norm.running_var.double()
    scale = norm.weight.double() / (var + norm.eps).sqrt()
    shift = norm.bias.double() - scale * mean
    weight = kernel.double() * scale.repeat_interleave(TURNS)[:, None]
    return weight.to(kernel), shift.repeat_interleave(TURNS).to(kernel)


def _field_moments(
    kernel: Tensor, patches: Tensor, *, shared: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and (biased) variance of each field's outputs, (F,), and their number, in float64.

    The patches' own moments are constants, so that sharing them over processes is all that the
    joint gradient needs.
    """
    batch, size, places = patches.shape
    first, second = kernel.new_zeros(size).double(), kernel.new_zeros(size, size).double()
    for some in patches.detach().split(_IMAGES_AT_ONCE):
        columns = some.transpose(0, 1).reshape(size, -1).double()
        first += columns.sum(dim=1)
        second += columns @ columns.T
    rows = first.new_full((1,), batch * places)
    if shared:
        first, second, rows = sum_over_processes(first, second, rows)
    wide = kernel.double()
    means = (wide @ (first / rows)).view(-1, TURNS).mean(dim=1)
    squares = ((wide @ (second / rows)) * wide).sum(dim=1).view(-1, TURNS).mean(dim=1)
    return means, (squares - means.square()).clamp(min=0.0), TURNS * rows


class _PooledProduct(torch.autograd.Function):
    """ReLU(max-pool(weight · patches + bias)), a few images at a time."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        patches: Tensor,
        weight: Tensor,
        bias: Tensor,
        height: int,
        geometry: tuple[int, int, int],
    ) -> Tensor:
        size, step, padding = geometry
        batch, _, places = patches.shape
        width = places // height
        small = (height, width)
        if size:
            small = tuple((side + 2 * padding - size) // step + 1 for side in small)  # type: ignore[assignment]
        out = weight.new_empty(batch, *small, len(weight)).permute(0, 3, 1, 2)
        wants_grad = weight.requires_grad or bias.requires_grad
        indices = []
        for some, into in zip(
            patches.split(_IMAGES_AT_ONCE), out.split(_IMAGES_AT_ONCE), strict=True
        ):
            rows = torch.matmul(some.mT, weight.mT).add_(bias)  # (b, L, 4F)
            maps = rows.view(len(some), height, width, -1).permute(0, 3, 1, 2)
            if size:
                maps, where = functional.max_pool2d(maps, size, step, padding, return_indices=True)
                indices += [where] if wants_grad else []
            torch.clamp(maps, min=0.0, out=into)
        ctx.save_for_backward(patches, out, *indices)
        ctx.small, ctx.full, ctx.geometry = small, (height, width), geometry  # type: ignore[attr-defined]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[None, Tensor, Tensor, None, None]:
        patches, out, *indices = ctx.saved_tensors  # type: ignore[attr-defined]
        (size, step, padding), full = ctx.geometry, ctx.full  # type: ignore[attr-defined]
        channels = out.shape[1]
        weight = grad.new_zeros(channels, patches.shape[1])
        bias = grad.new_zeros(channels)
        parts = (tensor.split(_IMAGES_AT_ONCE) for tensor in (patches, out, grad))
        for index, (some, kept, upstream) in enumerate(zip(*parts, strict=True)):
            # Channels last, like the maps: a gradient of another layout is copied.
            upstream = (upstream * (kept > 0)).contiguous(memory_format=torch.channels_last)
            if size:
                like = upstream.new_empty(len(some), *full, channels).permute(0, 3, 1, 2)
                upstream = torch.ops.aten.max_pool2d_with_indices_backward(
                    upstream, like, [size] * 2, [step] * 2, [padding] * 2, [1, 1], False,
                    indices[index],
                )  # fmt: skip
            rows = upstream.permute(0, 2, 3, 1).reshape(len(some), -1, channels)
            weight += torch.bmm(rows.mT, some.mT).sum(dim=0)
            bias += rows.sum(dim=(0, 1))
        return None, weight, bias, None, None
