"""The icosahedral correlation against the written-out sum, its symmetries, and the oracle."""

import os

import pytest
import torch
from avx2_run import run_with_avx2

from i2i.geometry.icosahedron import icosahedron
from i2i.nn import native
from i2i.nn.group_conv_variants import FullGroupConv
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.native.correlation import correlate
from i2i.nn.projectors import IcosahedralProjector
from i2i.testing import assert_icosahedral_equivariant, run_oracle

needs_library = pytest.mark.skipif(
    native.library() is None and "I2I_EXPECT" not in os.environ, reason="no compiler was found"
)


def direct(conv, mesh, signal, index=None):
    """`out(g) = Σ_v f(g v) ψ(v) + b`, element by element and vertex by vertex."""
    batch = len(signal)
    psi = signal.view(batch, conv.num_vertices, conv.features, conv.out_features)
    out = torch.zeros(batch, 60, conv.out_features, dtype=signal.dtype)
    for b in range(batch):
        sphere = 0 if index is None else int(index[b])
        for g in range(60):
            for i, v in enumerate(mesh.visible.tolist()):
                moved = mesh.action[g, v]
                out[b, g] += conv.sphere[sphere, moved] @ psi[b, i]
            out[b, g] += conv.bias[sphere]
    return out


@pytest.mark.parametrize("axis", ["vertex", "twofold"])
@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("num_spheres", [1, 3])
@pytest.mark.usefixtures("both_forms")
def test_equals_the_written_out_sum(level, num_spheres, axis):
    torch.manual_seed(0)
    conv = DynamicFilterConv(5, 4, num_spheres=num_spheres, mesh_level=level, mesh_axis=axis)
    conv, mesh = conv.double(), icosahedron(level, mesh_axis=axis)
    index = torch.tensor([2, 0]) if num_spheres > 1 else None
    signal = torch.randn(2, conv.num_vertices, 20, dtype=torch.float64)
    with torch.no_grad():
        out, expected = conv(signal, index), direct(conv, mesh, signal, index)
    assert out.shape == (2, 60, 4)
    torch.testing.assert_close(out, expected, atol=1e-12, rtol=1e-12)
    single = conv.float()(signal.float(), index)
    torch.testing.assert_close(single.double(), expected, atol=1e-6, rtol=1e-5)


def _with_sphere(conv, signal):
    def layer(sphere):
        return torch.func.functional_call(conv, {"sphere": sphere[None]}, (signal.to(sphere),))

    return layer


@pytest.mark.parametrize("level", [0, 1])
def test_feature_side_symmetry(level):
    torch.manual_seed(0)
    conv = DynamicFilterConv(5, 3, mesh_level=level).double()
    signal = torch.randn(2, conv.num_vertices, 15)
    assert_icosahedral_equivariant(
        _with_sphere(conv, signal), conv.sphere[0].detach(), mesh=icosahedron(level)
    )


def test_filter_side_symmetry_holds_for_the_five_turns_only():
    """The half mesh goes into itself under the turns about its own axis and under no other."""
    torch.manual_seed(0)
    mesh = icosahedron(1)
    conv = DynamicFilterConv(5, 3).double()

    def layer(whole):  # a filter on all vertices, of which the layer takes the visible half
        return conv(whole[:, mesh.visible])

    on_half = torch.zeros(2, 42, 15)
    on_half[:, mesh.visible] = torch.randn(2, 16, 15)
    assert_icosahedral_equivariant(layer, on_half, side="filter", elements=range(5))
    report = assert_icosahedral_equivariant(
        layer, on_half, side="filter", elements=range(5, 60), raise_error=False
    )
    assert min(report.errors) > 0.05


def test_unconstrained_layer_fails():
    torch.manual_seed(0)
    linear = torch.nn.Linear(42 * 5, 60 * 3)
    with pytest.raises(AssertionError):
        assert_icosahedral_equivariant(
            lambda sphere: linear.to(sphere)(sphere.flatten()).view(60, 3), torch.randn(42, 5)
        )


@pytest.mark.parametrize("normalize", [False, True])
def test_oracle_through_the_real_layers(normalize):
    """A perfect encoder's maps, our projector and our correlation find the element of `view`."""
    projector = IcosahedralProjector(
        256, 1, map_size=8, relu=False, normalize_midpoints=normalize
    ).double()
    conv = DynamicFilterConv(256, 1).double()
    torch.nn.init.zeros_(conv.bias)

    @torch.no_grad()
    def correlate(sphere, psi):
        conv.sphere.copy_(sphere[None])
        return conv(psi).squeeze(-1)

    result = run_oracle(
        normalize_midpoints=normalize, sampler=projector.sample, correlate=correlate
    )
    assert result.num_views >= 2000
    assert result.nearest > (0.92 if normalize else 0.85)
    assert result.one_of_two > 0.97
    assert result.wrong_inverse < 0.5
    assert result.wrong_frame < 0.5


def test_published_axes_fail_the_oracle_on_rasters():
    projector = IcosahedralProjector(256, 1, map_size=8, projector_axes="published").double()
    result = run_oracle(num_fields=1, sampler=projector.sample)
    assert result.nearest < 0.5


def test_parameters_and_initial_values():
    torch.manual_seed(0)
    conv = DynamicFilterConv(128, 7)
    assert sum(p.numel() for p in conv.parameters()) == 5_383
    bound = (6 / (42 * 128 + 128)) ** 0.5
    assert 0.95 * bound < conv.sphere.abs().max() <= bound
    assert set(conv.state_dict()) == {"sphere", "bias"}


def _with_gradients(conv, signal, index, upstream):
    """What a layer gives, and the gradients of its signal and parameters."""
    signal = signal.clone().requires_grad_()
    out = conv(signal, index)
    return [out.detach(), *torch.autograd.grad(out, [signal, *conv.parameters()], upstream)]


@needs_library
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-13)])
@pytest.mark.parametrize("batch", [1, 5])
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (DynamicFilterConv, {"features": 128, "out_features": 7}),
        (DynamicFilterConv, {"features": 37, "out_features": 1, "mesh_level": 0}),
        (DynamicFilterConv, {"features": 48, "out_features": 8, "mesh_level": 2}),
        (DynamicFilterConv, {"features": 50, "out_features": 40, "num_spheres": 3}),
        (FullGroupConv, {"features": 20, "out_features": 9, "support": "local13"}),
        (FullGroupConv, {"features": 20, "out_features": 2, "num_spheres": 2}),
    ],
)
def test_the_compiled_sums_and_their_gradients_are_those_of_torch(
    kind, options, batch, dtype, tolerance
):
    torch.manual_seed(0)
    conv = kind(**options).to(dtype)
    signal = torch.randn(batch, conv.num_vertices, conv.filter_channels, dtype=dtype)
    upstream = torch.randn(batch, 60, conv.out_features, dtype=dtype)
    index = torch.arange(batch) % conv.num_spheres if conv.num_spheres > 1 else None
    ours = _with_gradients(conv, signal, index, upstream)
    with native.torch_only():
        theirs = _with_gradients(conv, signal, index, upstream)
    for value, reference in zip(ours, theirs, strict=True):
        assert value.shape == reference.shape
        assert ((value - reference).norm() / reference.norm()).item() < tolerance


# First and last place of the sphere that meets a place of the signal: alone, equal, overlapping,
# with the same beginning or the same end.
RANGES = [(0, 44), (3, 6), (44, 44), (9, 29), (3, 6), (3, 25), (5, 29)]


@needs_library
@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("outputs", [1, 3, 8, 12, 17])
def test_elements_that_move_places_anywhere(outputs, threads):
    torch.manual_seed(0)
    torch.set_num_threads(threads)
    moved = torch.stack([
        torch.cat([torch.randint(low, high + 1, (9,)), torch.tensor([low, high])])
        for low, high in RANGES
    ]).int()  # fmt: skip
    signal = torch.randn(3, len(RANGES), 18 * outputs, dtype=torch.float64, requires_grad=True)
    spheres = torch.randn(2, 45, 18, dtype=torch.float64, requires_grad=True)
    index = torch.tensor([1, 0, 1])
    out = correlate(signal, spheres, index, moved)
    places = spheres[index][:, moved.long()]  # (images, places of the signal, elements, features)
    expected = torch.einsum("bvgn,bvnm->bgm", places, signal.unflatten(2, (18, outputs)))
    torch.testing.assert_close(out, expected)
    upstream = torch.randn_like(out)
    ours = torch.autograd.grad(out, [signal, spheres], upstream)
    torch.testing.assert_close(ours, torch.autograd.grad(expected, [signal, spheres], upstream))


@pytest.mark.usefixtures("both_forms")
def test_a_signal_of_any_strides_and_what_is_not_a_number():
    torch.manual_seed(0)
    conv = DynamicFilterConv(5, 3).double()
    wide = torch.randn(2, conv.num_vertices, 30, dtype=torch.float64)
    with torch.no_grad():
        torch.testing.assert_close(conv(wide[..., ::2]), conv(wide[..., ::2].contiguous()))
        wide[1, 3, 4] = float("nan")
        out = conv(wide[..., ::2])
    assert not out[0].isnan().any()
    assert out[1].isnan().any()


@needs_library
@pytest.mark.parametrize("turn", [torch.Tensor.expand_as, lambda x, like: like.mT.contiguous().mT])
def test_upstream_gradients_of_any_strides(turn):
    """They are copied for the call, and the copy has to last until it is over."""
    torch.manual_seed(0)
    conv = DynamicFilterConv(64, 7).double()
    signal = torch.randn(20, 16, conv.filter_channels, dtype=torch.float64)
    upstream = turn(torch.ones(1, dtype=torch.float64), torch.randn(20, 60, 7).double())
    assert not upstream.is_contiguous()
    ours = _with_gradients(conv, signal, None, upstream)
    with native.torch_only():
        theirs = _with_gradients(conv, signal, None, upstream)
    torch.testing.assert_close(ours, theirs, atol=1e-11, rtol=1e-11)


@pytest.mark.usefixtures("both_forms")
@pytest.mark.parametrize("index", [torch.tensor([1, 0, 1], dtype=torch.int32), torch.tensor([1])])
def test_an_index_of_another_type_or_for_all_images(index):
    conv = DynamicFilterConv(5, 4, num_spheres=2).double()
    signal = torch.randn(3, 16, 20, dtype=torch.float64)
    expected = conv(signal, index.long().expand(3))
    torch.testing.assert_close(conv(signal, index), expected)


@needs_library
@pytest.mark.parametrize("index", [[2, 0], [-1, 0]])
def test_an_index_without_a_sphere_is_refused(index):
    conv = DynamicFilterConv(2, 3, num_spheres=2)
    with pytest.raises(IndexError, match="spheres 0 to 1"):
        correlate(torch.zeros(2, 16, 6), conv.sphere, torch.tensor(index), conv.moved)
    with pytest.raises(RuntimeError):
        correlate(torch.zeros(2, 16, 6), conv.sphere, torch.tensor([0, 0, 0]), conv.moved)


@needs_library
def test_the_library_for_avx2_correlates_too():
    run_with_avx2(__file__)


def test_transforms_of_functions_pass_through():
    """`torch.func` takes torch's form."""
    conv = DynamicFilterConv(3, 2).double()
    signal = torch.randn(2, 16, 6, dtype=torch.float64, requires_grad=True)
    of_sum = torch.func.grad(lambda x: conv(x).square().sum())(signal)
    (expected,) = torch.autograd.grad(conv(signal).square().sum(), signal)
    torch.testing.assert_close(of_sum, expected)


def test_channel_order_is_output_fastest():
    conv = DynamicFilterConv(2, 3)
    torch.nn.init.zeros_(conv.bias)
    signal = torch.zeros(1, 16, 6)
    signal[0, 0, 1 * 3 + 2] = 1.0  # n = 1, m = 2 at the centre vertex
    out = conv(signal)[0]
    assert torch.equal(out[:, :2], torch.zeros(60, 2))
    moved = icosahedron(1).action[:, 0]
    torch.testing.assert_close(out[:, 2], conv.sphere[0, moved, 1])


def test_errors():
    conv = DynamicFilterConv(2, 3, num_spheres=2)
    with pytest.raises(ValueError, match="class_id"):
        conv(torch.zeros(1, 16, 6))
    with pytest.raises(ValueError, match="16, 6"):
        conv(torch.zeros(1, 6, 6), torch.tensor([0]))


def test_repr_is_the_formula():
    text = repr(DynamicFilterConv(128, 7, num_spheres=10))
    assert "10 × f: V42 -> R^128" in text
    assert "Σ_v f(g·v)ᵀ ψ(v)" in text
