"""AlexNet's trunk: its size, every picture size, and what is too small."""

import pytest
import torch

from i2i.nn.alexnet import AlexNet, stem_stride


def test_parameters_of_the_published_network():
    trunk = sum(p.numel() for p in AlexNet(3, image_size=224).parameters())
    assert trunk + 4096 * 1000 + 1000 == 61_100_840  # with ImageNet's classes
    assert trunk + 4096 * 820 + 820 == 60_363_380  # with RotationNet's


@pytest.mark.parametrize(("size", "stride"), [(224, 4), (64, 4), (63, 4), (62, 2), (32, 1)])
def test_every_size_leaves_cells(size, stride):
    assert stem_stride(size) == stride
    net = AlexNet(3, width=2, image_size=size).eval()
    x = torch.rand(2, 3, size, size, generator=torch.Generator().manual_seed(0))
    out = net(x)
    assert out.shape == (2, net.out_channels) == (2, 128)
    assert not torch.equal(out[0], out[1])


def test_cells_of_the_original():
    net = AlexNet(3, width=1, image_size=224)
    assert net.features(torch.rand(1, 3, 224, 224)).shape == (1, 4, 6, 6)


def test_dropout_only_in_training():
    net, x = AlexNet(3, width=2, image_size=64), torch.rand(2, 3, 64, 64)
    assert not torch.equal(net.train()(x), net(x))
    assert torch.equal(net.eval()(x), net(x))


def test_wrong_sizes():
    with pytest.raises(ValueError, match="21 pixels or more"):
        AlexNet(3, image_size=20)
    with pytest.raises(ValueError, match="got \\(1, 1, 64, 64\\)"):
        AlexNet(3, width=1, image_size=64)(torch.rand(1, 1, 64, 64))
