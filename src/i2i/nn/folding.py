"""A network for inference: plain convolutions, with the batch norms behind them folded in.

In evaluation mode a batch norm is a factor and a shift for each channel. So is what it does to the
kernel and the bias of the convolution before it, and the layer is saved: for C4 fields with the
same factor and shift for the four turns of a field.
"""

import copy
from itertools import pairwise

import torch
from torch import Tensor, nn

from i2i.nn.batch_norm import JointBatchNorm2d
from i2i.nn.c4 import TURNS, C4Conv, group_max_pool
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_resnet import C4BasicBlock, C4ResNet18
from i2i.nn.log_polar import CircularRowsConv2d
from i2i.nn.resnet import BasicBlock, ResNet18
from i2i.nn.resnet50 import Bottleneck, ResNet50

# Which batch norm follows which convolution, by attribute: (convolution, norm).
_STEM = (("stem", "norm"),)
_TWO = (("conv1", "norm1"), ("conv2", "norm2"))
_PAIRS: dict[type[nn.Module], tuple[tuple[str, str], ...]] = {
    ResNet18: _STEM,
    ResNet50: _STEM,
    BasicBlock: _TWO,
    Bottleneck: (*_TWO, ("conv3", "norm3")),
}
# Types are compared exactly: a subclass may do anything with its weights.
_CONVOLUTIONS = (nn.Conv2d, CircularRowsConv2d)
_NORMS = (nn.BatchNorm2d, JointBatchNorm2d, C4BatchNorm)


def fold(network: nn.Module) -> nn.Module:
    """A copy of a network for inference, of plain layers as far as possible.

    Every `C4Conv` becomes an `nn.Conv2d`, C4 and plain ResNets lose the batch norms behind their
    convolutions, and parameters need no gradient. The copy computes the same up to rounding; other
    networks come back as they are.

    Args:
        network: Any network; it is left as it is.

    Returns:
        The copy, in evaluation mode, on the same device and of the same precision.

    Example:
        >>> network = nn.Sequential(nn.Conv2d(1, 2, 3, bias=False), nn.BatchNorm2d(2))
        >>> fold(network)
        Sequential(
          (0): Conv2d(1, 2, kernel_size=(3, 3), stride=(1, 1))
          (1): Identity()
        )
    """
    return _plain(copy.deepcopy(network).eval()).requires_grad_(False)


class PlainC4ResNet(nn.Module):
    """What a `C4ResNet18` computes in evaluation mode, of plain convolutions without batch norms.

    Args:
        encoder: It is taken apart: give a copy.

    Attributes:
        out_channels: Of the encoder.
        map_size: Of the encoder.

    Shape:
        (B, in_channels, image_size, image_size) -> (B, out_channels, S, S).
    """

    mask: Tensor

    def __init__(self, encoder: C4ResNet18) -> None:
        super().__init__()
        self.in_channels, self.image_size = encoder.in_channels, encoder.image_size
        self.out_channels, self.map_size = encoder.out_channels, encoder.map_size
        self.background = encoder.background
        self.register_buffer("mask", encoder.mask, persistent=False)
        self.stem = _joined(encoder.stem, encoder.norm)
        self.max_pool = encoder.max_pool
        self.blocks = nn.Sequential(*(_plain(block) for block in encoder.blocks))

    def regular_map(self, image: Tensor) -> Tensor:
        """The map before the maximum over turns: (B, 4 · out_channels, S, S), regular fields."""
        expected = (self.in_channels, self.image_size, self.image_size)
        if image.ndim != 4 or image.shape[1:] != expected:
            raise ValueError(f"expected images of shape (B, {expected}), got {tuple(image.shape)}")
        x = (image - self.background) * self.mask
        features: Tensor = self.blocks(torch.relu(self.max_pool(self.stem(x))))
        return features

    def forward(self, image: Tensor) -> Tensor:
        """(B, C, H, W) in [0, 1] -> (B, out_channels, S, S)."""
        return group_max_pool(self.regular_map(image))


class PlainC4Block(nn.Module):
    """What a `C4BasicBlock` computes in evaluation mode, without batch norms.

    Args:
        block: It is taken apart: give a copy.
    """

    def __init__(self, block: C4BasicBlock) -> None:
        super().__init__()
        self.first = _joined(block.conv1, block.norm1)
        # The published code's blocks go on to the norm without their second convolution.
        idle = block.dead_conv2
        self.second = _plain(block.norm2) if idle else _joined(block.conv2, block.norm2)
        self.shortcut = _plain(block.shortcut)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 4 · in_fields, H, W) -> (B, 4 · out_fields, H / stride, W / stride)."""
        out = self.second(torch.relu(self.first(x)))
        return torch.relu(out + self.shortcut(x))


def _plain(module: nn.Module) -> nn.Module:
    """The module, or what stands for it; parts are replaced in place."""
    if type(module) is C4ResNet18:
        return PlainC4ResNet(module)
    if type(module) is C4BasicBlock:
        return PlainC4Block(module)
    if type(module) is C4Conv:
        return module.export()
    if type(module) is C4BatchNorm and _is_fixed(module):
        return _plain_norm(module)
    if isinstance(module, C4ResNet18 | C4BasicBlock):
        return module  # of somebody else: what it asks of its layers is not known
    pairs = list(_PAIRS.get(type(module), ()))
    if type(module) is nn.Sequential:
        pairs = list(pairwise(module._modules))
    for first, second in pairs:
        conv, norm = module._modules[first], module._modules[second]
        folded = None if conv is None or norm is None else _folded(conv, norm)
        if folded is not None:
            module._modules[first], module._modules[second] = folded, nn.Identity()
    for name, child in module._modules.items():
        if child is not None:
            module._modules[name] = _plain(child)
    return module


def _joined(conv: nn.Module, norm: nn.Module) -> nn.Module:
    """One module for both: the folded convolution, or one after the other."""
    folded = _folded(conv, norm)
    return nn.Sequential(_plain(conv), _plain(norm)) if folded is None else folded


def _folded(conv: nn.Module, norm: nn.Module) -> nn.Module | None:
    """The convolution with the norm folded in; None where they are no such pair."""
    if type(norm) not in _NORMS or not _is_fixed(norm):
        return None
    if type(conv) is nn.Sequential and len(conv) == 2 and _keeps_constants(conv[1]):
        # A mean over cells passes a factor and a shift on.
        folded = _folded(conv[0], norm)
        return None if folded is None else nn.Sequential(folded, conv[1])
    if type(conv) is C4Conv:
        conv = conv.export()
    return _scaled(conv, norm) if type(conv) in _CONVOLUTIONS else None


def _is_fixed(norm: nn.Module) -> bool:
    """Whether the norm takes the statistics that it has kept, not those of the batch."""
    return getattr(norm, "running_mean", None) is not None and not norm.training


def _keeps_constants(pool: nn.Module) -> bool:
    return (
        type(pool) is nn.AvgPool2d
        and pool.padding == 0
        and not pool.ceil_mode
        and pool.divisor_override is None
    )


@torch.no_grad()
def _scaled(conv: nn.Module, norm: nn.Module) -> nn.Module:
    """A copy of a convolution, scaled and shifted; computed in float64, as folding rounds once."""
    assert isinstance(conv, nn.Conv2d)
    scale, shift = _affine(norm)
    folded = copy.deepcopy(conv)
    folded.weight.copy_(conv.weight.double() * scale[:, None, None, None])
    bias = shift if conv.bias is None else shift + scale * conv.bias.double()
    folded.bias = nn.Parameter(bias.to(conv.weight))
    return folded


def _affine(norm: nn.Module) -> tuple[Tensor, Tensor]:
    """Factor and shift of every channel, float64; the four turns of a C4 field have the same."""
    assert isinstance(norm, nn.BatchNorm2d)
    mean, var = norm.running_mean, norm.running_var
    assert mean is not None
    assert var is not None
    scale = (var.double() + norm.eps).rsqrt()
    scale = scale if norm.weight is None else norm.weight.double() * scale
    shift = -scale * mean.double()
    shift = shift if norm.bias is None else norm.bias.double() + shift
    turns = TURNS if isinstance(norm, C4BatchNorm) else 1
    return scale.repeat_interleave(turns), shift.repeat_interleave(turns)


@torch.no_grad()
def _plain_norm(norm: C4BatchNorm) -> nn.BatchNorm2d:
    """The batch norm of ordinary channels that does the same to C4 fields."""
    scale, shift = _affine(norm)
    plain = nn.BatchNorm2d(len(scale), eps=0.0).to(norm.running_mean).eval()
    plain.weight.copy_(scale)  # of running statistics 0 and 1
    plain.bias.copy_(shift)
    return plain
