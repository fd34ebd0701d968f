"""The first layer of the network in one pass over the images, see `i2i.nn.c4_stem`."""

from __future__ import annotations

import ctypes
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from i2i.nn.native import functions, in_order, pointer

MAX_WINDOW = 15  # a place in the window and "clipped" have to fit into a byte


@dataclass(frozen=True)
class StemGeometry:
    """Sizes of a convolution of square kernels and a max-pool after it.

    Attributes:
        kernel: Side of the kernel.
        stride: Step of the convolution.
        padding: Zeros on each side of the image.
        window: Side of the max-pool's window, here at most `MAX_WINDOW`; 1 without a max-pool.
        window_stride: Step of the windows.
        window_padding: Places outside of the map that the first window sees.
    """

    kernel: int
    stride: int
    padding: int
    window: int = 1
    window_stride: int = 1
    window_padding: int = 0

    def __post_init__(self) -> None:
        """Refuse what torch refuses: a window that sees nothing of the map."""
        if self.window < 1 or 2 * self.window_padding > self.window:
            raise ValueError(
                f"window={self.window} with window_padding={self.window_padding}: the padding is "
                "at most half of the window"
            )

    @property
    def pooling(self) -> tuple[int, int, int]:
        """Side, step and padding of the windows."""
        return self.window, self.window_stride, self.window_padding

    @property
    def is_pooled(self) -> bool:
        """Whether the windows are more than the places themselves."""
        return self.pooling != (1, 1, 0)

    def map_size(self, height: int, width: int) -> tuple[int, int]:
        """Of the convolution's result."""
        return _steps(height, width, self.kernel, self.stride, self.padding)

    def out_size(self, height: int, width: int) -> tuple[int, int]:
        """Of the max-pool's result, from the size of the image."""
        sides = self.map_size(height, width)
        return _steps(*sides, self.window, self.window_stride, self.window_padding)


def _steps(height: int, width: int, window: int, stride: int, padding: int) -> tuple[int, int]:
    first, second = ((side + 2 * padding - window) // stride + 1 for side in (height, width))
    return first, second


def moments(images: Tensor, geometry: StemGeometry) -> Tensor:
    """Sum of u uᵀ over all patches u, each with a 1 at its end: (K + 1, K + 1), float64."""
    size = images.shape[1] * geometry.kernel**2 + 1
    result = images.new_empty(size, size, dtype=torch.float64)
    _call("i2i_stem_moments", images, geometry, 1, result)
    return result


def forward(
    images: Tensor, weight: Tensor, geometry: StemGeometry, *, wants_places: bool
) -> tuple[Tensor, Tensor | None]:
    """ReLU(max-pool(weight · patches)).

    Args:
        images: (B, C, H, W), contiguous.
        weight: (channels, K + 1), the bias last.
        geometry: Sizes.
        wants_places: Whether :func:`backward` follows.

    Returns:
        Maps (B, channels, H', W'), channels last, and where in its window each maximum was, uint8.
    """
    shape = (len(images), *geometry.out_size(*images.shape[2:]), len(weight))
    out = images.new_empty(shape)
    places = images.new_empty(shape, dtype=torch.uint8) if wants_places else None
    _call("i2i_stem", images, geometry, len(weight), weight.contiguous(), out, places)
    return out.permute(0, 3, 1, 2), places


def backward(images: Tensor, grad: Tensor, places: Tensor, geometry: StemGeometry) -> Tensor:
    """Gradient (channels, K + 1), float64, of the weight of :func:`forward`."""
    rows = in_order(grad.permute(0, 2, 3, 1))
    size = images.shape[1] * geometry.kernel**2 + 1
    result = images.new_empty(rows.shape[-1], size, dtype=torch.float64)
    _call("i2i_stem_backward", images, geometry, len(result), rows, places, result)
    return result


def _call(
    name: str, images: Tensor, geometry: StemGeometry, channels: int, *arrays: Tensor | None
) -> None:
    height, width = images.shape[2:]
    sizes = (
        *images.shape,
        *astuple(geometry),
        *geometry.map_size(height, width),
        *geometry.out_size(height, width),
        channels,
    )
    getattr(functions(), name)(
        *map(pointer, (images, *arrays)),
        (ctypes.c_int64 * len(sizes))(*sizes),
        int(images.dtype == torch.float64),
        torch.get_num_threads(),
    )
