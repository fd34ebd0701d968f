"""The plain ResNet-18 style encoder of the baselines and of "I2I without E2CNN"."""

import torch
from torch import Tensor, nn

from i2i.nn.batch_norm import JointBatchNorm2d
from i2i.nn.log_polar import CircularRowsConv2d, CircularRowsMaxPool2d

_BLOCKS_PER_LAYER = 2


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with batch norm and a shortcut; no biases.

    Args:
        in_channels: Channels in.
        out_channels: Channels out.
        stride: Of the first convolution and of the shortcut, which is a 1×1 convolution with batch
            norm where the stride or the width changes.
        circular_rows: Whether the rows go round in a circle.
    """

    def __init__(
        self, in_channels: int, out_channels: int, *, stride: int = 1, circular_rows: bool = False
    ) -> None:
        super().__init__()
        conv = CircularRowsConv2d if circular_rows else nn.Conv2d
        self.conv1 = conv(in_channels, out_channels, 3, stride, 1, bias=False)
        self.norm1 = JointBatchNorm2d(out_channels)
        self.conv2 = conv(out_channels, out_channels, 3, 1, 1, bias=False)
        self.norm2 = JointBatchNorm2d(out_channels)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_channels != out_channels:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, stride, bias=False),
                JointBatchNorm2d(out_channels),
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, out_channels, H / stride, W / stride)."""
        out = torch.relu(self.norm1(self.conv1(x)))
        out = self.norm2(self.conv2(out))
        return torch.relu(out + self.shortcut(x))


class ResNet18(nn.Module):
    """ResNet-18 with a 5×5 stem, stride 2 in the first two layers and 1 in the last two.

    The trunk only: pooling and heads belong to the models. Not pretrained, as in the paper. With
    `stem_size=7` and `layer_strides=(1, 2, 2, 2)` it is the standard ResNet-18.

    Args:
        in_channels: 1 for gray and depth, 3 for RGB.
        width: Channels of the first layer (paper: 64).
        image_size: Side of the square image in pixels.
        layer_strides: Stride of each layer's first block.
        max_pool: Whether the stem ends with a 3×3 max-pool of stride 2.
        stem_size: Side of the stem's kernel, odd.
        circular_rows: Whether the rows go round in a circle, as those of `LogPolar` do: every layer
            pads them with the rows of the other end instead of zeros.

    Attributes:
        out_channels: 8 · width.
        map_size: Side S of the output map.

    Shape:
        (B, in_channels, image_size, image_size) -> (B, out_channels, S, S).

    Raises:
        ValueError: If the stem's kernel has an even side.

    Example:
        >>> ResNet18(1, width=4, image_size=64)(torch.ones(2, 1, 64, 64)).shape
        torch.Size([2, 32, 4, 4])
    """

    def __init__(
        self,
        in_channels: int,
        *,
        width: int = 64,
        image_size: int,
        layer_strides: tuple[int, ...] = (2, 2, 1, 1),
        max_pool: bool = True,
        stem_size: int = 5,
        circular_rows: bool = False,
    ) -> None:
        super().__init__()
        if stem_size % 2 == 0:
            raise ValueError(f"stem_size={stem_size} must be odd")
        self.in_channels, self.image_size = in_channels, image_size
        self.out_channels = width * 2 ** (len(layer_strides) - 1)
        conv = CircularRowsConv2d if circular_rows else nn.Conv2d
        pool = CircularRowsMaxPool2d if circular_rows else nn.MaxPool2d
        self.stem = conv(in_channels, width, stem_size, 2, stem_size // 2, bias=False)
        self.norm = JointBatchNorm2d(width)
        self.max_pool = pool(3, 2, 1) if max_pool else nn.Identity()

        blocks: list[nn.Module] = []
        channels = width
        # Every strided step here keeps ceil(size / stride) cells.
        size = -(-image_size // 2)
        size = -(-size // 2) if max_pool else size
        for layer, stride in enumerate(layer_strides):
            size = -(-size // stride)
            for index in range(_BLOCKS_PER_LAYER):
                out_channels = width * 2**layer
                stride_here = stride if index == 0 else 1
                blocks.append(
                    BasicBlock(
                        channels, out_channels, stride=stride_here, circular_rows=circular_rows
                    )
                )
                channels = out_channels
        self.blocks = nn.Sequential(*blocks)
        self.map_size = size
        self._initialise()

    def _initialise(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, image: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, out_channels, S, S)."""
        expected = (self.in_channels, self.image_size, self.image_size)
        if image.ndim != 4 or image.shape[1:] != expected:
            raise ValueError(f"expected images of shape (B, {expected}), got {tuple(image.shape)}")
        x = torch.relu(self.max_pool(self.norm(self.stem(image))))
        return self.blocks(x)

    def extra_repr(self) -> str:
        """`128×128 -> 512 × 8×8`."""
        size, side = self.image_size, self.map_size
        return f"{size}×{size} -> {self.out_channels} × {side}×{side}"
