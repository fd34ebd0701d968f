"""AlexNet without its last layer, the original trunk of RotationNet."""

import torch
from torch import Tensor, nn

_STEM, _POOL, _CELLS = 11, 3, 6
_STRIDES = (4, 2, 1)


class AlexNet(nn.Module):
    """Five convolutions and two linear layers of 64 · width units, in the one-column form.

    The stem's stride is 4 where the picture has at least 63 pixels, as in the original; else it is
    the largest of 2 and 1 that leaves a cell behind the three max-pools.

    Args:
        in_channels: 1 for gray and depth, 3 for RGB.
        width: Channels of the first layer (original: 64).
        image_size: Side of the square image in pixels, at least 21.
        dropout: Before each linear layer.

    Attributes:
        out_channels: 64 · width.

    Shape:
        (B, in_channels, image_size, image_size) -> (B, out_channels).

    Raises:
        ValueError: If the image is too small.

    Reference:
        Krizhevsky 2014, "One weird trick for parallelizing convolutional neural networks".

    Example:
        >>> AlexNet(3, width=4, image_size=64)(torch.ones(2, 3, 64, 64)).shape
        torch.Size([2, 256])
    """

    def __init__(
        self, in_channels: int, *, width: int = 64, image_size: int, dropout: float = 0.5
    ) -> None:
        super().__init__()
        self.in_channels, self.image_size = in_channels, image_size
        self.out_channels = 64 * width
        second, third, last = 3 * width, 6 * width, 4 * width
        # Modules are numbered as in the weight files that exist.
        self.features = nn.Sequential(
            nn.Conv2d(in_channels, width, _STEM, stem_stride(image_size), 2), nn.ReLU(),
            nn.MaxPool2d(_POOL, 2),
            nn.Conv2d(width, second, 5, padding=2), nn.ReLU(),
            nn.MaxPool2d(_POOL, 2),
            nn.Conv2d(second, third, 3, padding=1), nn.ReLU(),
            nn.Conv2d(third, last, 3, padding=1), nn.ReLU(),
            nn.Conv2d(last, last, 3, padding=1), nn.ReLU(),
            nn.MaxPool2d(_POOL, 2),
        )  # fmt: skip
        self.classifier = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(last * _CELLS**2, self.out_channels), nn.ReLU(),
            nn.Dropout(dropout), nn.Linear(self.out_channels, self.out_channels), nn.ReLU(),
        )  # fmt: skip

    def forward(self, image: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, out_channels)."""
        expected = (self.in_channels, self.image_size, self.image_size)
        if image.ndim != 4 or image.shape[1:] != expected:
            raise ValueError(f"expected images of shape (B, {expected}), got {tuple(image.shape)}")
        cells = nn.functional.adaptive_avg_pool2d(self.features(image), _CELLS)
        return self.classifier(torch.flatten(cells, 1))

    def extra_repr(self) -> str:
        """`224×224 -> 4096`."""
        return f"{self.image_size}×{self.image_size} -> {self.out_channels}"


def stem_stride(image_size: int) -> int:
    """The largest of 4, 2 and 1 that leaves at least one cell of an image.

    Raises:
        ValueError: If none does.
    """
    for stride in _STRIDES:
        size = (image_size + 4 - _STEM) // stride + 1
        for _ in range(3):
            size = (size - _POOL) // 2 + 1
        if size >= 1:
            return stride
    raise ValueError(
        f"image_size={image_size} is too small for AlexNet: it wants 21 pixels or more"
    )
