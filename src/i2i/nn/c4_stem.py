"""The first convolution, its batch norm, max-pool and ReLU as one product with image patches.

The first map is the largest of the network (160 MB for 64 images of 128 px), and little is
computed for it: what it costs is being written and read. But it is linear in the image, so that
the mean and the variance of each of its fields are those of the image's patches u, seen by the
kernel w:

    mean = w · E[u],        E[y²] = wᵀ E[u uᵀ] w.

The batch norm is then known before the map is, folds into the kernel, and a few rows or images at
a time are convolved, pooled and clipped while they are in the cache. The gradient of the folded
kernel passes on to weights, scale and shift through the two lines above.

A patch has a 1 at its end: with it E[u uᵀ] holds E[u] too, and the kernel its bias.
"""

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx, once_differentiable
from torch.nn import functional

from i2i.nn import native
from i2i.nn.batch_norm import update_running
from i2i.nn.c4 import TURNS, C4Conv
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.native import stem as native_stem
from i2i.nn.native.stem import MAX_WINDOW, StemGeometry
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
    window = (1, 1, 0)
    if isinstance(pool, nn.MaxPool2d):
        window = (int(pool.kernel_size), int(pool.stride), int(pool.padding))  # type: ignore[arg-type]
    geometry = StemGeometry(conv.kernel_size, conv.stride, conv.padding, *window)
    with full_precision(image):
        image = image.detach().to(conv.weights.dtype).contiguous()
        kernel = conv.expand_parameters()[0].flatten(1)  # (4F, K)
        compiled = native.is_built_for(image, image.dtype) and geometry.window <= MAX_WINDOW
        stem = (_Compiled if compiled else _Unfolded)(image, geometry)
        out: Tensor = _PooledProduct.apply(_fold(kernel, norm, stem), stem)
        return out


class _Unfolded:
    """The images of one step, by torch: patches (B, K + 1, places) are written to memory."""

    def __init__(self, images: Tensor, geometry: StemGeometry) -> None:
        self.geometry, self.image_size = geometry, images.shape[2:]
        patches = functional.unfold(
            images, geometry.kernel, padding=geometry.padding, stride=geometry.stride
        )
        self.patches = functional.pad(patches, (0, 0, 0, 1), value=1.0)

    def moments(self) -> Tensor:
        """Sum of u uᵀ over all patches, (K + 1, K + 1), float64."""
        size = self.patches.shape[1]
        total = self.patches.new_zeros(size, size, dtype=torch.float64)
        for some in self.patches.split(_IMAGES_AT_ONCE):
            columns = some.transpose(0, 1).reshape(size, -1).double()
            total += columns @ columns.T
        return total

    def forward(self, weight: Tensor, *, wants_places: bool) -> tuple[Tensor, tuple[Tensor, ...]]:
        """ReLU(max-pool(weight · patches)), and what its gradient needs."""
        small = self.geometry.out_size(*self.image_size)
        full = self.geometry.map_size(*self.image_size)
        out = weight.new_empty(len(self.patches), *small, len(weight)).permute(0, 3, 1, 2)
        places = []
        parts = (tensor.split(_IMAGES_AT_ONCE) for tensor in (self.patches, out))
        for some, into in zip(*parts, strict=True):
            rows = torch.matmul(some.mT, weight.mT)  # (b, places, 4F)
            maps = rows.view(len(some), *full, -1).permute(0, 3, 1, 2)
            if self.geometry.is_pooled:
                maps, where = functional.max_pool2d(
                    maps, *self.geometry.pooling, return_indices=True
                )
                places += [where] if wants_places else []
            torch.clamp(maps, min=0.0, out=into)
        return out, (self.patches, out, *places)

    @staticmethod
    def backward(
        geometry: StemGeometry, image_size: torch.Size, grad: Tensor, *kept: Tensor
    ) -> Tensor:
        """Gradient of the weight (4F, K + 1)."""
        patches, out, *places = kept
        channels, full = out.shape[1], geometry.map_size(*image_size)
        weight = grad.new_zeros(channels, patches.shape[1])
        parts = (tensor.split(_IMAGES_AT_ONCE) for tensor in (patches, out, grad))
        for index, (some, seen, upstream) in enumerate(zip(*parts, strict=True)):
            # Channels last, like the maps: a gradient of another layout is copied.
            upstream = (upstream * (seen > 0)).contiguous(memory_format=torch.channels_last)
            if places:
                like = upstream.new_empty(len(some), *full, channels).permute(0, 3, 1, 2)
                size, step, padding = ([side] * 2 for side in geometry.pooling)
                upstream = torch.ops.aten.max_pool2d_with_indices_backward(
                    upstream, like, size, step, padding, [1, 1], False, places[index]
                )
            rows = upstream.permute(0, 2, 3, 1).reshape(len(some), -1, channels)
            weight += torch.bmm(rows.mT, some.mT).sum(dim=0)
        return weight


class _Compiled:
    """The same by `native.stem`: a few rows of patches and maps at a time are in the cache."""

    def __init__(self, images: Tensor, geometry: StemGeometry) -> None:
        self.images, self.geometry, self.image_size = images, geometry, images.shape[2:]

    def moments(self) -> Tensor:
        return native_stem.moments(self.images, self.geometry)

    def forward(self, weight: Tensor, *, wants_places: bool) -> tuple[Tensor, tuple[Tensor, ...]]:
        out, places = native_stem.forward(
            self.images, weight, self.geometry, wants_places=wants_places
        )
        return out, () if places is None else (self.images, places)

    @staticmethod
    def backward(
        geometry: StemGeometry, _: torch.Size, grad: Tensor, images: Tensor, places: Tensor
    ) -> Tensor:
        return native_stem.backward(images, grad, places, geometry).to(grad)


def _fold(kernel: Tensor, norm: C4BatchNorm, stem: "_Unfolded | _Compiled") -> Tensor:
    """Kernel and bias (4F, K + 1) of convolution and batch norm together."""
    if norm.training or norm.running_mean is None or norm.running_var is None:
        mean, var, count = _field_moments(kernel, stem.moments(), shared=norm.training)
        if norm.training:
            update_running(norm, mean, var, count=count)
    else:
        mean, var = norm.running_mean.double(), norm.running_var.double()
    scale = norm.weight.double() / (var + norm.eps).sqrt()
    shift = norm.bias.double() - scale * mean
    weight = kernel.double() * scale.repeat_interleave(TURNS)[:, None]
    return torch.cat([weight, shift.repeat_interleave(TURNS)[:, None]], dim=1).to(kernel)


def _field_moments(kernel: Tensor, sums: Tensor, *, shared: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and (biased) variance of each field's outputs, (F,), and their number, in float64.

    The patches' own moments are constants, so that sharing them over processes is all that the
    joint gradient needs.
    """
    if shared:
        (sums,) = sum_over_processes(sums)
    rows = sums[-1, -1]
    wide = kernel.double()
    means = (wide @ (sums[-1, :-1] / rows)).view(-1, TURNS).mean(dim=1)
    squares = ((wide @ (sums[:-1, :-1] / rows)) * wide).sum(dim=1).view(-1, TURNS).mean(dim=1)
    return means, (squares - means.square()).clamp(min=0.0), TURNS * rows


class _PooledProduct(torch.autograd.Function):
    """ReLU(max-pool(weight · patches)) of the images that a stem holds."""

    @staticmethod
    def forward(ctx: FunctionCtx, weight: Tensor, stem: "_Unfolded | _Compiled") -> Tensor:
        out, kept = stem.forward(weight, wants_places=ctx.needs_input_grad[0])  # type: ignore[attr-defined]
        ctx.save_for_backward(*kept)
        # The stem itself would keep the images alive for as long as the graph is held.
        ctx.form = type(stem).backward, stem.geometry, stem.image_size  # type: ignore[attr-defined]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        backward, *sizes = ctx.form  # type: ignore[attr-defined]
        return backward(*sizes, grad, *ctx.saved_tensors), None  # type: ignore[attr-defined]
