"""Which form a C4 convolution takes: dense or spectral (docs/c4_spectral.md).

Both compute the same function. `"auto"` takes the faster by what was measured; the others force
one, for comparisons and for tools that look at the layers from outside.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from i2i.nn.c4_spectral import is_supported, product_dtype
from i2i.nn.native import has_compiled_transform, is_built_for, is_traced

MODES = ("auto", "dense", "spectral")
_MODE = ["auto"]

# Images below which transforming costs more than it saves, without and with compiled transforms: in
# training the filters are transformed at every step, in evaluation once. Chosen from runs of the
# whole network at powers of two (benchmarks/network_speed.py times batches of 1, 8 and 64).
_LEAST_BATCH_TRAINING = (16, 8)
_LEAST_BATCH_CACHED = (8, 2)
_LEAST_FIELDS = 16
_LEAST_TAPS = 2048  # of one output channel, for one image's convolution to be a product
_LARGEST_MAP = 9  # 16 × 16 maps gain little, and lose in bfloat16, unless transforms are compiled


def set_convolution_mode(mode: str) -> None:
    """Choose for this process.

    Raises:
        ValueError: If the mode is unknown.
    """
    if mode not in MODES:
        raise ValueError(f"convolution={mode!r} is not known: choose one of {', '.join(MODES)}")
    _MODE[0] = mode


@contextmanager
def convolution_mode(mode: str) -> Iterator[None]:
    """Choose for a while.

    Raises:
        ValueError: If the mode is unknown.

    Example:
        >>> with convolution_mode("dense"):
        ...     pass
    """
    before = _MODE[0]
    set_convolution_mode(mode)
    try:
        yield
    finally:
        _MODE[0] = before


def takes_spectral(x: Tensor, *, fields: int, map_size: int, training: bool) -> bool:
    """Whether 3×3 convolutions of stride 1 on such maps go through the spectrum.

    Args:
        x: A tensor on the device of the maps, batch first.
        fields: The smaller of the numbers of regular fields in and out.
        map_size: Side of the square maps.
        training: Whether gradients are wanted, so that the filters change at every step.
    """
    if _MODE[0] == "dense" or is_traced() or not is_supported(map_size, 3):
        return False
    if _MODE[0] == "spectral":
        return True
    compiled = has_compiled_transform(map_size) and is_built_for(x, product_dtype(x))
    least = _LEAST_BATCH_TRAINING if training else _LEAST_BATCH_CACHED
    return (
        x.device.type == "cpu"
        and (map_size <= _LARGEST_MAP or compiled)
        and fields >= _LEAST_FIELDS
        and len(x) >= least[compiled]
    )


def takes_patches(x: Tensor, kernel: Tensor) -> bool:
    """Whether a dense convolution of x (B, C, H, W) is a product of its patches and the kernel.

    Args:
        x: Maps; one image only, without a gradient.
        kernel: (O, C, k, k), in the type of the product.
    """
    return (
        _MODE[0] == "auto"
        and product_dtype(x) == kernel.dtype
        and len(x) == 1
        and x.device.type == "cpu"
        and kernel[0].numel() >= _LEAST_TAPS
        and not torch.is_grad_enabled()
        and not is_traced()
    )


def takes_product(image: Tensor) -> bool:
    """Whether the first convolution is a product with patches (`i2i.nn.c4_stem`)."""
    if _MODE[0] == "dense" or is_traced() or image.requires_grad:
        return False
    return _MODE[0] == "spectral" or image.device.type == "cpu"
