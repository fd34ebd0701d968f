"""The spectral C4 convolution against torch's dense convolution and escnn's kernels."""

import warnings

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from i2i.nn.c4_spectral import (
    base_filters,
    spectral_conv2d,
    spectral_conv2d_base,
    spectral_product,
    transform_filters,
    transform_matrix,
)
from i2i.nn.c4_spectral_constants import is_supported
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major

TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}


pytestmark = pytest.mark.usefixtures("both_forms")


def expand(base: Tensor) -> Tensor:
    """K[h, g] = rot90^h(K[0, g - h]): (C_out, C_in * 4, k, k) to (C_out * 4, C_in * 4, k, k)."""
    out_fields, channels, size, _ = base.shape
    filters = base.view(out_fields, channels // 4, 4, size, size)
    rows = [torch.rot90(filters.roll(h, dims=2), h, (-2, -1)) for h in range(4)]
    return torch.stack(rows, dim=1).reshape(out_fields * 4, channels, size, size)


def relative_error(value: Tensor, reference: Tensor) -> float:
    return ((value - reference).norm() / reference.norm()).item()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize(
    ("map_size", "kernel_size", "batch"),
    [
        (8, 3, 1),
        (8, 3, 5),
        (8, 1, 2),
        (8, 5, 2),
        (16, 3, 2),
        (9, 3, 2),
        (17, 3, 1),
        (4, 3, 2),
        (5, 3, 64),
        (7, 5, 2),
        (3, 3, 1),
    ],
)
def test_equals_dense_for_arbitrary_c4_kernels(
    map_size: int, kernel_size: int, batch: int, dtype: torch.dtype
) -> None:
    generator = torch.Generator().manual_seed(map_size * 100 + kernel_size)
    base = torch.randn(3, 2 * 4, kernel_size, kernel_size, dtype=dtype, generator=generator)
    x = torch.randn(batch, 2 * 4, map_size, map_size, dtype=dtype, generator=generator)
    upstream = torch.randn(batch, 3 * 4, map_size, map_size, dtype=dtype, generator=generator)
    x.requires_grad_()
    base.requires_grad_()

    dense = functional.conv2d(x, expand(base), padding=kernel_size // 2)
    spectral = spectral_conv2d_base(x, base)
    assert spectral.is_contiguous()
    assert spectral.dtype == dtype
    assert relative_error(spectral, dense) < TOLERANCE[dtype]
    for ours, reference in zip(
        torch.autograd.grad(spectral, (x, base), upstream),
        torch.autograd.grad(dense, (x, base), upstream),
        strict=True,
    ):
        assert relative_error(ours, reference) < TOLERANCE[dtype]


@pytest.mark.parametrize("kernel_size", [3, 5])
def test_equals_escnn_layer_and_its_parameter_gradients(kernel_size: int) -> None:
    """Fixes the direction: which quarter turn goes with which shift of the four channels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from escnn import gspaces, nn

    torch.manual_seed(3)
    plane = gspaces.rot2dOnR2(4)
    in_type = nn.FieldType(plane, [plane.regular_repr] * 3)
    out_type = nn.FieldType(plane, [plane.regular_repr] * 2)
    padding = kernel_size // 2
    layer = nn.R2Conv(in_type, out_type, kernel_size, padding=padding, bias=False)
    x = torch.randn(2, 12, 8, 8)
    upstream = torch.randn(2, 8, 8, 8)

    expected = layer(nn.GeometricTensor(x, in_type)).tensor
    (expected_gradient,) = torch.autograd.grad(expected, layer.weights, upstream)
    kernel, _ = layer.expand_parameters()
    value = spectral_conv2d(x, kernel)
    (gradient,) = torch.autograd.grad(value, layer.weights, upstream)
    # escnn's own float32 kernels are C4-equivariant to about 1e-7 of their largest entry.
    assert relative_error(value, expected) < 1e-6
    assert relative_error(gradient, expected_gradient) < 1e-6


def test_kernel_gradient_is_gathered_in_the_first_group_row() -> None:
    torch.manual_seed(4)
    kernel = expand(torch.randn(2, 8, 3, 3, dtype=torch.float64)).requires_grad_()
    x = torch.randn(2, 8, 8, 8, dtype=torch.float64)
    upstream = torch.randn(2, 8, 8, 8, dtype=torch.float64)
    (ours,) = torch.autograd.grad(spectral_conv2d(x, kernel), kernel, upstream)
    (dense,) = torch.autograd.grad(functional.conv2d(x, kernel, padding=1), kernel, upstream)
    # Turn the dense gradient of row h back to row 0 and add up.
    rows = dense.view(2, 4, 2, 4, 3, 3)
    gathered = sum(
        torch.rot90(rows[:, h].roll(-h, dims=2), -h, (-2, -1)) for h in range(4)
    ).reshape(2, 8, 3, 3)
    assert relative_error(base_filters(ours), gathered) < 1e-12
    others = ours.view(2, 4, 8, 3, 3)[:, 1:]
    assert torch.equal(others, torch.zeros_like(others))


def test_kernel_without_the_symmetry_is_not_reproduced() -> None:
    torch.manual_seed(5)
    kernel = torch.randn(8, 8, 3, 3, dtype=torch.float64)
    x = torch.randn(2, 8, 8, 8, dtype=torch.float64)
    dense = functional.conv2d(x, kernel, padding=1)
    assert relative_error(spectral_conv2d(x, kernel), dense) > 0.5
    # The opposite turn is a C4 kernel too, but of the other convention.
    mirrored = expand(base_filters(kernel)).transpose(-2, -1)
    dense = functional.conv2d(x, mirrored, padding=1)
    assert relative_error(spectral_conv2d(x, mirrored), dense) > 0.5


def test_turning_the_maps_turns_the_result() -> None:
    torch.manual_seed(6)
    base = torch.randn(2, 8, 3, 3, dtype=torch.float64)
    x = torch.randn(1, 8, 8, 8, dtype=torch.float64)

    def turn(maps: Tensor) -> Tensor:
        fields = torch.rot90(maps, 1, (2, 3)).reshape(1, 2, 4, 8, 8)
        return fields.roll(1, dims=2).reshape(1, 8, 8, 8)

    error = relative_error(spectral_conv2d_base(turn(x), base), turn(spectral_conv2d_base(x, base)))
    assert error < 1e-12


def test_kept_blocks_give_the_same_result() -> None:
    torch.manual_seed(7)
    base, x = torch.randn(2, 8, 3, 3), torch.randn(3, 8, 8, 8)
    matrix = transform_matrix(8, 3, dtype=torch.float32)
    blocks = transform_filters(base.view(2, 2, 36), matrix)
    assert blocks.shape == (21, 8, 8)
    kept = from_pixel_major(spectral_product(to_pixel_major(x), blocks, kernel_size=3))
    assert torch.equal(kept, spectral_conv2d_base(x, base))
    with pytest.raises(ValueError, match="do not fit maps"):
        spectral_product(torch.randn(81, 4, 2, 3), blocks, kernel_size=3)


def test_four_frequencies_share_a_block() -> None:
    """The number of products: 4 (N² − 1) + 4 rows of an image per pair of fields and pixel."""
    blocks = transform_filters(torch.randn(1, 1, 36), transform_matrix(8, 3, dtype=torch.float32))
    products = 4 * 4 * (4 * (len(blocks) - 1) + 1)
    assert products / 64 == 20.25


def test_pixel_major_is_undone() -> None:
    x = torch.randn(3, 20, 5, 5)
    assert to_pixel_major(x).shape == (25, 4, 5, 3)
    # Channel = field * 4 + turn.
    assert to_pixel_major(x)[7, 2, 3, 1] == x[1, 14, 1, 2]
    assert torch.equal(from_pixel_major(to_pixel_major(x)), x)


def test_training_after_inference_mode() -> None:
    """The constants that are kept must not be inference tensors (a map size used nowhere else)."""
    base, x = torch.randn(2, 8, 3, 3), torch.randn(2, 8, 11, 11)
    with torch.inference_mode():
        before = spectral_conv2d_base(x, base)
    after = spectral_conv2d_base(x, base.requires_grad_())
    after.sum().backward()
    assert base.grad is not None
    assert torch.equal(before, after)


def test_non_contiguous_maps_and_gradients() -> None:
    torch.manual_seed(8)
    base = torch.randn(2, 8, 3, 3, dtype=torch.float64)
    x = torch.randn(3, 8, 8, 8, dtype=torch.float64).to(memory_format=torch.channels_last)
    x.requires_grad_()
    expected = functional.conv2d(x, expand(base), padding=1)
    value = spectral_conv2d_base(x, base)
    assert relative_error(value, expected) < 1e-12
    # The gradient of a sum is an expanded scalar: strides of zero.
    (ours,) = torch.autograd.grad(value.sum(), x)
    (reference,) = torch.autograd.grad(expected.sum(), x)
    assert relative_error(ours, reference) < 1e-12


def test_autocast_rounds_only_the_products() -> None:
    torch.manual_seed(9)
    base = (torch.randn(8, 32, 3, 3) / 17).requires_grad_()
    x = torch.randn(4, 32, 8, 8, requires_grad=True)
    upstream = torch.randn(4, 32, 8, 8)
    exact = spectral_conv2d_base(x, base)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = spectral_conv2d_base(x, base)
    assert rounded.dtype == torch.float32
    assert 1e-4 < relative_error(rounded, exact) < 1e-2
    for ours, reference in zip(
        torch.autograd.grad(rounded, (x, base), upstream),
        torch.autograd.grad(exact, (x, base), upstream),
        strict=True,
    ):
        assert ours.dtype == torch.float32
        assert relative_error(ours, reference) < 1e-2


def test_bfloat16_maps_stay_bfloat16() -> None:
    torch.manual_seed(10)
    base = torch.randn(2, 8, 3, 3) / 8
    x = torch.randn(2, 8, 8, 8)
    exact = spectral_conv2d_base(x, base)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = spectral_conv2d_base(x.bfloat16(), base)
    assert rounded.dtype == torch.bfloat16
    assert relative_error(rounded.float(), exact) < 2e-2


def test_supported_sizes_are_those_of_the_dense_layer() -> None:
    assert is_supported(8, 3)
    assert is_supported(9, 3)
    assert is_supported(16, 5, 1)
    assert not is_supported(8, 3, 2)
    assert not is_supported(8, 4)
    assert not is_supported(3, 5)
    assert not is_supported(32, 3)


@pytest.mark.parametrize(
    ("maps", "filters", "message"),
    [
        ((1, 8, 8, 7), (2, 8, 3, 3), "square maps"),
        ((1, 4, 8, 8), (2, 8, 3, 3), "square maps"),
        ((1, 6, 8, 8), (2, 6, 3, 3), "multiple of 4"),
        ((1, 8, 8, 8), (2, 8, 4, 4), "No spectral form"),
        ((1, 8, 32, 32), (2, 8, 3, 3), "conv2d"),
    ],
)
def test_refuses_what_it_cannot_do(
    maps: tuple[int, ...], filters: tuple[int, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        spectral_conv2d_base(torch.zeros(maps), torch.zeros(filters))


def test_refuses_an_unexpanded_kernel() -> None:
    with pytest.raises(ValueError, match="spectral_conv2d_base"):
        spectral_conv2d(torch.zeros(1, 8, 8, 8), torch.zeros(2, 8, 3, 3))
