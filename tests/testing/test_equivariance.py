"""The assertions pass what is equivariant and fail what is not; the sums obey the group."""

import pytest
import torch
from torch import nn

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.rotations import axis_rotation
from i2i.testing import (
    assert_c4_equivariant,
    assert_equivariant,
    assert_icosahedral_equivariant,
    turn_map,
    turn_regular_map,
)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def brute_force_correlation(f, psi, vertices, mesh):
    """out(g) = Σ_v f(R_g v)·ψ(v), with R_g v looked up by its coordinates, not in a table."""
    out = torch.zeros(60, psi.shape[-1], dtype=torch.float64)
    for g, rotation in enumerate(mesh.rotations):
        for i, v in enumerate(vertices.tolist()):
            moved = rotation @ mesh.vertices[v]
            target = int((mesh.vertices - moved).norm(dim=-1).argmin())
            out[g] += f[target] @ psi[i]
    return out


# --- The icosahedral sum itself -----------------------------------------------------------------


@pytest.mark.parametrize("level", [0, 1])
def test_feature_side_symmetry_holds_for_the_half_mesh(level):
    mesh = icosahedron(level)
    psi = randn(len(mesh.visible), 4, 2, seed=1)
    report = assert_icosahedral_equivariant(
        lambda f: brute_force_correlation(f, psi, mesh.visible, mesh),
        randn(len(mesh.vertices), 4),
        mesh=mesh,
        elements=range(60) if level == 0 else (1, 7, 23, 59),
    )
    assert report.max_error < 1e-12


def test_tables_compute_what_brute_force_does():
    mesh = icosahedron(1)
    f, psi = randn(42, 4), randn(16, 4, 2, seed=1)
    gathered = torch.einsum("gvn,vnm->gm", f[mesh.action[:, mesh.visible]], psi)
    torch.testing.assert_close(gathered, brute_force_correlation(f, psi, mesh.visible, mesh))


def test_feature_side_symmetry_of_the_gathered_sum_for_all_elements():
    mesh = icosahedron(1)
    psi = randn(16, 4, 2, seed=1)
    report = assert_icosahedral_equivariant(
        lambda f: torch.einsum("gvn,vnm->gm", f[mesh.action[:, mesh.visible]], psi), randn(42, 4)
    )
    assert len(report.errors) == 60


def full_filter(psi):
    return torch.einsum("gvn,vnm->gm", randn(42, 4)[icosahedron(1).action], psi.transpose(-2, -1))


def test_filter_side_symmetry_holds_for_a_filter_on_all_vertices():
    report = assert_icosahedral_equivariant(
        full_filter, randn(42, 2, 4, seed=1), side="filter", vertex_dim=0
    )
    assert report.max_error < 1e-12


def test_filter_side_symmetry_of_the_half_mesh_holds_for_five_elements_only():
    mesh = icosahedron(1)
    mask = torch.zeros(42, 1, 1, dtype=torch.float64)
    mask[mesh.visible] = 1
    report = assert_icosahedral_equivariant(
        lambda psi: full_filter(psi * mask),
        randn(42, 2, 4, seed=1),
        side="filter",
        vertex_dim=0,
        raise_error=False,
    )
    exact = [h for h, error in zip(report.elements, report.errors, strict=True) if error < 1e-12]
    assert exact == [0, 1, 2, 3, 4]
    assert not report.passed


def test_a_layer_that_mixes_up_its_table_fails():
    mesh = icosahedron(1)
    psi = randn(16, 4, 2, seed=1)
    wrong = mesh.action[mesh.inverse][:, mesh.visible]  # f(R_g⁻¹ v)
    with pytest.raises(AssertionError, match="largest relative error"):
        assert_icosahedral_equivariant(
            lambda f: torch.einsum("gvn,vnm->gm", f[wrong], psi), randn(42, 4)
        )


def test_mean_over_the_group_sees_orbit_means_only():
    """Average pooling sees the feature sphere only by its mean on each of two orbits."""
    mesh = icosahedron(1)
    f, psi = randn(42, 4), randn(42, 4, 3, seed=1)
    out = torch.einsum("gvn,vnm->gm", f[mesh.action], psi)
    corners, middles = slice(0, 12), slice(12, 42)
    expected = sum(f[part].mean(0) @ psi[part].sum(0) for part in (corners, middles))
    torch.testing.assert_close(out.mean(0), expected)


# --- Quarter turns ------------------------------------------------------------------------------


def test_pixelwise_layers_turn_with_the_image():
    layer = nn.Sequential(nn.Conv2d(3, 5, 1), nn.BatchNorm2d(5), nn.ReLU())
    assert assert_c4_equivariant(layer, randn(2, 3, 6, 6)).passed


def test_an_ordinary_convolution_fails():
    layer = nn.Conv2d(3, 5, 3, padding=1)
    with pytest.raises(AssertionError, match="Conv2d under C4"):
        assert_c4_equivariant(layer, randn(2, 3, 6, 6))
    report = assert_c4_equivariant(layer, randn(2, 3, 6, 6), raise_error=False)
    assert report.errors[0] == 0
    assert min(report.errors[1:]) > 0.1


def symmetric_convolution(stride):
    conv = nn.Conv2d(1, 1, 3, padding=1, stride=stride, bias=False)
    with torch.no_grad():
        conv.weight.copy_(torch.tensor([[[[1.0, 2, 1], [2, 3, 2], [1, 2, 1]]]]))
    return conv


@pytest.mark.parametrize(("size", "passes"), [(9, True), (8, False)])
def test_stride_two_is_exact_on_odd_sizes_only(size, passes):
    report = assert_c4_equivariant(
        symmetric_convolution(2), randn(1, 1, size, size), raise_error=False
    )
    assert report.passed is passes
    assert report.max_error < 1e-12 or report.max_error > 0.1


def lift(x, weight):
    """Lifting convolution by hand: channel s of a field has the kernel turned by s quarters."""
    kernels = torch.stack([torch.rot90(weight, s, (-2, -1)) for s in range(4)], dim=1)
    return nn.functional.conv2d(x, kernels.flatten(0, 1), padding=1)


def test_regular_fields_turn_and_shift():
    weight = randn(3, 2, 3, 3, seed=1)  # 3 fields, 2 input channels
    x = randn(1, 2, 7, 7)
    assert assert_c4_equivariant(lambda x: lift(x, weight), x, output="regular").passed
    assert not assert_c4_equivariant(
        lambda x: lift(x, weight), x, output="map", raise_error=False
    ).passed
    pooled = assert_c4_equivariant(lambda x: lift(x, weight).unflatten(1, (3, 4)).amax(2), x)
    assert pooled.passed


def test_regular_input_fields():
    x = randn(1, 8, 5, 5)
    mean = assert_c4_equivariant(
        lambda x: x.unflatten(1, (2, 4)).mean(2), x, input_fields="regular"
    )
    assert mean.passed
    assert not assert_c4_equivariant(
        lambda x: x[:, ::4], x, input_fields="regular", raise_error=False
    ).passed


def moment_rotation(x):
    """Rotation whose in-plane angle is that of the image's centre of mass: x right, y up."""
    size = x.shape[-1]
    offset = torch.arange(size, dtype=x.dtype) + 0.5 - size / 2
    angle = torch.atan2((x * -offset[:, None]).sum((-3, -2, -1)), (x * offset).sum((-3, -2, -1)))
    return axis_rotation("z", torch.rad2deg(angle)) @ axis_rotation("x", 30.0).to(x)


def test_pose_output_turns_with_the_image():
    """rot90 of the picture is Rz(90°) from the left on our rasters."""
    report = assert_c4_equivariant(moment_rotation, randn(4, 1, 8, 8).abs(), output="rotation")
    assert report.passed
    backwards = assert_c4_equivariant(
        lambda x: moment_rotation(x).mT,
        randn(4, 1, 8, 8).abs(),
        output="rotation",
        raise_error=False,
    )
    assert not backwards.passed


def test_invariant_outputs_and_own_actions():
    x = randn(2, 1, 6, 6)
    assert assert_c4_equivariant(lambda x: x.mean((-2, -1)), x, output="invariant").passed
    assert assert_c4_equivariant(lambda x: -x, x, output=lambda k, out: turn_map(k, out)).passed


def test_turns_of_maps_are_group_actions():
    x = randn(2, 8, 5, 5)
    for turn in (turn_map, turn_regular_map):
        assert torch.equal(turn(4, x), x)
        assert torch.equal(turn(1, turn(2, x)), turn(3, x))


# --- The helper's own behaviour -----------------------------------------------------------------


def options(**changes):
    return {
        "input_action": lambda g, x: x.roll(g, -1),
        "output_action": lambda g, x: x.roll(g, -1),
        "elements": range(4),
        **changes,
    }


def test_module_is_left_as_it_was():
    layer = nn.Sequential(nn.BatchNorm1d(3), nn.Dropout())
    before = {k: v.clone() for k, v in layer.state_dict().items()}
    assert_equivariant(layer, torch.randn(2, 3, 8), **options())
    assert layer.training
    assert layer[0].weight.dtype == torch.float32
    assert all(torch.equal(v, before[k]) for k, v in layer.state_dict().items())


def test_float32_has_its_own_tolerance():
    report = assert_equivariant(lambda x: x.cumsum(0), randn(50, 8), **options(dtype=torch.float32))
    assert report.tolerance == 1e-4


def test_nan_is_not_passed():
    report = assert_equivariant(lambda x: x.sqrt(), randn(3, 8), **options(raise_error=False))
    assert not report.passed


def test_what_proves_nothing_is_refused():
    with pytest.raises(ValueError, match="proves nothing"):
        assert_equivariant(lambda x: 0 * x, randn(3, 8), **options())
    with pytest.raises(ValueError, match="no group elements"):
        assert_equivariant(lambda x: x, randn(3, 8), **options(elements=()))
    with pytest.raises(ValueError, match="square"):
        assert_c4_equivariant(lambda x: x, randn(1, 1, 4, 5))
    with pytest.raises(ValueError, match="map, regular, invariant, rotation"):
        assert_c4_equivariant(lambda x: x, randn(1, 1, 4, 4), output="pose")
    with pytest.raises(ValueError, match="feature, filter"):
        assert_icosahedral_equivariant(lambda x: x, randn(42, 3), side="both")


def test_failure_names_the_worst_element_and_hides_its_frames():
    with pytest.raises(
        AssertionError, match=r"mine: .* at element .*, 3 of 4 elements fail"
    ) as info:
        assert_equivariant(lambda x: x * torch.arange(8), randn(3, 8), **options(name="mine"))
    shown = [entry for entry in info.traceback if not entry.ishidden(info)]
    assert all(
        "equivariance.py" not in str(entry.path) or "test_" in str(entry.path) for entry in shown
    )
