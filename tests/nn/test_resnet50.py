"""ResNet-50: counts, sizes, and a block against its definition."""

import pytest
import torch
from torch.nn import functional

from i2i.nn.encoders import check_encoder
from i2i.nn.resnet50 import Bottleneck, ResNet50


@pytest.mark.parametrize(("channels", "expected"), [(1, 23_501_760), (3, 23_508_032)])
def test_parameters_of_the_published_trunk(channels, expected):
    encoder = ResNet50(channels, image_size=128)
    assert sum(parameter.numel() for parameter in encoder.parameters()) == expected
    assert (encoder.out_channels, encoder.map_size) == (2048, 4)
    assert check_encoder(encoder) is encoder


@pytest.mark.parametrize(
    ("size", "max_pool", "strides", "map_size"),
    [
        (128, True, (1, 2, 2, 2), 4),
        (64, False, (1, 2, 2, 2), 4),
        (32, False, (1, 2, 2, 2), 2),
        (33, True, (2, 2, 1, 1), 3),
    ],
)
def test_map_size_is_what_comes_out(size, max_pool, strides, map_size):
    encoder = ResNet50(3, width=2, image_size=size, max_pool=max_pool, layer_strides=strides)
    out = encoder(torch.ones(2, 3, size, size))
    assert encoder.map_size == map_size
    assert out.shape == (2, 64, map_size, map_size)


def test_depth_and_strides():
    """Fifty layers with weights (the fiftieth is the classifier); only 3×3 kernels stride."""
    encoder = ResNet50(1, width=2, image_size=64)
    inside = [m for name, m in encoder.named_modules() if isinstance(m, torch.nn.Conv2d)]
    shortcuts = [m for n, m in encoder.named_modules() if n.endswith("shortcut.0")]
    assert len(inside) - len(shortcuts) == 49
    assert len(shortcuts) == 4
    strided = [m.kernel_size for m in inside if m.stride == (2, 2) and m not in shortcuts]
    assert strided == [(7, 7), (3, 3), (3, 3), (3, 3)]


def test_block_against_its_definition():
    torch.manual_seed(0)
    block = Bottleneck(6, 2, stride=2).double()
    for norm in (block.norm1, block.norm2, block.norm3, block.shortcut[1]):
        torch.nn.init.normal_(norm.weight)
        torch.nn.init.normal_(norm.bias)
    x = torch.randn(3, 6, 7, 7, dtype=torch.float64)

    def normal(y, norm):
        mean, variance = y.mean((0, 2, 3)), y.var((0, 2, 3), unbiased=False)
        scale = norm.weight / (variance + norm.eps).sqrt()
        return (y - mean[:, None, None]) * scale[:, None, None] + norm.bias[:, None, None]

    y = normal(torch.einsum("oi,bihw->bohw", block.conv1.weight[:, :, 0, 0], x), block.norm1)
    patches = functional.unfold(y.clamp(min=0), 3, padding=1, stride=2)
    y = (block.conv2.weight.flatten(1) @ patches).view(3, 2, 4, 4)
    y = normal(y, block.norm2).clamp(min=0)
    y = normal(torch.einsum("oi,bihw->bohw", block.conv3.weight[:, :, 0, 0], y), block.norm3)
    cut = torch.einsum("oi,bihw->bohw", block.shortcut[0].weight[:, :, 0, 0], x[..., ::2, ::2])
    expected = (y + normal(cut, block.shortcut[1])).clamp(min=0)
    torch.testing.assert_close(block(x), expected, atol=1e-12, rtol=1e-12)


def test_bad_input():
    with pytest.raises(ValueError, match="four strides"):
        ResNet50(1, width=2, image_size=64, layer_strides=(1, 2, 2))
    with pytest.raises(ValueError, match="expected images"):
        ResNet50(1, width=2, image_size=64)(torch.ones(2, 1, 32, 32))
