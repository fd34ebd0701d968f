"""Compiled products of matrices against torch's in double precision."""

import os

import pytest
import torch
from avx2_run import run_with_avx2
from torch.nn import functional

from i2i.nn import native
from i2i.nn.native import products
from i2i.nn.native.products import linear, multiply, product

# The run for AVX2 below must not pass because there is nothing to test.
pytestmark = pytest.mark.skipif(
    native.library() is None and "I2I_EXPECT" not in os.environ, reason="no compiler was found"
)
TYPES = [(torch.float32, 1e-6), (torch.float64, 1e-14)]
# Rows, depth, columns: one number, broken tiles, several passes over depth and columns.
SIZES = [
    (1, 1, 1), (12, 5, 32), (13, 50, 33), (24, 35, 48),
    (50, 700, 40), (30, 20, 600), (25, 1300, 530),
]  # fmt: skip


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


def amid_others(x):
    """Rows and columns of a larger matrix whose other numbers would be seen in every sum."""
    return functional.pad(x, (3, 5, 2, 1), value=float("nan"))[2:-1, 3:-5]


def one_row(x):
    """Again and again, with a step of 0 from one to the next."""
    return x[:1].expand(x.shape)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize("lie", [torch.clone, turned, every_second, amid_others, one_row])
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
    torch.set_num_threads(threads)
    for a, b in (
        (several, one),
        (one.mT, several.mT),
        (several, one.expand(count, -1, -1)),
        (several, torch.randn(count, 30, 37)),
        (several.permute(1, 0, 2), torch.randn(14, 30, 3)),
    ):
        for dtype, tolerance in TYPES:
            out = multiply(a.to(dtype), b.to(dtype))
            assert out.shape == (a @ b).shape
            assert relative_error(out, a.double() @ b.double()) < tolerance


@pytest.mark.parametrize(("dtype", "_"), TYPES)
@pytest.mark.parametrize(
    ("left", "right"), [((100, 700), (700, 90)), ((3, 50, 700), (700, 90)), ((9, 50), (2, 50, 600))]
)
def test_threads_do_not_change_a_number(left, right, dtype, _):
    left, right = torch.randn(left, dtype=dtype), torch.randn(right, dtype=dtype)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append((multiply(left, right), multiply(right.mT, left.mT)))
    for other in results[1:]:
        assert all(map(torch.equal, results[0], other))


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
def test_only_the_place_that_is_given_is_written(dtype, tolerance):
    """What is there before is not added, and what lies around it stays."""
    room = torch.full((4, 20, 64), 7.0, dtype=dtype)
    left, right = torch.randn(2, 13, 650, dtype=dtype), torch.randn(2, 650, 41, dtype=dtype)
    for some in (slice(1, 3), 2):
        out = room[some, 2:15, 5:46]
        given = (left, right) if out.ndim == 3 else (left[0], right[0])
        assert multiply(*given, out=out) is out
        assert relative_error(out, given[0].double() @ given[1].double()) < tolerance
        out.fill_(7.0)
        assert (room == 7.0).all()


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"\(3, 4\) and \(5, 2\)"):
        multiply(torch.zeros(3, 4), torch.zeros(5, 2))
    with pytest.raises(RuntimeError):  # torch's own
        multiply(torch.zeros(2, 3, 4), torch.zeros(3, 4, 2))
    with pytest.raises(ValueError, match=r"\(6, 5\) and \(4, 2\)"):
        linear(torch.zeros(2, 3, 5), torch.zeros(2, 4), torch.zeros(2))
    narrow, wide = torch.zeros(3, 2), torch.zeros(3, 2, dtype=torch.float64)
    for out in (torch.zeros(3, 3), torch.zeros(1, 3, 2), wide, turned(narrow)):
        with pytest.raises(ValueError, match="out"):
            multiply(torch.zeros(3, 4), torch.zeros(4, 2), out=out)


def test_a_bias_of_another_length_is_for_torch_to_judge():
    """The library would read behind its end."""
    x, weight = torch.randn(6, 5), torch.randn(40, 5)
    with pytest.raises(RuntimeError):
        linear(x, weight, torch.zeros(3))
    one = torch.full((1,), 2.0)
    assert torch.equal(linear(x, weight, one), functional.linear(x, weight, one))


def test_more_dimensions_are_those_of_torch():
    for left, right in (((2, 3, 5, 7), (7, 4)), ((5, 7), (2, 3, 7, 4)), ((5, 7), (7,))):
        a, b = torch.randn(left), torch.randn(right)
        for compute in (multiply, product):
            torch.testing.assert_close(compute(a, b), torch.matmul(a, b))


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


@pytest.mark.parametrize("of_right", [torch.clone, turned])
@pytest.mark.parametrize("of_left", [torch.clone, turned])
@pytest.mark.parametrize(("left", "right"), [((5, 7), (7, 3)), ((4, 5, 7), (4, 7, 3))])
def test_gradients_lie_as_what_they_are_of(left, right, of_left, of_right):
    """An optimiser reads both together."""
    a, b = (
        of_left(torch.randn(left)).requires_grad_(),
        of_right(torch.randn(right)).requires_grad_(),
    )
    out = product(a, b)
    for upstream in (torch.randn(out.shape), turned(torch.randn(out.shape)), torch.ones(())):
        gradients = torch.autograd.grad(out, (a, b), upstream.expand(out.shape), retain_graph=True)
        exact = (
            upstream.double().expand(out.shape) @ b.double().mT,
            a.double().mT @ upstream.double().expand(out.shape),
        )
        for gradient, of, expected in zip(gradients, (a, b), exact, strict=True):
            assert gradient.stride() == of.stride()
            assert relative_error(gradient, expected) < 1e-6


def test_only_the_gradients_that_are_wanted_are_taken(monkeypatch):
    taken = []
    multiply_ = products._multiply
    monkeypatch.setattr(
        products, "_multiply", lambda *given, **how: taken.append(1) or multiply_(*given, **how)
    )
    product(torch.randn(5, 7, requires_grad=True), torch.randn(7, 3)).sum().backward()
    assert len(taken) == 2
    linear(torch.randn(5, 7), torch.randn(3, 7), torch.randn(3).requires_grad_()).sum().backward()
    assert len(taken) == 3


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(6, 5), (2, 3, 5)])
def test_gradients_of_linear_layers(shape, relu):
    given = parameters(*shape), parameters(4, 5), parameters(4)
    assert torch.autograd.gradcheck(lambda *all_: linear(*all_, relu=relu), given)
    assert torch.autograd.gradgradcheck(lambda *all_: linear(*all_, relu=relu), given)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize(("depth", "outs"), [(5, 4), (1500, 40), (1500, 48), (30, 1100)])
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


def test_autocast_is_that_of_torch():
    left, right, bias = torch.randn(50, 60), torch.randn(60, 70), torch.randn(70)
    with torch.autocast("cpu", torch.bfloat16):
        ours, expected = product(left, right), left @ right
        assert ours.dtype == expected.dtype == torch.bfloat16
        assert torch.equal(ours, expected)
        for relu in (False, True):
            ours = linear(left, right.mT, bias, relu=relu)
            expected = functional.linear(left, right.mT, bias)
            assert ours.dtype == expected.dtype == torch.bfloat16
            assert torch.equal(ours, expected.relu() if relu else expected)


@pytest.mark.parametrize("is_fast", [True, False])
def test_products_without_a_gradient_keep_their_type_under_autocast(is_fast, monkeypatch):
    monkeypatch.setattr(products, "_has_fast_products", lambda: is_fast)
    left, right = torch.randn(50, 60), torch.randn(60, 70)
    with torch.autocast("cpu", torch.bfloat16):
        ours = multiply(left, right)
    torch.testing.assert_close(ours, left @ right)


def test_what_is_torchs_does_not_reach_the_library(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("reached the library")

    monkeypatch.setattr(products, "functions", refuse)
    left, right, bias = torch.randn(50, 60), torch.randn(60, 70), torch.randn(70)

    def all_are_torchs(left, right, bias):
        exact = functional.linear(left, right.mT, bias)
        return (
            torch.equal(multiply(left, right), left @ right)
            and torch.equal(product(left, right), left @ right)
            and torch.equal(linear(left, right.mT, bias), exact)
            and torch.equal(linear(left, right.mT, bias, relu=True), exact.relu())
        )

    for compute in (lambda: multiply(left, right), lambda: linear(left, right.mT, bias)):
        with pytest.raises(AssertionError, match="reached the library"):
            compute()
    with native.torch_only():
        assert all_are_torchs(left, right, bias)
    assert all_are_torchs(left.bfloat16(), right.bfloat16(), bias.bfloat16())
    assert all_are_torchs(left[:0], right, bias)
    assert all_are_torchs(left[:, :0], right[:0], bias)
    assert all_are_torchs(left, right[:, :0], bias[:0])
    for name, value in (("_LEAST_MULTIPLICATIONS", 1 << 30), ("_has_fast_products", lambda: False)):
        with monkeypatch.context() as for_now:
            for_now.setattr(products, name, value)
            assert all_are_torchs(left, right, bias)


def test_the_library_is_the_one_that_was_asked_for():
    assert os.environ.get("I2I_EXPECT", "") in native.library()._name


@pytest.mark.skipif("I2I_EXPECT" in os.environ, reason="this is the run for AVX2")
def test_the_library_for_avx2_multiplies_too():
    run_with_avx2(__file__)
