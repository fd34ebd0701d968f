"""Log-polar pictures: a roll is a shift, and the layers behind keep it one."""

import math

import pytest
import torch
from torch import nn

from i2i.nn.log_polar import CircularRowsConv2d, CircularRowsMaxPool2d, LogPolar
from i2i.nn.resnet import ResNet18


def blobs(size, *, turn=0.0, centre=0.0):
    """A smooth picture, turned counter-clockwise about its middle, by its formula: (1, 2, S, S)."""
    axis = (torch.arange(size, dtype=torch.float64) + 0.5 - size / 2 - centre) / (size / 2)
    x, y = axis[None, :], -axis[:, None]
    x, y = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    first = torch.exp(-((x - 0.4) ** 2 + (y - 0.1) ** 2) / 0.08)
    second = torch.exp(-((x + 0.2) ** 2 + (y - 0.3) ** 2) / 0.05) + 0.5 * first
    return torch.stack((first, second))[None]


def relative(one, other):
    return ((one - other).norm() / other.norm()).item()


def test_values_against_the_formula():
    size = 64
    out = LogPolar(size).double()(blobs(size))
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    angle = 2 * math.pi * row.double() / size
    radius = torch.exp(column.double() * math.log(size * math.sqrt(2) / 2) / size) / (size / 2)
    x, y = radius * angle.cos(), radius * angle.sin()
    expected = torch.exp(-((x - 0.4) ** 2 + (y - 0.1) ** 2) / 0.08)
    inside = (x.abs() < 0.95) & (y.abs() < 0.95)
    torch.testing.assert_close(out[0, 0][inside], expected[inside], atol=8e-3, rtol=0)


def test_first_row_points_right_and_rows_go_counter_clockwise():
    picture = torch.zeros(1, 1, 32, 32)
    picture[..., 16:] = 1  # the right half
    out = LogPolar(32)(picture)[0, 0]
    far = out[:, 20:]
    assert (far[0] > 0.99).all()
    assert (far[16] < 0.01).all()
    picture = torch.zeros(1, 1, 32, 32)
    picture[..., :16, :] = 1  # the upper half
    far = LogPolar(32)(picture)[0, 0, :, 20:]
    assert (far[8] > 0.99).all()
    assert (far[24] < 0.01).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [32, 64, 224])
def test_quarter_turns_are_shifts(size, dtype):
    torch.manual_seed(0)
    picture, layer = torch.rand(2, 3, size, size, dtype=dtype), LogPolar(size).to(dtype)
    still = layer(picture)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    for quarters in range(4):
        turned = layer(torch.rot90(picture, quarters, dims=(2, 3)))
        shifted = still.roll(quarters * size // 4, dims=2)
        assert (turned - shifted).abs().max() < tolerance
        if quarters % 2:
            wrong = still.roll(-quarters * size // 4, dims=2)
            assert relative(turned, wrong) > 0.1
            assert relative(turned, still.roll(quarters * size // 4, dims=3)) > 0.1


def test_other_turns_are_nearly_shifts():
    layer, size = LogPolar(64).double(), 64
    still, errors, unturned, off_centre = layer(blobs(size)), [], [], []
    for rows in range(1, size):
        turn = 2 * math.pi * rows / size
        turned = layer(blobs(size, turn=turn))
        errors.append(relative(turned, still.roll(rows, dims=2)))
        unturned.append(relative(turned, still))
        moved = layer(blobs(size, turn=turn, centre=-0.5))  # about a pixel instead of the middle
        off_centre.append(relative(moved, layer(blobs(size, centre=-0.5)).roll(rows, dims=2)))
    assert max(errors) < 5e-3
    assert sorted(unturned)[3] > 0.1
    assert max(off_centre) > 5 * max(errors)


def test_outside_is_the_nearest_pixel():
    assert (LogPolar(16)(torch.full((1, 1, 16, 16), 0.7)) - 0.7).abs().max() < 1e-6


def test_gradients_and_half_precision():
    picture = torch.rand(2, 1, 16, 16, requires_grad=True)
    LogPolar(16)(picture).sum().backward()
    assert torch.isfinite(picture.grad).all()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert LogPolar(16)(picture.detach().bfloat16()).dtype == torch.float32


def test_wrong_sizes():
    with pytest.raises(ValueError, match=r"\(N, C, 16, 16\), got \(1, 1, 16, 8\)"):
        LogPolar(16)(torch.ones(1, 1, 16, 8))
    with pytest.raises(ValueError, match="at least 2"):
        LogPolar(1)


@pytest.mark.parametrize("kernel", [1, 3, 7])
@pytest.mark.parametrize("stride", [1, 2])
def test_circular_convolution_against_a_padded_one(kernel, stride):
    torch.manual_seed(0)
    pad = kernel // 2
    layer = CircularRowsConv2d(2, 3, kernel, stride, pad).double()
    plain = nn.Conv2d(2, 3, kernel, stride).double()
    plain.load_state_dict(layer.state_dict())
    x = torch.randn(2, 2, 8, 8, dtype=torch.float64)
    wide = torch.zeros(2, 2, 8 + 2 * pad, 8 + 2 * pad, dtype=torch.float64)
    for row in range(8 + 2 * pad):
        wide[:, :, row, pad : pad + 8] = x[:, :, (row - pad) % 8]
    torch.testing.assert_close(layer(x), plain(wide))


@pytest.mark.parametrize(
    "layer",
    [
        CircularRowsConv2d(2, 3, 3, 2, 1),
        CircularRowsConv2d(2, 3, 7, 2, 3),
        CircularRowsMaxPool2d(3, 2, 1),
    ],
    ids=["3×3", "7×7", "max"],
)
def test_shift_by_the_stride_is_a_shift_by_one(layer):
    x = torch.randn(2, 2, 16, 16, dtype=torch.float64)
    layer = layer.double()
    torch.testing.assert_close(layer(x.roll(2, dims=2)), layer(x).roll(1, dims=2))
    assert relative(layer(x.roll(2, dims=3)), layer(x).roll(1, dims=3)) > 1e-2  # columns do not


@torch.no_grad()
def change_of_the_mean(circular, *, rows, max_pool):
    """How much the average of a ResNet's map changes when its picture's rows are shifted."""
    torch.manual_seed(0)
    net = ResNet18(
        1, width=4, image_size=64, stem_size=7, layer_strides=(1, 2, 2, 2), max_pool=max_pool,
        circular_rows=circular,
    ).double()  # fmt: skip
    x = torch.rand(4, 1, 64, 64, dtype=torch.float64)
    net.train()(x)
    net.eval()
    return relative(net(x.roll(rows, dims=2)).mean(dim=(2, 3)), net(x).mean(dim=(2, 3)))


def test_resnet_is_blind_to_shifts_of_the_rows_only_with_circular_ones():
    # Strides of 16 or 32 in all: other shifts end between the cells of the map.
    assert change_of_the_mean(True, rows=16, max_pool=False) < 1e-12
    assert change_of_the_mean(True, rows=32, max_pool=True) < 1e-12
    assert change_of_the_mean(False, rows=16, max_pool=False) > 1e-2
    assert change_of_the_mean(False, rows=32, max_pool=True) > 1e-2


def test_circular_rows_keep_names_and_shapes():
    options = dict(width=4, image_size=32, stem_size=7, layer_strides=(1, 2, 2, 2))
    plain, circular = (ResNet18(3, **options, circular_rows=c) for c in (False, True))
    assert {k: v.shape for k, v in plain.state_dict().items()} == {
        k: v.shape for k, v in circular.state_dict().items()
    }
    assert plain(torch.ones(2, 3, 32, 32)).shape == circular(torch.ones(2, 3, 32, 32)).shape
