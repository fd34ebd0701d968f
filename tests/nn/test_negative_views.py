"""Tensors whose sign is still to be turned (`z.conj().imag`): what lies in memory is not them."""

import pytest
import torch
from torch.nn import functional

from i2i.nn.c4 import C4Conv, group_max_pool, regular_type
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_stem import stem_map
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.native import products
from i2i.nn.native.products import linear, multiply, product
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major, turn_max

WEIGHT, BIAS = torch.randn(40, 50).double(), torch.randn(40).double()
CONV = C4Conv(regular_type(3), regular_type(2), 3, padding=1, bias=False).double()
STEM = C4Conv(regular_type(1), regular_type(2), 5, padding=2, bias=False).double()
STEM_NORM = C4BatchNorm(2).double()
NORM = C4BatchNorm(3).double()
CORRELATION = DynamicFilterConv(5, 4).double()

# What is computed, and the shape that it takes.
FUNCTIONS = {
    "product": (lambda x: product(x, WEIGHT.mT), (60, 50)),
    "product of it": (lambda x: product(WEIGHT, x), (50, 60)),
    "linear": (lambda x: linear(x, WEIGHT, BIAS, relu=True), (60, 50)),
    "bias": (lambda x: linear(WEIGHT, WEIGHT, x), (40,)),
    "correlation": (CORRELATION, (3, 16, 20)),
    "norm": (NORM.pixel_major, (16, 4, 3, 7)),
    "shortcut": (
        lambda x: NORM.pixel_major(torch.ones_like(x), shortcut=x, relu=True),
        (16, 4, 3, 7),
    ),
    "spectral": (CONV.pixel_major, (64, 4, 3, 7)),
    "to pixel-major": (to_pixel_major, (3, 8, 5, 5)),
    "from pixel-major": (from_pixel_major, (16, 4, 2, 3)),
    "turns": (turn_max, (16, 4, 2, 3)),
    "turns of a map": (group_max_pool, (3, 8, 5, 5)),
    "stem": (lambda x: stem_map(x, STEM, STEM_NORM, torch.nn.MaxPool2d(2)), (3, 4, 12, 12)),
}


@pytest.fixture(autouse=True)
def products_are_taken(monkeypatch):
    """Also on processors where torch's own are."""
    monkeypatch.setattr(products, "_has_fast_products", lambda: True)


def as_negative_view(x):
    """The same numbers, in memory with the other sign."""
    view = torch._neg_view(x.neg())  # what `conj().imag` has inside, and contiguous
    assert view.is_neg()
    assert view.stride() == x.stride()
    assert torch.equal(view, x)
    return view


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_result_is_that_of_the_numbers(name):
    compute, shape = FUNCTIONS[name]
    x = torch.randn(shape, dtype=torch.float64)
    with torch.no_grad():
        torch.testing.assert_close(compute(as_negative_view(x)), compute(x))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_upstream_gradients_count_as_they_are(name):
    compute, shape = FUNCTIONS[name]
    x = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    out = compute(x)
    upstream = torch.randn_like(out)
    # The stem is differentiable in its weights.
    of = STEM.weights if name == "stem" else x
    ours = torch.autograd.grad(out, of, as_negative_view(upstream), retain_graph=True)
    torch.testing.assert_close(ours, torch.autograd.grad(out, of, upstream))


def test_products_without_a_gradient():
    x = torch.randn(60, 50, dtype=torch.float64)
    torch.testing.assert_close(
        multiply(as_negative_view(x), WEIGHT.mT), functional.linear(x, WEIGHT)
    )
