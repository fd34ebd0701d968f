"""The plain encoder."""

import pytest
import torch

from i2i.nn.encoders import Encoder, ResNet18, check_encoder


def test_parameters_of_the_published_encoder():
    encoder = ResNet18(1, image_size=128)
    trunk = sum(parameter.numel() for parameter in encoder.parameters())
    assert trunk + 512 * 896 + 896 == 11_632_576
    assert trunk + 512 * 6 + 6 == 11_176_006
    assert (encoder.out_channels, encoder.map_size) == (512, 8)


@pytest.mark.parametrize(
    ("size", "max_pool", "strides"),
    [
        (128, True, (2, 2, 1, 1)),
        (64, False, (2, 2, 1, 1)),
        (33, True, (2, 2, 1, 1)),
        (50, False, (1, 2, 2, 1)),
    ],
)
def test_map_size_is_what_comes_out(size, max_pool, strides):
    encoder = ResNet18(3, width=4, image_size=size, max_pool=max_pool, layer_strides=strides)
    out = encoder(torch.ones(2, 3, size, size))
    assert out.shape == (2, 32, encoder.map_size, encoder.map_size)


def test_encoders_of_other_packages_are_checked():
    class Foreign(torch.nn.Module):
        def forward(self, image):
            return image

    with pytest.raises(TypeError, match="missing: out_channels, map_size"):
        check_encoder(Foreign())
    fitting = Foreign()
    fitting.out_channels, fitting.map_size = 1, 8
    assert check_encoder(fitting) is fitting
    assert isinstance(fitting, Encoder)
