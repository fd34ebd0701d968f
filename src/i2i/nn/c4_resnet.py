"""The C4-equivariant ResNet-18 of the paper (E2CNN), with exact stems beside the published one."""

from functools import partial

import torch
from torch import Tensor, nn

from i2i.nn.c4 import C4Conv, group_max_pool, regular_type, trivial_type
from i2i.nn.c4_dispatch import takes_product, takes_spectral
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_stem import stem_map
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major, turn_max
from i2i.nn.precision import at_least_float32

STEM_MODES = ("ref", "odd", "k4", "pool")
_BLOCKS_PER_LAYER = 2
_SMALLEST_MASK = 1e-20


def disc_mask(image_size: int) -> Tensor:
    """1 inside the largest centred disc, falling off like exp(−(r² − t²)/4) outside: (S, S).

    r is the distance from the image centre and t = (S − 1)/2, both in pixels. It takes the corners
    away, which a turn by anything but 90° would bring in from outside the picture. Below 1e-20 it
    is 0: products with numbers that float32 cannot normalise take a processor many times longer
    than others, and there are enough of them at the edge to be felt.
    """
    offset = torch.arange(image_size, dtype=torch.float64) - (image_size - 1) / 2
    radius_squared = offset[:, None] ** 2 + offset[None, :] ** 2
    excess = (radius_squared - ((image_size - 1) / 2) ** 2).clamp(min=0.0)
    mask = torch.exp(-excess / 4)
    return torch.where(mask < _SMALLEST_MASK, 0.0, mask).float()


def _strided_conv(
    in_fields: int, out_fields: int, kernel_size: int, *, stride: int, stem_mode: str, basis: str
) -> nn.Module:
    """A regular convolution that keeps or halves the map, in the way of the stem mode."""
    conv = partial(
        C4Conv, regular_type(in_fields), regular_type(out_fields), bias=False, basis=basis
    )
    return _halving(conv, kernel_size, stride=stride, stem_mode=stem_mode)


def _halving(
    conv: "partial[C4Conv]", kernel_size: int, *, stride: int, stem_mode: str
) -> nn.Module:
    if stride == 1:
        return conv(kernel_size, padding=kernel_size // 2)
    if stem_mode == "k4":
        return conv(4, stride=2, padding=1)
    if stem_mode == "pool":
        return nn.Sequential(conv(kernel_size, padding=kernel_size // 2), nn.AvgPool2d(2))
    return conv(kernel_size, stride=2, padding=kernel_size // 2)


def _shortcut(in_fields: int, out_fields: int, *, stride: int, stem_mode: str) -> nn.Module:
    """Identity, or a 1×1 convolution with batch norm.

    Stride-2 sampling of an even map is not symmetric under quarter turns, so the exact modes
    average 2×2 cells first. The convolution has a bias, which the batch norm cancels in training:
    it is there for the parameter count of the published network.
    """
    if stride == 1 and in_fields == out_fields:
        return nn.Identity()
    conv = partial(C4Conv, regular_type(in_fields), regular_type(out_fields), 1)
    norm = C4BatchNorm(out_fields)
    if stride > 1 and stem_mode in ("k4", "pool"):
        return nn.Sequential(nn.AvgPool2d(stride), conv(), norm)
    return nn.Sequential(conv(stride=stride), norm)


class C4BasicBlock(nn.Module):
    """Two 3×3 C4 convolutions with a shortcut.

    Args:
        in_fields: Regular fields in.
        out_fields: Regular fields out.
        stride: 1 or 2, of the first convolution and the shortcut.
        stem_mode: How a stride of 2 is done, see `C4ResNet18`.
        basis: `"band_limited"` or `"full"`.
        dead_conv2: Leave the second convolution out of the sum, as the published code does: its
            weights exist and never receive a gradient.
    """

    def __init__(
        self,
        in_fields: int,
        out_fields: int,
        *,
        stride: int = 1,
        stem_mode: str = "ref",
        basis: str = "band_limited",
        dead_conv2: bool = False,
    ) -> None:
        super().__init__()
        make = partial(_strided_conv, stem_mode=stem_mode, basis=basis)
        self.conv1 = make(in_fields, out_fields, 3, stride=stride)
        self.norm1 = C4BatchNorm(out_fields)
        self.conv2 = make(out_fields, out_fields, 3, stride=1)
        self.norm2 = C4BatchNorm(out_fields)
        self.shortcut = _shortcut(in_fields, out_fields, stride=stride, stem_mode=stem_mode)
        self.out_fields, self.dead_conv2 = out_fields, dead_conv2

    def enter_pixel_major(self, x: Tensor) -> Tensor:
        """(B, 4 · in_fields, H, W) -> (P, 4, out_fields, B), P cells of the map that comes out."""
        out = to_pixel_major(at_least_float32(self.conv1(x)))
        return self._finish(out, to_pixel_major(at_least_float32(self.shortcut(x))))

    def pixel_major(self, x: Tensor) -> Tensor:
        """(P, 4, in_fields, B) -> (P, 4, out_fields, B), of a block without a stride."""
        shortcut = x
        if isinstance(self.shortcut, nn.Sequential):
            conv, norm = self.shortcut
            assert isinstance(conv, C4Conv)
            assert isinstance(norm, C4BatchNorm)
            shortcut = norm.pixel_major(conv.pixel_major(x))
        assert isinstance(self.conv1, C4Conv)
        return self._finish(self.conv1.pixel_major(x), shortcut)

    def _finish(self, out: Tensor, shortcut: Tensor) -> Tensor:
        """What follows the first convolution, pixel-major."""
        out = self.norm1.pixel_major(out, relu=True)
        if not self.dead_conv2:
            assert isinstance(self.conv2, C4Conv)
            out = self.conv2.pixel_major(out)
        return self.norm2.pixel_major(out, shortcut=shortcut, relu=True)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 4 · in_fields, H, W) -> (B, 4 · out_fields, H / stride, W / stride)."""
        out = torch.relu(self.norm1(self.conv1(x)))
        out = self.norm2(out if self.dead_conv2 else self.conv2(out))
        return torch.relu(out + self.shortcut(x))


class C4ResNet18(nn.Module):
    """ResNet-18 of C4-equivariant convolutions: turning the image by 90° turns the map.

    Layers as in the paper: a 5×5 stem of stride 2, an optional 3×3 max-pool of stride 2, four
    layers of two blocks with 1, 2, 4 and 8 times `width` regular fields, and a maximum over the
    four turns.

    Args:
        in_channels: 1 for gray and depth, 3 for RGB.
        width: Regular fields of the first layer (paper: 38). Each is four channels.
        image_size: Side of the square image in pixels.
        stem_mode: How the map is halved. `"ref"`: stride-2 convolutions as published; on even sizes
            they sample at 0, 2, 4, …, which is not symmetric, so equivariance is approximate. Exact
            are `"odd"` (the same on odd sizes: 129 px), `"k4"` (4×4 kernels) and `"pool"` (stride-1
            convolutions, then 2×2 pooling).
        basis: `"band_limited"` as in the paper, or `"full"` (all cells free).
        dead_conv2: The published code's blocks, which ignore their second convolution.
        layer_strides: Stride of each layer's first block; the paper has (2, 2, 1, 1).
        max_pool: Whether the stem ends with a max-pool.
        background: Value of empty pixels; it is subtracted, so that they and the padding are both
            0. `background=0` gives the published reading.
        use_disc_mask: Fade out the corners of the image.

    Attributes:
        out_channels: 8 · width, trivial (invariant) channels.
        map_size: Side S of the output map.

    Shape:
        (B, in_channels, image_size, image_size) -> (B, out_channels, S, S).

    Raises:
        ValueError: If a mode or stride is unknown, or the image size does not suit the mode.

    Example:
        >>> encoder = C4ResNet18(1, width=2, image_size=32, max_pool=False)
        >>> encoder(torch.ones(2, 1, 32, 32)).shape
        torch.Size([2, 16, 4, 4])
    """

    mask: Tensor

    def __init__(
        self,
        in_channels: int,
        *,
        width: int,
        image_size: int,
        stem_mode: str = "ref",
        basis: str = "band_limited",
        dead_conv2: bool = False,
        layer_strides: tuple[int, ...] = (2, 2, 1, 1),
        max_pool: bool = True,
        background: float = 1.0,
        use_disc_mask: bool = True,
    ) -> None:
        super().__init__()
        self.in_channels, self.image_size, self.stem_mode = in_channels, image_size, stem_mode
        self.out_channels = width * 2 ** (len(layer_strides) - 1)
        self.map_size = _map_size(image_size, stem_mode, tuple(layer_strides), max_pool)
        self.background = background
        mask = disc_mask(image_size) if use_disc_mask else torch.ones(image_size, image_size)
        self.register_buffer("mask", mask, persistent=False)

        stem = partial(
            C4Conv, trivial_type(in_channels), regular_type(width), bias=False, basis=basis
        )
        self.stem = _halving(stem, 5, stride=2, stem_mode=stem_mode)
        self.norm = C4BatchNorm(width)
        self.max_pool: nn.Module = nn.Identity()
        if max_pool and stem_mode in ("k4", "pool"):
            self.max_pool = nn.MaxPool2d(2)
        elif max_pool:
            self.max_pool = nn.MaxPool2d(3, stride=2, padding=1)

        blocks: list[nn.Module] = []
        # Blocks whose maps have one size: (first, end, fewest fields, map size).
        self._stretches: list[tuple[int, int, int, int]] = []
        fields = width
        for layer, stride in enumerate(layer_strides):
            first, out_fields = len(blocks), width * 2**layer
            for index in range(_BLOCKS_PER_LAYER):
                block = C4BasicBlock(
                    fields,
                    out_fields,
                    stride=stride if index == 0 else 1,
                    stem_mode=stem_mode,
                    basis=basis,
                    dead_conv2=dead_conv2,
                )
                blocks.append(block)
                fields = out_fields
            if stride == 1 and self._stretches:
                first, _, out_fields, _ = self._stretches.pop()
            size = _map_size(image_size, stem_mode, tuple(layer_strides[: layer + 1]), max_pool)
            self._stretches.append((first, len(blocks), out_fields, size))
        self.blocks = nn.Sequential(*blocks)

    def regular_map(self, image: Tensor) -> Tensor:
        """The map before the maximum over turns: (B, 4 · out_channels, S, S), regular fields."""
        x, is_pixel_major = self._run_blocks(self._stem_map(image))
        return from_pixel_major(x) if is_pixel_major else x

    def forward(self, image: Tensor) -> Tensor:
        """(B, C, H, W) in [0, 1] -> (B, out_channels, S, S)."""
        x, is_pixel_major = self._run_blocks(self._stem_map(image))
        if not is_pixel_major:
            return group_max_pool(x)
        x = turn_max(x)  # (S · S, out_channels, B)
        return x.permute(2, 1, 0).reshape(len(image), -1, self.map_size, self.map_size)

    def _stem_map(self, image: Tensor) -> Tensor:
        """What goes into the blocks: (B, 4 · width, H, W)."""
        expected = (self.in_channels, self.image_size, self.image_size)
        if image.ndim != 4 or image.shape[1:] != expected:
            raise ValueError(f"expected images of shape (B, {expected}), got {tuple(image.shape)}")
        x = (image - self.background) * self.mask
        if isinstance(self.stem, C4Conv) and takes_product(x):
            return stem_map(x, self.stem, self.norm, self.max_pool)
        # The maximum commutes with ReLU: pooling first leaves a quarter of the elements to it.
        return torch.relu(self.max_pool(self.norm(self.stem(x))))

    def _run_blocks(self, x: Tensor) -> tuple[Tensor, bool]:
        """The blocks on (B, 4 · width, H, W), and whether what comes out is pixel-major.

        The first block of a stretch changes the size of the map, which is done densely.
        """
        chosen = [
            takes_spectral(x, fields=fields, map_size=size, training=torch.is_grad_enabled())
            for _, _, fields, size in self._stretches
        ]
        if not any(chosen):
            return self.blocks(x), False
        is_pixel_major = False
        for (first, end, _, _), spectral in zip(self._stretches, chosen, strict=True):
            if is_pixel_major:
                x = from_pixel_major(x)
            is_pixel_major = spectral
            for index in range(first, end):
                block = self.blocks[index]
                assert isinstance(block, C4BasicBlock)
                if not is_pixel_major:
                    x = block(x)
                elif index == first:
                    x = block.enter_pixel_major(x)
                else:
                    x = block.pixel_major(x)
        return x, is_pixel_major

    def extra_repr(self) -> str:
        """`C4: 128×128 -> 304 × 8×8, stem ref`."""
        size, side = self.image_size, self.map_size
        return f"C4: {size}×{size} -> {self.out_channels} × {side}×{side}, stem {self.stem_mode}"


def _map_size(
    image_size: int, stem_mode: str, layer_strides: tuple[int, ...], max_pool: bool
) -> int:
    """Side of the last map; every halving must suit the mode."""
    if stem_mode not in STEM_MODES:
        raise ValueError(
            f"stem_mode={stem_mode!r} is not known: choose one of {', '.join(STEM_MODES)}"
        )
    if any(stride not in (1, 2) for stride in layer_strides):
        raise ValueError(f"layer_strides={layer_strides}: each must be 1 or 2")
    factor = 2 ** (1 + int(max_pool) + sum(stride == 2 for stride in layer_strides))
    if stem_mode == "odd":
        if image_size % factor != 1:
            nearest = max(1, round(image_size / factor)) * factor + 1
            raise ValueError(
                f"stem_mode='odd' needs an image size of a multiple of {factor} plus 1, so that "
                f"every map is odd; got {image_size}, try image_size={nearest}"
            )
        return image_size // factor + 1
    if image_size % factor:
        nearest = max(1, round(image_size / factor)) * factor
        raise ValueError(
            f"stem_mode={stem_mode!r} needs an image size that {factor} divides; "
            f"got {image_size}, try image_size={nearest}"
        )
    return image_size // factor
