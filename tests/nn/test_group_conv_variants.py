"""The stand-ins for the icosahedral correlation against written-out sums, and their symmetries."""

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.nn.group_conv_variants import (
    FullGroupConv,
    UnconstrainedMap,
    VectorFilterConv,
    matched_channels,
)
from i2i.nn.group_convs import DynamicFilterConv
from i2i.testing import assert_equivariant, assert_icosahedral_equivariant

AXES = ("vertex", "twofold")


def place(point, points):
    """Number of the place where a point is, found by its position."""
    distance = (points - point).flatten(1).norm(dim=1)
    assert distance.min() < 1e-6
    return int(distance.argmin())


def direct_vector(conv, mesh, signal, index):
    """`out(g) = Σ_v f(g v)ᵀ ψ(v) + b` with f(v) in R^(n×m), vertex by vertex."""
    out = torch.zeros(len(signal), 60, conv.out_features, dtype=signal.dtype)
    for b, sphere in enumerate(index):
        for g in range(60):
            for i, v in enumerate(mesh.visible.tolist()):
                moved = place(mesh.rotations[g] @ mesh.vertices[v], mesh.vertices)
                out[b, g] += conv.sphere[sphere, moved].T @ signal[b, i]
            out[b, g] += conv.bias[sphere]
    return out


def direct_group(conv, mesh, elements, signal, index):
    """`out(g) = Σ_h f(g h)ᵀ ψ(h) + b`, products of matrices instead of the table."""
    psi = signal.view(len(signal), len(elements), conv.features, conv.out_features)
    out = torch.zeros(len(signal), 60, conv.out_features, dtype=signal.dtype)
    for b, sphere in enumerate(index):
        for g in range(60):
            for i, h in enumerate(elements):
                product = place(mesh.rotations[g] @ mesh.rotations[h], mesh.rotations)
                out[b, g] += conv.sphere[sphere, product] @ psi[b, i]
            out[b, g] += conv.bias[sphere]
    return out


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(("level", "num_spheres"), [(0, 3), (1, 1)])
def test_vector_equals_the_written_out_sum(level, num_spheres, axis):
    mesh = icosahedron(level, mesh_axis=axis)
    conv = VectorFilterConv(5, 4, num_spheres=num_spheres, mesh_level=level, mesh_axis=axis)
    conv = conv.double()
    index = [num_spheres - 1, 0]
    signal = torch.randn(2, len(mesh.visible), 5, dtype=torch.float64)
    with torch.no_grad():
        out = conv(signal, torch.tensor(index))
        expected = direct_vector(conv, mesh, signal, index)
    torch.testing.assert_close(out, expected, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(("support", "num_spheres"), [("identity", 3), ("local13", 1)])
def test_full_group_equals_the_written_out_sum(support, num_spheres, axis):
    mesh = icosahedron(mesh_axis=axis)
    degrees = torch.rad2deg(mesh.angles_rad).round().tolist()
    elements = [g for g in range(60) if degrees[g] <= (0 if support == "identity" else 72)]
    assert len(elements) == (1 if support == "identity" else 13)
    conv = FullGroupConv(5, 4, num_spheres=num_spheres, support=support, mesh_axis=axis).double()
    index = [num_spheres - 1, 0]
    signal = torch.randn(2, len(elements), 20, dtype=torch.float64)
    with torch.no_grad():
        out = conv(signal, torch.tensor(index))
        expected = direct_group(conv, mesh, elements, signal, index)
    torch.testing.assert_close(out, expected, atol=1e-12, rtol=1e-12)


def test_one_element_is_a_product_of_an_embedding_and_the_image():
    conv = FullGroupConv(3, 2)
    signal = torch.randn(4, 1, 6)
    expected = torch.einsum("gn,bnm->bgm", conv.sphere[0], signal.view(4, 3, 2)) + conv.bias
    torch.testing.assert_close(conv(signal), expected)


def with_sphere(conv, signal):
    def layer(sphere):
        return torch.func.functional_call(conv, {"sphere": sphere[None]}, (signal.to(sphere),))

    return layer


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("layer", [DynamicFilterConv, VectorFilterConv])
def test_feature_side_symmetry_on_the_sphere(layer, level, axis):
    """`f'(v) = f(h v)` gives `out'(g) = out(h g)`, for all 60 h; with h⁻¹ it does not."""
    mesh = icosahedron(level, mesh_axis=axis)
    conv = layer(5, 3, mesh_level=level, mesh_axis=axis).double()
    torch.nn.init.normal_(conv.bias)
    signal = torch.randn(2, conv.num_vertices, conv.filter_channels)
    sphere = conv.sphere[0].detach()
    function = with_sphere(conv, signal)
    assert_icosahedral_equivariant(function, sphere, mesh=mesh, vertex_dim=0)
    wrong = assert_equivariant(
        function,
        sphere,
        input_action=lambda h, x: x[mesh.action[h]],
        output_action=lambda h, out: out[:, mesh.multiplication[mesh.inverse[h]]],
        elements=[g for g in range(60) if mesh.inverse[g] != g],
        raise_error=False,
    )
    assert min(wrong.errors) > 0.05


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("support", ["identity", "local13"])
def test_feature_side_symmetry_on_the_group(support, axis):
    """`f'(k) = f(h k)` gives `out'(g) = out(h g)`; turned from the other side it does not."""
    mesh = icosahedron(mesh_axis=axis)
    conv = FullGroupConv(5, 3, support=support, mesh_axis=axis).double()
    signal = torch.randn(2, conv.num_vertices, 15)
    function, sphere = with_sphere(conv, signal), conv.sphere[0].detach()

    def left(h, x):
        return x.index_select(-2, mesh.multiplication[h])

    assert_equivariant(function, sphere, input_action=left, output_action=left, elements=range(60))
    wrong = assert_equivariant(
        function,
        sphere,
        input_action=left,
        output_action=lambda h, out: out[:, mesh.multiplication[:, h]],
        elements=range(1, 60),
        raise_error=False,
    )
    assert min(wrong.errors) > 0.05


@pytest.mark.parametrize("num_spheres", [1, 3])
@pytest.mark.parametrize("reading", ["sampled", "pooled"])
def test_unconstrained_is_a_linear_layer_for_each_class(reading, num_spheres):
    conv = UnconstrainedMap(8, 7, in_channels=10, num_spheres=num_spheres, reading=reading)
    signal = torch.randn(4, conv.num_vertices, conv.filter_channels)
    assert signal.shape[1:] == ((1, 10) if reading == "pooled" else (16, 4))
    index = torch.tensor([0, 1, 2, 0]) % num_spheres
    out = conv(signal, index)
    assert out.shape == (4, 60, 7)
    for b, sphere in enumerate(index.tolist()):
        expected = torch.nn.functional.linear(
            signal[b].flatten(), conv.weight[sphere].T, conv.bias[sphere]
        )
        torch.testing.assert_close(out[b].flatten(), expected)


@pytest.mark.parametrize(
    ("in_channels", "features", "expected"), [(304, 128, 40), (64, 64, 5), (16, 8, 4)]
)
def test_unconstrained_keeps_as_many_channels_as_fit_the_budget(in_channels, features, expected):
    kept = matched_channels(in_channels, features, 7, icosahedron(1))
    assert kept == expected
    if kept > 4:  # the best of all numbers, by counting modules
        sphere = sum(p.numel() for p in DynamicFilterConv(features, 7).parameters())
        wanted = (in_channels + 1) * features * 7 + sphere

        def size(k):
            conv = UnconstrainedMap(features, 7, in_channels=in_channels, reduced=k)
            return (in_channels + 1) * k + sum(p.numel() for p in conv.parameters())

        assert min(range(1, 60), key=lambda k: abs(size(k) - wanted)) == kept


def test_parameters_and_initial_values():
    def count(conv):
        return sum(p.numel() for p in conv.parameters())

    assert count(VectorFilterConv(128, 7)) == 42 * 128 * 7 + 7
    assert count(FullGroupConv(128, 7)) == count(FullGroupConv(128, 7, support="local13"))
    assert count(FullGroupConv(128, 7)) == 60 * 128 + 7
    assert count(UnconstrainedMap(128, 7, in_channels=304, reading="pooled")) == 305 * 420
    vector, matrix = VectorFilterConv(128, 7), DynamicFilterConv(128, 7)
    bound = matrix.sphere.abs().max().item()
    assert vector.sphere.abs().max().item() == pytest.approx(bound, rel=0.02)
    assert set(vector.state_dict()) == set(FullGroupConv(4, 7).state_dict()) == {"sphere", "bias"}


@pytest.mark.parametrize(
    "conv",
    [
        VectorFilterConv(3, 2, num_spheres=2),
        FullGroupConv(3, 2, num_spheres=2, support="local13"),
        UnconstrainedMap(3, 2, in_channels=4, num_spheres=2),
    ],
    ids=lambda conv: type(conv).__name__,
)
def test_wrong_signals_are_refused(conv):
    signal = torch.zeros(1, conv.num_vertices, conv.filter_channels)
    with pytest.raises(ValueError, match="class_id"):
        conv(signal)
    with pytest.raises(ValueError, match=f"{conv.num_vertices}, {conv.filter_channels}"):
        conv(signal[:, 1:], torch.tensor([0]))
    assert "2 × " in repr(conv)


def test_unknown_choices():
    with pytest.raises(ValueError, match="identity, local13"):
        FullGroupConv(3, 2, support="all")
    with pytest.raises(ValueError, match="sampled, pooled"):
        UnconstrainedMap(3, 2, in_channels=4, reading="flat")
    with pytest.raises(ValueError, match="vertex, twofold"):
        VectorFilterConv(3, 2, mesh_axis="face")


@pytest.mark.parametrize(
    ("conv", "formula"),
    [
        (VectorFilterConv(128, 7), "f: V42 -> R^(128×7), ψ: V16 -> R^128"),
        (FullGroupConv(128, 7, support="local13"), "f: I60 -> R^128, ψ: local13 (13)"),
        (UnconstrainedMap(128, 7, in_channels=304), "sampled: R^(16·40) -> R^(60·7)"),
    ],
)
def test_repr_is_the_formula(conv, formula):
    assert formula in repr(conv)
