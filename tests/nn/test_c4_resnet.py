"""The C4 encoder: parameter counts, map sizes, symmetry of the stems."""

import copy

import pytest
import torch

from i2i.nn.c4_dispatch import convolution_mode
from i2i.nn.c4_resnet import STEM_MODES, C4ResNet18, disc_mask
from i2i.testing import assert_c4_equivariant


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def small(**options):
    options = {"width": 2, "image_size": 32, "max_pool": False} | options
    return C4ResNet18(1, **options)


@pytest.mark.parametrize(("channels", "expected"), [(1, 10_582_620), (3, 10_582_620 + 836)])
def test_parameters_at_paper_width(channels, expected):
    encoder = C4ResNet18(channels, width=38, image_size=128)
    assert count(encoder) == expected
    assert (encoder.out_channels, encoder.map_size) == (304, 8)
    assert sum(count(block.conv2) for block in encoder.blocks) == 5_891_520


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({"image_size": 128, "max_pool": True}, 8),
        ({"image_size": 129, "max_pool": True, "stem_mode": "odd"}, 9),
        ({"image_size": 64, "basis": "full"}, 8),
        ({"image_size": 65, "stem_mode": "odd"}, 9),
        ({"image_size": 64, "stem_mode": "k4"}, 8),
        ({"image_size": 64, "stem_mode": "pool", "max_pool": True}, 4),
        ({"image_size": 32, "layer_strides": (1, 2, 1, 1)}, 8),
    ],
)
def test_map_size_is_what_comes_out(options, size):
    encoder = small(**options)
    with torch.no_grad():
        out = encoder(torch.ones(1, 1, encoder.image_size, encoder.image_size))
    assert encoder.map_size == size
    assert out.shape == (1, encoder.out_channels, size, size)


@pytest.mark.parametrize("max_pool", [True, False])
@pytest.mark.parametrize("basis", ["band_limited", "full"])
@pytest.mark.parametrize("stem_mode", ["odd", "k4", "pool"])
def test_exact_stems_turn_with_the_image(stem_mode, basis, max_pool):
    torch.manual_seed(0)
    size = (65 if max_pool else 33) if stem_mode == "odd" else (64 if max_pool else 32)
    encoder = small(stem_mode=stem_mode, image_size=size, basis=basis, max_pool=max_pool)
    noise = torch.rand(2, 1, size, size)
    report = assert_c4_equivariant(encoder, noise, dtype=torch.float32, tolerance=1e-5)
    assert len(report.errors) == 4


def test_published_stem_does_not_on_even_sizes():
    torch.manual_seed(0)
    encoder = small(width=4, image_size=64, max_pool=True)
    report = assert_c4_equivariant(encoder, torch.rand(2, 1, 64, 64), raise_error=False)
    assert min(report.errors[1:]) > 0.1


def test_exact_stem_after_training_steps():
    """Symmetry that only held at initialisation would go with the first step."""
    torch.manual_seed(0)
    encoder = small(stem_mode="k4")
    optimiser = torch.optim.SGD(encoder.parameters(), lr=0.1)
    for _ in range(3):
        optimiser.zero_grad()
        encoder(torch.rand(4, 1, 32, 32)).square().mean().backward()
        optimiser.step()
    assert_c4_equivariant(encoder, torch.rand(2, 1, 32, 32), dtype=torch.float32, tolerance=1e-5)


def test_dead_second_convolution_gets_no_gradient():
    encoder = small(dead_conv2=True)
    assert count(encoder) == count(small())
    encoder(torch.rand(2, 1, 32, 32)).sum().backward()
    assert all(block.conv2.weights.grad is None for block in encoder.blocks)
    assert all(block.norm2.weight.grad is not None for block in encoder.blocks)


def test_disc_mask():
    mask = disc_mask(8).double()
    assert torch.equal(mask[2:6, 1:7], torch.ones(4, 6).double())
    assert mask[0, 3] == pytest.approx(
        torch.tensor(-0.25 / 4).exp().item()
    )  # r² = 12.5, t² = 12.25
    assert mask[0, 0] == pytest.approx(torch.tensor(-12.25 / 4).exp().item())
    assert torch.equal(mask, torch.rot90(mask))
    corners = disc_mask(128)
    assert corners[0, 0] == 0.0
    assert corners[corners > 0].min() > 1e-21  # far from what float32 cannot normalise


def test_empty_picture_is_zero_inside():
    encoder = small()
    seen = []
    encoder.stem.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    picture = torch.ones(1, 1, 32, 32)
    picture[0, 0, 0, 0] = 0.0  # a corner outside the disc
    with convolution_mode("dense"):
        encoder(torch.ones(1, 1, 32, 32))
        encoder(picture)
    assert torch.equal(seen[0], torch.zeros(1, 1, 32, 32))
    assert seen[1].abs().max() < 1e-6


def test_building_twice_and_copying_does_not_share():
    first, second = small(), small()
    first.double()
    image = torch.rand(1, 1, 32, 32)
    assert second(image).dtype == torch.float32
    twin = copy.deepcopy(second).eval()
    with torch.no_grad():
        torch.testing.assert_close(twin(image), second.eval()(image))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stem_mode": "even"}, ", ".join(STEM_MODES)),
        ({"image_size": 30}, "image_size=32"),
        ({"image_size": 32, "stem_mode": "odd"}, "image_size=33"),
        ({"layer_strides": (3, 1, 1, 1)}, "1 or 2"),
        ({"basis": "none"}, "band_limited, full"),
    ],
)
def test_errors_say_what_to_type(options, message):
    with pytest.raises(ValueError, match=message):
        small(**options)


def test_wrong_image_is_refused():
    with pytest.raises(ValueError, match="32"):
        small()(torch.ones(1, 1, 64, 64))
