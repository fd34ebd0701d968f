"""Folding: the same function as the network in evaluation mode, and nothing of it left behind."""

import copy

import pytest
import torch
from torch import nn

from i2i.nn.c4 import C4Conv, regular_type, trivial_type
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_resnet import STEM_MODES, C4ResNet18
from i2i.nn.folding import PlainC4ResNet, fold
from i2i.nn.resnet import ResNet18
from i2i.nn.resnet50 import ResNet50

NORMS = (nn.BatchNorm2d, C4BatchNorm)


def lived(network):
    """A network whose statistics, scales, shifts and biases are not those of the beginning."""
    generator = torch.Generator().manual_seed(1)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            shape = module.running_mean.shape
            module.running_mean.copy_(torch.randn(shape, generator=generator))
            module.running_var.copy_(0.3 + 2 * torch.rand(shape, generator=generator))
            module.weight.data.copy_(0.5 + torch.rand(shape, generator=generator))
            module.bias.data.copy_(torch.randn(shape, generator=generator))
        if isinstance(module, C4Conv | nn.Conv2d) and module.bias is not None:
            module.bias.data.copy_(torch.randn(module.bias.shape, generator=generator))
    return network


def kinds(network):
    return {type(module) for module in network.modules()}


def encoders():
    for mode in STEM_MODES:
        for max_pool in (False, True):
            size = 33 if mode == "odd" else 32
            make = {"width": 2, "image_size": size, "stem_mode": mode, "max_pool": max_pool}
            yield pytest.param(
                lambda make=make: C4ResNet18(1, **make), size, id=f"{mode}-pool{max_pool:d}"
            )
    yield pytest.param(
        lambda: C4ResNet18(1, width=2, image_size=32, dead_conv2=True, basis="full"), 32, id="dead"
    )
    yield pytest.param(lambda: ResNet18(1, width=4, image_size=32), 32, id="resnet18")
    yield pytest.param(
        lambda: ResNet18(1, width=4, image_size=32, circular_rows=True), 32, id="circular"
    )
    yield pytest.param(lambda: ResNet50(1, width=4, image_size=32), 32, id="resnet50")


@pytest.mark.parametrize(("make", "size"), encoders())
def test_a_folded_encoder_computes_the_same(make, size):
    """In float64, where rounding hides nothing; the published dead block keeps its norm."""
    encoder = lived(make().double()).eval()
    folded = fold(encoder)
    image = torch.rand(3, 1, size, size, dtype=torch.float64)
    with torch.no_grad():
        torch.testing.assert_close(folded(image), encoder(image), rtol=1e-10, atol=1e-10)
        if hasattr(encoder, "regular_map"):
            torch.testing.assert_close(
                folded.regular_map(image), encoder.regular_map(image), rtol=1e-10, atol=1e-10
            )
    assert (folded.out_channels, folded.map_size) == (encoder.out_channels, encoder.map_size)


@pytest.mark.parametrize(("make", "size"), encoders())
def test_only_plain_convolutions_are_left(make, size, request):
    left = kinds(fold(make()))
    assert C4Conv not in left
    assert C4BatchNorm not in left
    dead = "dead" in request.node.callspec.id
    assert (nn.BatchNorm2d in left) == dead


def test_folding_leaves_the_network_as_it_was():
    encoder = lived(C4ResNet18(1, width=2, image_size=32, stem_mode="k4")).train()
    before = copy.deepcopy(encoder.state_dict())
    folded = fold(encoder)
    for parameter in folded.parameters():
        parameter.zero_()  # they share no memory
    assert encoder.training
    assert all(parameter.requires_grad for parameter in encoder.parameters())
    for name, value in encoder.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_a_large_batch_takes_the_plain_layers_too():
    """From eight images on, the C4 encoder itself goes another way."""
    encoder = lived(C4ResNet18(1, width=16, image_size=32, max_pool=False)).eval()
    folded = fold(encoder)
    assert isinstance(folded, PlainC4ResNet)
    image = torch.rand(9, 1, 32, 32)
    with torch.inference_mode():
        expected = encoder(image)
        difference = (folded(image) - expected).norm() / expected.norm()
    assert difference < 1e-5


def test_folding_twice_is_folding_once():
    once = fold(lived(C4ResNet18(1, width=2, image_size=32)))
    image = torch.rand(2, 1, 32, 32)
    torch.testing.assert_close(fold(once)(image), once(image), rtol=0, atol=0)


def test_a_forgotten_statistic_would_be_seen():
    """Negative control: statistics of the beginning instead of the ones that were learned."""
    encoder = lived(C4ResNet18(1, width=2, image_size=32)).eval()
    wrong = copy.deepcopy(encoder)
    for module in wrong.modules():
        if isinstance(module, C4BatchNorm):
            module.reset_running_stats()
    image = torch.rand(2, 1, 32, 32)
    with torch.no_grad():
        assert (fold(wrong)(image) - encoder(image)).norm() > 0.1 * encoder(image).norm()


class Picky(nn.Conv2d):
    """A convolution whose weights are not what it multiplies with."""

    def forward(self, x):
        return nn.functional.conv2d(x, self.weight / self.weight.norm(), padding=1)


@pytest.mark.parametrize(
    "layers",
    [
        (Picky(2, 3, 3, bias=False), nn.BatchNorm2d(3)),
        (nn.Conv2d(2, 3, 3), nn.BatchNorm2d(3, track_running_stats=False)),
        (nn.Sequential(nn.Conv2d(2, 3, 3), nn.AvgPool2d(2, padding=1)), nn.BatchNorm2d(3)),
        (nn.Sequential(nn.Conv2d(2, 3, 3), nn.MaxPool2d(2)), nn.BatchNorm2d(3)),
        (nn.Conv2d(2, 3, 3), nn.BatchNorm2d(3, affine=False)),
        (C4Conv(trivial_type(2), regular_type(3), 3), C4BatchNorm(3)),
        (nn.ReLU(), C4BatchNorm(2)),
    ],
)
def test_unfamiliar_pairs_are_left_alone_or_folded_right(layers):
    network = nn.Sequential(*layers).double()
    for module in network.modules():
        if isinstance(module, NORMS) and module.running_mean is not None:
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    network.eval()
    channels = 8 if isinstance(layers[0], nn.ReLU) else 2
    x = torch.randn(4, channels, 9, 9, dtype=torch.float64)
    torch.testing.assert_close(fold(network)(x), network(x), rtol=1e-10, atol=1e-10)


def test_an_encoder_of_somebody_else_keeps_what_it_asks_of_its_layers():
    class Mine(C4ResNet18):
        def forward(self, image):
            return super().forward(image) * sum(w.weights.sum() for w in [self.stem])

    encoder = lived(Mine(1, width=2, image_size=32)).eval()
    image = torch.rand(2, 1, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(fold(encoder)(image), encoder(image))
