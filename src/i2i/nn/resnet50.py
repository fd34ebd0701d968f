"""ResNet-50, the encoder of the spherical-regression baseline."""

import torch
from torch import Tensor, nn

from i2i.nn.batch_norm import JointBatchNorm2d

_BLOCKS = (3, 4, 6, 3)
_EXPANSION = 4


class Bottleneck(nn.Module):
    """1×1, 3×3 and 1×1 convolution with batch norm and a shortcut; no biases.

    Args:
        in_channels: Channels in.
        width: Channels of the 3×3 convolution; 4 · width come out.
        stride: Of the 3×3 convolution and of the shortcut, which is a 1×1 convolution with batch
            norm where the stride or the number of channels changes.
    """

    def __init__(self, in_channels: int, width: int, *, stride: int = 1) -> None:
        super().__init__()
        out_channels = _EXPANSION * width
        self.conv1 = nn.Conv2d(in_channels, width, 1, bias=False)
        self.norm1 = JointBatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.norm2 = JointBatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out_channels, 1, bias=False)
        self.norm3 = JointBatchNorm2d(out_channels)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_channels != out_channels:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, stride, bias=False),
                JointBatchNorm2d(out_channels),
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, 4 · width, H / stride, W / stride)."""
        out = torch.relu(self.norm1(self.conv1(x)))
        out = torch.relu(self.norm2(self.conv2(out)))
        out = self.norm3(self.conv3(out))
        return torch.relu(out + self.shortcut(x))


class ResNet50(nn.Module):
    """ResNet-50: a 7×7 stem of stride 2, then 3, 4, 6 and 3 bottleneck blocks.

    The trunk only: pooling and heads belong to the models. Not pretrained, so that it starts from
    where the other networks start.

    Args:
        in_channels: 1 for gray and depth, 3 for RGB.
        width: Channels of the first layer's 3×3 convolutions (paper: 64).
        image_size: Side of the square image in pixels.
        layer_strides: Stride of each layer's first block.
        max_pool: Whether the stem ends with a 3×3 max-pool of stride 2.

    Attributes:
        out_channels: 32 · width.
        map_size: Side S of the output map: 4 for 128 px with the max-pool and 64 px without.

    Shape:
        (B, in_channels, image_size, image_size) -> (B, out_channels, S, S).

    Raises:
        ValueError: If there are not four strides, or one is not positive.

    Example:
        >>> ResNet50(1, width=4, image_size=64, max_pool=False)(torch.ones(2, 1, 64, 64)).shape
        torch.Size([2, 128, 4, 4])
    """

    def __init__(
        self,
        in_channels: int,
        *,
        width: int = 64,
        image_size: int,
        layer_strides: tuple[int, ...] = (1, 2, 2, 2),
        max_pool: bool = True,
    ) -> None:
        super().__init__()
        if len(layer_strides) != len(_BLOCKS) or min(layer_strides) < 1:
            raise ValueError(
                f"layer_strides={tuple(layer_strides)}: ResNet-50 has {len(_BLOCKS)} layers, give "
                "four strides of at least 1, such as [1, 2, 2, 2]"
            )
        self.in_channels, self.image_size = in_channels, image_size
        self.out_channels = _EXPANSION * width * 2 ** (len(_BLOCKS) - 1)
        self.stem = nn.Conv2d(in_channels, width, 7, stride=2, padding=3, bias=False)
        self.norm = JointBatchNorm2d(width)
        self.max_pool = nn.MaxPool2d(3, stride=2, padding=1) if max_pool else nn.Identity()

        blocks: list[nn.Module] = []
        channels = width
        # Every strided step here keeps ceil(size / stride) cells.
        size = -(-image_size // 2)
        size = -(-size // 2) if max_pool else size
        for layer, (stride, count) in enumerate(zip(layer_strides, _BLOCKS, strict=True)):
            size = -(-size // stride)
            for index in range(count):
                stride_here = stride if index == 0 else 1
                blocks.append(Bottleneck(channels, width * 2**layer, stride=stride_here))
                channels = _EXPANSION * width * 2**layer
        self.blocks = nn.Sequential(*blocks)
        self.map_size = size
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
        """`128×128 -> 2048 × 4×4`."""
        size, side = self.image_size, self.map_size
        return f"{size}×{size} -> {self.out_channels} × {side}×{side}"
