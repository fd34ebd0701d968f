"""Compiled products of matrices against torch's in double precision."""

import os
import subprocess
import sys

import pytest
import torch
from torch.nn import functional

from i2i.nn import native
from i2i.nn.native import products
from i2i.nn.native.products import linear, multiply, product

pytestmark = pytest.mark.skipif(native.library() is None, reason="no compiler was found")
TYPES = [(torch.float32, 1e-6), (torch.float64, 1e-14)]
# Rows, depth, columns: one number, broken tiles, several passes over depth and columns.
SIZES = [(1, 1, 1), (12, 5, 32), (13, 50, 33), (50, 700, 40), (30, 20, 600), (25, 1300, 530)]


@pytest.fixture(autouse=True)
def taken_everywhere(monkeypatch):
    """Also on processors and for sizes where torch's own are taken."""
    monkeypatch.setattr(products, "_has_fast_products", lambda: True)
    monkeypatch.setattr(products, "_LEAST_MULTIPLICATIONS", 0)


def relative_error(value, reference):
    return ((value.double() - reference).norm() / reference.norm()).item()


def turned(x):
    """The same matrices, column by column in memory."""
    return x.mT.contiguous().mT


def every_second(x):
    return x.repeat_interleave(2, dim=-1)[..., ::2]


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize("lie", [torch.clone, turned, every_second])
@pytest.mark.parametrize("size", SIZES)
def test_products_are_those_of_double_precision(size, lie, dtype, tolerance):
    rows, depth, columns = size
    left, right = torch.randn(rows, depth), torch.randn(depth, columns)
    for a, b in ((lie(left), right), (left, lie(right)), (lie(left), lie(right))):
        out = multiply(a.to(dtype), b.to(dtype))
        assert out.dtype == dtype
        assert relative_error(out, a.double() @ b.double()) < tolerance


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 3, 20])
def test_one_matrix_meets_several(count, threads):
    several, one = torch.randn(count, 14, 30), torch.randn(30, 37)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for a, b in (
            (several, one),
            (one.mT, several.mT),
            (several, one.expand(count, -1, -1)),
            (several, torch.randn(count, 30, 37)),
            (several.permute(1, 0, 2), torch.randn(14, 30, 3)),
        ):
            out = multiply(a, b)
            assert out.shape == (a.double() @ b.double()).shape
            assert relative_error(out, a.double() @ b.double()) < 1e-6
    finally:
        torch.set_num_threads(before)


def test_threads_do_not_change_a_number():
    left, right = torch.randn(100, 700), torch.randn(700, 90)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(multiply(left, right))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_only_the_place_that_is_given_is_written():
    room = torch.full((4, 20, 64), 7.0)
    left, right = torch.randn(2, 13, 650), torch.randn(2, 650, 41)
    out = room[1:3, 2:15, 5:46]
    assert multiply(left, right, out=out) is out
    assert relative_error(out, left.double() @ right.double()) < 1e-6
    out.fill_(7.0)
    assert (room == 7.0).all()


def test_what_does_not_fit_is_refused_and_empty_batches_pass():
    with pytest.raises(ValueError, match=r"\(3, 4\) and \(5, 2\)"):
        multiply(torch.zeros(3, 4), torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"\(2, 3, 4\) and \(3, 4, 2\)"):
        multiply(torch.zeros(2, 3, 4), torch.zeros(3, 4, 2))
    with pytest.raises(ValueError, match="out"):
        multiply(torch.zeros(3, 4), torch.zeros(4, 2), out=torch.zeros(3, 3))
    assert multiply(torch.zeros(0, 4), torch.zeros(4, 2)).shape == (0, 2)
    assert linear(torch.zeros(0, 4), torch.zeros(2, 4), torch.zeros(2)).shape == (0, 2)


def parameters(*shape):
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize(
    ("left", "right"),
    [((5, 7), (7, 3)), ((4, 5, 7), (7, 3)), ((5, 7), (4, 7, 3)), ((4, 5, 7), (4, 7, 3))],
)
def test_gradients_of_products(left, right):
    given = parameters(*left), parameters(*right)
    assert torch.autograd.gradcheck(product, given)
    assert torch.autograd.gradgradcheck(product, given)
    assert torch.autograd.gradcheck(lambda a, b: product(a.mT, b.mT), (given[1], given[0]))


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(6, 5), (2, 3, 5)])
def test_gradients_of_linear_layers(shape, relu):
    given = parameters(*shape), parameters(4, 5), parameters(4)
    assert torch.autograd.gradcheck(lambda *all_: linear(*all_, relu=relu), given)
    assert torch.autograd.gradgradcheck(lambda *all_: linear(*all_, relu=relu), given)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize(("depth", "outs"), [(5, 4), (1500, 40), (30, 1100)])
def test_linear_layers_are_those_of_torch(depth, outs, dtype, tolerance):
    """The bias is added once, and what is clipped is the whole sum."""
    x, weight, bias = torch.randn(3, 7, depth), torch.randn(outs, depth), 10 * torch.randn(outs)
    exact = functional.linear(x.double(), weight.double(), bias.double())
    given = x.to(dtype), weight.to(dtype), bias.to(dtype)
    assert relative_error(linear(*given), exact) < tolerance
    assert relative_error(linear(*given, relu=True), exact.relu()) < tolerance
    assert (exact < 0).any()


def test_what_is_not_a_number_stays_so():
    x = torch.randn(20, 30)
    x[3, 4] = float("nan")
    out = linear(x, torch.randn(40, 30), torch.zeros(40), relu=True)
    assert out[3].isnan().all()
    assert not out[:3].isnan().any()
    assert not out[4:].isnan().any()


def test_autocast_and_torch_only_leave_products_to_torch():
    left, right = torch.randn(50, 60), torch.randn(60, 70)
    with torch.autocast("cpu", torch.bfloat16):
        assert product(left, right).dtype == torch.bfloat16
        assert linear(left, right.mT, torch.zeros(70)).dtype == torch.bfloat16
    with native.torch_only():
        assert torch.equal(multiply(left, right), left @ right)
    half = left.bfloat16()
    assert torch.equal(multiply(half, right.bfloat16()), half @ right.bfloat16())


@pytest.mark.skipif("I2I_EXPECT" in os.environ, reason="this is the run for AVX2")
def test_the_library_for_avx2_multiplies_too():
    if torch.backends.cpu.get_cpu_capability() != "AVX512":
        pytest.skip("the library for AVX2 is the one that the other tests take, or there is none")
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", __file__],
        env={**os.environ, "ATEN_CPU_CAPABILITY": "avx2", "I2I_EXPECT": "avx2"},
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
