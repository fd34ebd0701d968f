"""Pictures in log-polar coordinates, where a roll of the camera is a shift, and layers for them."""

import math

import torch
from torch import Tensor, nn

from i2i.nn.precision import at_least_float32, full_precision


class LogPolar(nn.Module):
    """Resample square pictures about their middle: rows are angles, columns logarithms of radii.

    Of S rows, row i is the angle 2π·i/S, counter-clockwise from +x. Of S columns, column j is the
    radius `exp(j · ln(S·√2/2) / S)` pixels: from one pixel to just short of the corner. Bilinear;
    what lies outside the picture is its nearest pixel, which is background where the object is
    inside. The rows go round in a circle, and turning the picture counter-clockwise by 2π·k/S
    moves them down by k: exactly for quarter turns where S is a multiple of 4.

    Args:
        image_size: Side S of the picture in pixels, at least 2.

    Shape:
        (N, C, S, S) -> (N, C, S, S), float32 for half precision.

    Raises:
        ValueError: If the pictures have another size.

    Reference:
        Esteves et al. 2019, "Equivariant Multi-View Networks".

    Example:
        >>> LogPolar(16)(torch.ones(2, 3, 16, 16)).shape
        torch.Size([2, 3, 16, 16])
    """

    grid: Tensor

    def __init__(self, image_size: int) -> None:
        super().__init__()
        if image_size < 2:
            raise ValueError(f"image_size={image_size}: log-polar wants at least 2 pixels")
        self.image_size = image_size
        steps = torch.arange(image_size, dtype=torch.float64) / image_size
        angle = 2 * math.pi * steps[:, None]
        radius = torch.exp(steps[None] * math.log(image_size * math.sqrt(2) / 2))
        # In halves of the width from the middle, x right and y down, as grid_sample wants them.
        position = torch.stack((radius * angle.cos(), -radius * angle.sin()), dim=-1)
        grid = (position / (image_size / 2)).to(torch.get_default_dtype())
        self.register_buffer("grid", grid, persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        """(N, C, S, S) -> (N, C, angles, radii)."""
        if image.ndim != 4 or image.shape[-2:] != (self.image_size, self.image_size):
            side = self.image_size
            raise ValueError(f"expected (N, C, {side}, {side}), got {tuple(image.shape)}")
        image = at_least_float32(image)
        with full_precision(image):
            grid = self.grid.to(image.dtype).expand(len(image), -1, -1, -1)
            return nn.functional.grid_sample(
                image, grid, mode="bilinear", padding_mode="border", align_corners=False
            )

    def extra_repr(self) -> str:
        """`64 angles × 64 radii`."""
        return f"{self.image_size} angles × {self.image_size} radii"


class CircularRowsConv2d(nn.Conv2d):
    """A convolution of maps whose rows go round in a circle; columns are padded with zeros.

    Its weights are those of a plain convolution. A shift of the rows by the stride shifts the
    output by one, exactly where the stride divides their number.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, out_channels, H / stride, W / stride)."""
        rows, columns = (int(side) for side in self.padding)
        return nn.functional.conv2d(
            _wrap_rows(x, rows), self.weight, self.bias, self.stride, (0, columns),
            self.dilation, self.groups,
        )  # fmt: skip


class CircularRowsMaxPool2d(nn.Module):
    """A max-pool of maps whose rows go round in a circle.

    Args:
        kernel_size: Side of the square window.
        stride: Of both axes.
        padding: Of both axes: rows of the other end, columns that are never the largest.
    """

    def __init__(self, kernel_size: int, stride: int, padding: int) -> None:
        super().__init__()
        self.kernel_size, self.stride, self.padding = kernel_size, stride, padding

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H / stride, W / stride)."""
        return nn.functional.max_pool2d(
            _wrap_rows(x, self.padding), self.kernel_size, self.stride, (0, self.padding)
        )

    def extra_repr(self) -> str:
        """Window, stride and padding."""
        return f"{self.kernel_size}, stride={self.stride}, padding={self.padding}"


def _wrap_rows(x: Tensor, rows: int) -> Tensor:
    """The last rows above the first and the first below the last: (N, C, H + 2 · rows, W)."""
    if rows == 0:
        return x
    return nn.functional.pad(x, (0, 0, rows, rows), mode="circular")
