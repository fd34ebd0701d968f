"""Group convolutions of views: against their sums, and equivariant under all 60 rotations."""

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.view_sets import view_permutations
from i2i.nn.view_convs import GroupConv, TappedConv, ViewsToGroup
from i2i.testing.equivariance import assert_equivariant

GROUP = icosahedron(0)
SETS = {"icosahedron_12": 12, "dodecahedron_20": 20}
LAYERS = {
    "12": (lambda: ViewsToGroup(3, 4), view_permutations("icosahedron_12")),
    "20": (
        lambda: ViewsToGroup(3, 4, camera_set="dodecahedron_20"),
        view_permutations("dodecahedron_20"),
    ),
    "60": (lambda: GroupConv(3, 4), GROUP.multiplication),
    "60 identity": (lambda: GroupConv(3, 4, support="identity"), GROUP.multiplication),
}
every = pytest.mark.parametrize("name", list(LAYERS))


def make(name):
    torch.manual_seed(0)
    layer = LAYERS[name][0]()
    torch.nn.init.normal_(layer.bias)
    return layer


def signal(name):
    generator = torch.Generator().manual_seed(1)
    return torch.randn(2, LAYERS[name][1].shape[1], 3, dtype=torch.float64, generator=generator)


def turned(table):
    """x'(v) = x(h⁻¹ v), along the second axis."""
    return lambda h, x: x.index_select(1, table[GROUP.inverse[h]])


@every
def test_sixty_rotations_of_the_object_rotate_the_output(name):
    table = LAYERS[name][1]
    report = assert_equivariant(
        make(name), signal(name), elements=range(60),
        input_action=turned(table), output_action=turned(GROUP.multiplication),
    )  # fmt: skip
    assert report.max_error < 1e-14


@every
def test_the_other_side_fails(name):
    table = LAYERS[name][1]
    report = assert_equivariant(
        make(name), signal(name), elements=range(60), raise_error=False,
        input_action=turned(table),
        output_action=lambda h, out: out.index_select(1, GROUP.multiplication[:, h]),
    )  # fmt: skip
    # The identity alone passes; the other 59 are far off.
    assert sum(error > 0.1 for error in report.errors) == 59


def test_filters_on_the_left_do_not_commute():
    """The sum with h·g in place of g·h, which is the easy mistake."""
    support = GROUP.elements_within(72)
    layer = TappedConv(3, 4, moved=GROUP.multiplication[support].T, num_places=60)
    report = assert_equivariant(
        layer, signal("60"), elements=range(60), raise_error=False,
        input_action=turned(GROUP.multiplication), output_action=turned(GROUP.multiplication),
    )  # fmt: skip
    assert sum(error > 0.1 for error in report.errors) == 59


@every
def test_against_the_sum_by_matrices(name):
    """Places found with the rotation matrices, not with the tables."""
    layer, x = make(name).double(), signal(name)
    rotations = GROUP.rotations
    if name in ("12", "20"):
        places = GROUP.vertices if name == "12" else GROUP.vertices[GROUP.faces].mean(dim=1)
        taps = places
        read = torch.einsum("gij,vj->gvi", rotations, taps)
        found = torch.cdist(read, places.expand(60, -1, -1)).argmin(dim=2)
    else:
        angles = (rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
        near = angles > (0.3 if name == "60" else 0.99)  # cos 72° = 0.309
        taps = rotations[near]
        read = torch.einsum("gij,hjk->ghik", rotations, taps).flatten(2)
        found = torch.cdist(read, rotations.flatten(1).expand(60, -1, -1)).argmin(dim=2)
    assert len(taps) == layer.taps == {"12": 12, "20": 20, "60": 13, "60 identity": 1}[name]
    expected = layer.bias.detach().expand(2, 60, 4).clone()
    for g in range(60):
        for tap in range(len(taps)):
            expected[:, g] += x[:, found[g, tap]] @ layer.weight[tap].detach()
    torch.testing.assert_close(layer(x).detach(), expected)


def test_support_is_a_class_closed_under_inversion():
    support = set(GROUP.elements_within(72).tolist())
    assert {int(GROUP.inverse[h]) for h in support} == support
    table = GROUP.multiplication
    for g in range(60):
        assert {int(table[table[g, h], GROUP.inverse[g]]) for h in support} == support


def test_sizes_start_and_gradients():
    torch.manual_seed(0)
    layer = GroupConv(64, 32)
    assert sum(p.numel() for p in layer.parameters()) == 13 * 64 * 32 + 32
    out = layer(torch.randn(8, 60, 64))
    assert out.detach().std().item() == pytest.approx(
        2**0.5, rel=0.1
    )  # He: a ReLU halves the square
    out.square().sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in layer.parameters())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.isfinite(layer(torch.randn(1, 60, 64))).all()


def test_wrong_shapes_and_names():
    with pytest.raises(ValueError, match=r"\(B, 12, 3\), got \(2, 20, 3\)"):
        ViewsToGroup(3, 4)(torch.ones(2, 20, 3))
    with pytest.raises(ValueError, match="camera set 'cube'"):
        ViewsToGroup(3, 4, camera_set="cube")
    with pytest.raises(ValueError, match="support='all'"):
        GroupConv(3, 4, support="all")


def test_names_say_what_they_compute():
    assert "g·h" in repr(GroupConv(3, 4))
    assert "V12 -> R^3" in repr(ViewsToGroup(3, 4))
