"""The compiled transforms against their torch form, and what is built where."""

import copy
import math
import os
import shutil

import pytest
import torch
from avx2_run import run_with_avx2
from torch import Tensor

from i2i.nn import native
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_spectral import (
    _coefficient_gradient,
    transform_filters,
    transform_matrix,
)
from i2i.nn.c4_stem import _Compiled, _Unfolded
from i2i.nn.c4_transforms import analyse, synthesise
from i2i.nn.native.stem import StemGeometry
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major, turn_max

needs_library = pytest.mark.skipif(
    native.library() is None, reason="no compiler was found when i2i was installed"
)
SIZES = (4, 5, 8, 9, 16, 17)  # of maps: what is compiled for 3 x 3 kernels
TYPES = [
    (torch.float32, torch.float32, 1e-6),
    (torch.float64, torch.float64, 1e-14),
    (torch.float32, torch.bfloat16, 1e-2),
]


def relative_error(value, reference):
    value, reference = value.double(), reference.double()
    return ((value - reference).norm() / reference.norm()).item()


def in_torch(function, *args, **options):
    with native.torch_only():
        return function(*args, **options)


@needs_library
@pytest.mark.parametrize(("dtype", "spectral", "tolerance"), TYPES)
@pytest.mark.parametrize("batch", [1, 16, 21, 64, 70])
@pytest.mark.parametrize("map_size", SIZES)
def test_spectra_and_maps_are_those_of_torch(map_size, batch, dtype, spectral, tolerance):
    """Whole and broken vectors of images, both orders of the rows."""
    assert native.has_compiled_transform(map_size)
    x = torch.randn(map_size**2, 4, 3, batch, dtype=dtype)
    for fields_first in (False, True):
        options = {"kernel_size": 3, "fields_first": fields_first}
        ours = analyse(x, spectral, **options)
        theirs = in_torch(analyse, x, spectral, **options)
        for part, reference in zip(ours, theirs, strict=True):
            assert part.dtype == spectral
            assert relative_error(part, reference) < tolerance
        noise = tuple(torch.randn_like(part) for part in ours)
        assert relative_error(
            synthesise(noise, x, **options), in_torch(synthesise, noise, x, **options)
        ) < tolerance  # fmt: skip


@needs_library
@pytest.mark.parametrize(("fields", "batch"), [(16, 64), (5, 21)])
def test_nothing_behind_an_array_is_written(fields, batch, monkeypatch):
    """Every array that is written, with room behind it, in whole lines and in broken ones."""
    made = []

    def guarded(shape, dtype, fill):
        room = torch.full((math.prod(shape) + 64,), fill, dtype=dtype)
        made.append(room[-64:])
        return room[:-64].view(shape)

    def new_empty(like, *shape, dtype=None, **_):
        shape = shape[0] if isinstance(shape[0], tuple | torch.Size) else shape
        return guarded(tuple(shape), dtype or like.dtype, 7.0)

    maps = torch.randn(64, 4, fields, batch)
    coefficients, matrix = torch.randn(fields, fields, 24), torch.randn(21 * 16, 24)
    norm = C4BatchNorm(fields)
    monkeypatch.setattr(Tensor, "new_empty", new_empty)
    monkeypatch.setattr(torch, "empty_like", lambda like: new_empty(like, like.shape))
    spectrum = native.analyse(maps, torch.float32, kernel_size=3, fields_first=False)
    back = native.synthesise(
        *spectrum, maps.new_empty(maps.shape), kernel_size=3, fields_first=False
    )
    native.analyse(maps, torch.bfloat16, kernel_size=3, fields_first=True)
    native.blocks(coefficients, matrix, torch.float32)
    native.blocks(coefficients, matrix, torch.bfloat16)
    native.turn_over(maps, to_pixel_major=False)
    x = maps.clone().requires_grad_()
    norm.pixel_major(x, shortcut=x, relu=True).sum().backward()
    turn_max(maps.clone().requires_grad_()).sum().backward()
    stem = _Compiled(torch.randn(2, 1, 4 * fields, 4 * fields), StemGeometry(5, 2, 2, 3, 2, 1))
    stem.moments()
    seen, kept = stem.forward(torch.randn(fields, 26), wants_places=True)
    stem.backward(stem.geometry, stem.image_size, seen, *kept)
    assert len(made) > 12
    assert all((room == 7.0).all() for room in made)
    assert (back != 7.0).all()


@needs_library
def test_bfloat16_spectra_are_rounded_once():
    """To nearest, ties to even, as torch rounds; what is not a number stays so."""
    x = torch.randn(64, 4, 2, 37)
    x[3, 1, 0, 5], x[4, 2, 1, 20] = float("nan"), float("inf")
    exact = analyse(x, torch.float32, kernel_size=3)
    rounded = analyse(x, torch.bfloat16, kernel_size=3)
    for part, reference in zip(rounded, exact, strict=True):
        assert torch.equal(part.isnan(), reference.isnan())
        assert torch.equal(part.nan_to_num(), reference.bfloat16().nan_to_num())
    assert rounded[0].isnan().any()


@needs_library
@pytest.mark.parametrize(("dtype", "spectral", "tolerance"), TYPES)
@pytest.mark.parametrize(("outs", "ins", "count"), [(5, 3, 24), (3, 38, 36), (2, 48, 9)])
def test_blocks_and_their_gradient_are_those_of_torch(outs, ins, count, dtype, spectral, tolerance):
    """With zeros in the matrix, which are left out, and a row of nothing else."""
    coefficients = torch.randn(outs, ins, count, dtype=dtype)
    matrix = torch.randn(21 * 16, count, dtype=dtype)
    matrix = torch.where(torch.rand(matrix.shape) < 0.5, 0.0, matrix)
    matrix[5], matrix[:, 7] = 0.0, 0.0
    blocks = transform_filters(coefficients, matrix, dtype=spectral)
    expected = in_torch(transform_filters, coefficients, matrix, dtype=spectral)
    assert blocks.shape == expected.shape
    assert relative_error(blocks, expected) < tolerance

    def columns(fields):
        parts = (
            torch.randn(20, 4 * fields, 16, dtype=dtype),
            torch.randn(4 * fields, 4, dtype=dtype),
        )
        return tuple(part.to(spectral) for part in parts)

    upstream, spectrum = columns(outs), columns(ins)
    gradient = _coefficient_gradient(upstream, spectrum, matrix)
    expected = in_torch(_coefficient_gradient, upstream, spectrum, matrix)
    assert gradient.shape == expected.shape
    assert relative_error(gradient, expected) < tolerance


STEMS = [  # of channels in and out, image size and geometry
    (1, 152, (32, 32), StemGeometry(5, 2, 2, 3, 2, 1)),
    (3, 20, (33, 33), StemGeometry(5, 2, 2, 3, 2, 1)),
    (1, 36, (24, 20), StemGeometry(4, 2, 1, 2, 2, 0)),
    (2, 4, (17, 23), StemGeometry(3, 1, 1)),
    (1, 8, (21, 21), StemGeometry(9, 1, 4, 5, 3, 2)),
]


@needs_library
@pytest.mark.parametrize("batch", [1, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("colours", "channels", "size", "geometry"), STEMS)
def test_the_stem_is_that_of_torch(colours, channels, size, geometry, dtype, batch):
    images = torch.randn(batch, colours, *size, dtype=dtype)
    images[:, :, : size[0] // 2] = 1.0  # windows whose places are all alike
    weight = torch.randn(channels, colours * geometry.kernel**2 + 1, dtype=dtype)
    upstream = torch.randn(batch, channels, *geometry.out_size(*size), dtype=dtype)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-14

    def outcome(stem):
        out, kept = stem.forward(weight, wants_places=True)
        return [stem.moments(), out, stem.backward(geometry, images.shape[2:], upstream, *kept)]

    expected = outcome(_Unfolded(images, geometry))
    assert expected[1].count_nonzero() < expected[1].numel()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        for ours, theirs in zip(outcome(_Compiled(images, geometry)), expected, strict=True):
            assert ours.shape == theirs.shape
            assert relative_error(ours, theirs) < tolerance


def test_windows_that_see_nothing_of_the_map_are_refused():
    with pytest.raises(ValueError, match="window_padding=2"):
        StemGeometry(5, 2, 2, 3, 2, 2)


@needs_library
def test_the_stem_takes_the_first_of_equal_places_and_what_is_not_a_number():
    """Where torch's max-pool looks, so that its gradient is the same."""
    images = torch.zeros(1, 1, 12, 12)
    images[0, 0, 5, 6], images[0, 0, 9, 2] = float("nan"), 3.0
    weight = torch.tensor([[1.0, 0.5], [-1.0, 0.0], [-1.0, 0.25]])
    geometry = StemGeometry(1, 1, 0, 3, 2, 1)
    out, (_, places) = _Compiled(images, geometry).forward(weight, wants_places=True)
    maps = torch.einsum("ck,bkhw->bchw", weight, torch.cat([images, torch.ones_like(images)], 1))
    expected, where = torch.nn.functional.max_pool2d(maps, 3, 2, 1, return_indices=True)
    assert torch.equal(out.isnan(), expected.isnan())
    assert torch.equal(out.nan_to_num(-1.0), expected.clamp(min=0.0).nan_to_num(-1.0))
    rows = 2 * torch.arange(6)[:, None] - 1 + places.permute(0, 3, 1, 2) // 3
    columns = 2 * torch.arange(6) - 1 + places.permute(0, 3, 1, 2) % 3
    passes = out > 0
    assert torch.equal((12 * rows + columns)[passes], where[passes])
    assert (places.permute(0, 3, 1, 2)[~passes] == 255).all()
    assert not passes[:, 1].any()


@needs_library
@pytest.mark.parametrize("shape", [(3, 8, 5, 5), (64, 12, 8, 8), (21, 4, 17, 17)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_layouts_are_those_of_torch(shape, dtype):
    x = torch.randn(shape, dtype=dtype)
    pixel_major = to_pixel_major(x)
    assert torch.equal(pixel_major, in_torch(to_pixel_major, x))
    assert torch.equal(from_pixel_major(pixel_major), x)
    strided = torch.randn(shape[::-1], dtype=dtype).permute(3, 2, 1, 0)
    assert torch.equal(to_pixel_major(strided), in_torch(to_pixel_major, strided))


@needs_library
@pytest.mark.parametrize("batch", [1, 16, 37])
@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("with_shortcut", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_norm_is_that_of_torch(dtype, with_shortcut, relu, batch):
    """Values, gradients and running statistics of a step; then evaluation."""
    leaves = [3 + 2 * torch.randn(16, 4, 5, batch, dtype=dtype) for _ in range(2)]
    upstream = torch.randn_like(leaves[0])
    norm = C4BatchNorm(5).to(dtype)
    torch.nn.init.normal_(norm.weight)
    torch.nn.init.normal_(norm.bias)

    def outcome(norm):
        x, shortcut = (leaf.clone().requires_grad_() for leaf in leaves)
        options = {"shortcut": shortcut if with_shortcut else None, "relu": relu}
        assert norm._is_compiled(x, options["shortcut"]) == native.is_built_for(x, x.dtype)
        y = norm.pixel_major(x, **options)
        y.backward(upstream)
        gradients = [t.grad for t in (x, shortcut, norm.weight, norm.bias) if t.grad is not None]
        norm.eval()
        with torch.no_grad():
            evaluated = norm.pixel_major(leaves[1], **options)
        frozen = norm.pixel_major(x, **options)  # a gradient through constant moments: torch's
        (of_x,) = torch.autograd.grad(frozen, x, upstream)
        return [y, *gradients, evaluated, of_x, norm.running_mean, norm.running_var]

    ours, expected = outcome(copy.deepcopy(norm)), in_torch(outcome, copy.deepcopy(norm))
    assert len(ours) == len(expected)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-13
    for value, reference in zip(ours, expected, strict=True):
        assert relative_error(value, reference) < tolerance


@needs_library
def test_the_norm_keeps_the_digits_of_a_small_spread_about_a_large_mean():
    exact = 1000 + torch.randn(64, 4, 3, 16, dtype=torch.float64)
    moments = torch.empty(2, 3, dtype=torch.float64)
    x = exact.float()
    y = native.norm(
        x, None, torch.ones(3), torch.zeros(3), moments, eps=0.0, relu=False, fresh=True
    )
    rows = x.double().permute(2, 0, 1, 3).flatten(1)
    assert relative_error(moments[0], rows.mean(dim=1)) < 1e-9
    assert relative_error(moments[1], rows.var(dim=1, correction=0)) < 1e-5
    normal = (rows - moments[0][:, None]) / moments[1].sqrt()[:, None]
    assert relative_error(y.permute(2, 0, 1, 3).flatten(1), normal) < 1e-6


@needs_library
@pytest.mark.parametrize("batch", [1, 16, 37])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_gradient_of_the_largest_turn_is_that_of_torch(dtype, batch):
    """Also where several turns are the largest, as all are behind a ReLU that clipped them."""
    x = torch.relu(torch.randint(-3, 4, (9, 4, 5, batch)).to(dtype)).requires_grad_()
    upstream = torch.randn(9, 5, batch, dtype=dtype)

    def outcome():
        y = turn_max(x)
        return y, torch.autograd.grad(y, x, upstream)[0]

    for ours, expected in zip(outcome(), in_torch(outcome), strict=True):
        torch.testing.assert_close(ours, expected)


@needs_library
def test_the_gradient_of_the_largest_turn_lets_what_is_not_a_number_through():
    x = torch.randn(1, 4, 3, 5)
    x[0, 0, 0, 1] = x[0, 2, 1, 3] = float("nan")
    x.requires_grad_()
    ours, expected = (
        torch.autograd.grad(y.sum(), x)[0] for y in (turn_max(x), in_torch(turn_max, x))
    )
    torch.testing.assert_close(ours, expected, equal_nan=True)
    assert ours.isnan().sum() == 8


def test_the_gradient_of_a_layout_is_the_layout_back():
    x = torch.randn(2, 8, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(to_pixel_major, x)
    assert torch.autograd.gradgradcheck(to_pixel_major, x)


@needs_library
def test_threads_do_not_change_the_result():
    maps = to_pixel_major(torch.randn(20, 12, 8, 8))
    one = analyse(maps, torch.float32, kernel_size=3)
    torch.set_num_threads(2)
    two = analyse(maps, torch.float32, kernel_size=3)
    assert all(map(torch.equal, one, two))


@needs_library
def test_the_library_for_avx2_computes_the_same():
    """What is compared with torch here, on a processor that would take the one for AVX-512."""
    run_with_avx2(__file__, "-k", "of_torch or written or compiler")


def test_where_there_is_a_compiler_there_is_a_library():
    """A source that does not compile would only turn tests into skipped ones."""
    if os.environ.get("I2I_NO_COMPILER") or not (shutil.which("c++") or shutil.which("g++")):
        pytest.skip("no C++ compiler here")
    library = native.library()
    assert library is not None
    assert os.environ.get("I2I_EXPECT", "") in library._name


def test_torch_only_leaves_the_library_aside():
    x = torch.randn(64, 4, 2, 3)
    with native.torch_only():
        assert not native.is_built_for(x, torch.float32)
        assert not native.has_compiled_transform(8)
    assert native.is_built_for(x, torch.float32) == (native.library() is not None)
    assert not native.is_built_for(x.half(), torch.float16)
    assert not native.has_compiled_transform(7)


def test_misfits_are_told_and_empty_batches_pass():
    """As torch tells them; nothing is read or written where it does not fit."""
    norm = C4BatchNorm(3)
    with pytest.raises(RuntimeError):
        norm.pixel_major(torch.randn(16, 4, 5, 8))
    with pytest.raises(RuntimeError):
        norm.pixel_major(torch.randn(16, 4, 3, 8), shortcut=torch.randn(16, 4, 3, 7))
    with pytest.raises(RuntimeError):
        to_pixel_major(torch.randn(2, 6, 4, 4))
    with pytest.raises(RuntimeError):
        transform_filters(torch.randn(2, 2, 35), transform_matrix(8, 3, dtype=torch.float32))
    with pytest.raises(RuntimeError):
        transform_filters(
            torch.randn(2, 2, 36, dtype=torch.float64), transform_matrix(8, 3, dtype=torch.float32)
        )
    assert to_pixel_major(torch.empty(0, 8, 4, 4)).shape == (16, 4, 2, 0)
    assert norm.eval().pixel_major(torch.empty(16, 4, 3, 0)).shape == (16, 4, 3, 0)


def test_a_norm_lets_what_is_not_a_number_through():
    norm = C4BatchNorm(2)
    x = torch.randn(4, 4, 2, 5, requires_grad=True)
    shortcut = torch.zeros(4, 4, 2, 5)
    shortcut[1, 2, 0, 3] = float("nan")
    y = norm.pixel_major(x, shortcut=shortcut, relu=True)
    assert y.isnan().sum() == 1
    (gradient,) = torch.autograd.grad((y * y).sum(), x)
    assert gradient[:, :, 0].isnan().all()
    assert gradient[:, :, 1].isfinite().all()
