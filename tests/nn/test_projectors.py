"""The projector: where it samples, and what it commutes with."""

import math

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.nn.projectors import (
    GroupElementProjector,
    IcosahedralProjector,
    PooledProjector,
    full_group_projector,
    sampling_positions,
    sampling_weights,
    unconstrained_projector,
)
from i2i.testing import gaussian_sampler


def sampler(map_size, sigma, **options):
    return IcosahedralProjector(1, 1, map_size=map_size, sigma=sigma, **options).double()


@pytest.mark.parametrize("sigma", [0.01, 0.2, 3.0])
def test_weights_sum_to_one(sigma):
    sampling = sampler(8, sigma).sampling
    assert sampling.shape == (16, 64)
    torch.testing.assert_close(sampling.sum(dim=1), torch.ones(16).double(), atol=1e-6, rtol=0)


def test_centre_vertex_averages_the_four_middle_cells():
    centre = sampler(8, 0.2).sampling[0].view(8, 8)
    expected = torch.zeros(8, 8).double()
    expected[3:5, 3:5] = 0.25
    torch.testing.assert_close(centre, expected, atol=1e-6, rtol=0)


def test_axes():
    """A vertex to the right is sampled to the right, one above is sampled above."""
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    raster = sampling_positions(points, 10, coverage=0.8)
    assert raster.tolist() == [[5.0, 5.0], [5.0, 9.0], [1.0, 5.0]]
    published = sampling_positions(points, 10, coverage=0.8, projector_axes="published")
    assert published.tolist() == [[5.0, 5.0], [9.0, 5.0], [5.0, 9.0]]
    # A quarter turn apart: no mirror image.
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    torch.testing.assert_close((raster - 5) @ turn.T @ turn.T @ turn.T, published - 5)


@pytest.mark.parametrize("normalize", [False, True])
def test_agrees_with_the_written_out_sampler(normalize):
    mesh = icosahedron(1, normalize_midpoints=normalize)
    maps = torch.randn(3, 5, 8, 8, dtype=torch.float64)
    ours = sampler(8, 0.35, coverage=0.8, normalize_midpoints=normalize).sample(maps)
    expected = gaussian_sampler(mesh, map_size=8, sigma=0.35, coverage=0.8)(maps)
    torch.testing.assert_close(ours, expected, atol=1e-6, rtol=1e-6)


def test_sigma_units():
    assert sampler(8, 0.2, sigma_unit="halfwidth").sigma_cells == pytest.approx(0.8)
    torch.testing.assert_close(
        sampler(10, 0.2, sigma_unit="halfwidth").sampling, sampler(10, 1.0).sampling
    )


def test_sampling_commutes_with_the_linear_map():
    torch.manual_seed(0)
    projector = IcosahedralProjector(6, 20, map_size=8)
    features = torch.randn(3, 6, 8, 8)
    mapped = torch.einsum("oc,bcij->boij", projector.linear.weight, features)
    mapped = mapped + projector.linear.bias[:, None, None]
    direct = torch.einsum("boij,vij->bvo", mapped, projector.sampling.view(16, 8, 8)).relu()
    torch.testing.assert_close(projector(features), direct, atol=1e-5, rtol=1e-5)
    assert (projector(features) >= 0).all()
    projector.linear.relu = False
    assert (projector(features) < 0).any()


def smooth_maps(map_size, angle):
    """Random smooth functions on the map, turned counter-clockwise by `angle`: (64, S, S)."""
    generator = torch.Generator().manual_seed(0)
    frequency = 3.0 * torch.randn(64, 2, generator=generator, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(64, generator=generator, dtype=torch.float64)
    centre = (torch.arange(map_size, dtype=torch.float64) + 0.5 - map_size / 2) / (0.45 * map_size)
    b, a = torch.meshgrid(-centre, centre, indexing="ij")
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = cosine * a + sine * b, -sine * a + cosine * b  # turned back
    wave = frequency[:, 0, None, None] * x + frequency[:, 1, None, None] * y
    return torch.cos(wave + phase[:, None, None])


def in_plane_error(map_size, sigma):
    """Relative error of the permutation under a turn by 72°."""
    permutation = icosahedron(1).visible_permutation[1]  # vertex i goes to permutation[i]
    sample = sampler(map_size, sigma).sample
    before = sample(smooth_maps(map_size, 0.0)[None])[0]
    after = sample(smooth_maps(map_size, 2 * math.pi / 5)[None])[0]
    return ((after[permutation] - before).norm() / before.norm()).item()


def test_turn_by_72_degrees_permutes_the_samples():
    assert in_plane_error(33, 0.2 * 33 / 8) < 0.01
    assert in_plane_error(65, 0.2 * 65 / 8) < 0.003


def test_in_plane_error_at_the_working_size_falls_with_sigma():
    errors = [in_plane_error(8, sigma) for sigma in (0.2, 0.35, 0.5, 0.8)]
    assert errors == sorted(errors, reverse=True)
    for error, expected in zip(errors, (0.40, 0.19, 0.08, 0.03), strict=True):
        assert expected / 2.5 < error < expected * 2.5


@pytest.mark.parametrize(
    ("level", "axis", "visible"),
    [(0, "vertex", 6), (1, "vertex", 16), (0, "twofold", 4), (1, "twofold", 17)],
)
def test_levels(level, axis, visible):
    projector = IcosahedralProjector(2, 3, map_size=8, mesh_level=level, mesh_axis=axis)
    assert projector.num_vertices == visible


@pytest.mark.parametrize("map_size", [8, 9])
@pytest.mark.parametrize("level", [0, 1])
def test_half_turn_of_the_map_permutes_the_samples_of_the_twofold_mesh(level, map_size):
    """Exactly, on any map and with any sigma; with a vertex to the viewer nothing is permuted."""
    mesh = icosahedron(level, mesh_axis="twofold")
    maps = torch.randn(2, 5, map_size, map_size, dtype=torch.float64)
    turned = torch.rot90(maps, 2, (-2, -1))
    sample = sampler(map_size, 0.35, mesh_level=level, mesh_axis="twofold").sample
    permutation = mesh.visible_permutation[1]  # vertex i goes to permutation[i]
    torch.testing.assert_close(sample(turned)[:, permutation], sample(maps), atol=1e-6, rtol=0)
    assert not torch.allclose(sample(turned), sample(maps), atol=0.1)
    other = sampler(map_size, 0.35, mesh_level=level).sample
    before, after = other(maps)[0], other(turned)[0]
    nearest = (before[:, None] - after).norm(dim=-1).min(dim=1).values
    assert (nearest > 0.1).sum() >= level * 10 + 5


@pytest.mark.parametrize("axis", ["vertex", "twofold"])
def test_elements_are_sampled_where_they_take_the_mark(axis):
    mesh = icosahedron(mesh_axis=axis)
    projector = GroupElementProjector(
        1, 1, map_size=64, sigma=0.5, coverage=0.8, mesh_axis=axis
    ).double()
    x, y = torch.meshgrid(
        (torch.arange(64) + 0.5 - 32) / 25.6, (32 - torch.arange(64) - 0.5) / 25.6, indexing="xy"
    )
    maps = torch.stack([x, y])[None].double()  # each cell shows where it is
    mark = (2 * mesh.vertices[0] + mesh.vertices[1]) / 3
    expected = [mesh.rotations[g] @ mark for g in mesh.elements_within(72)]
    assert projector.num_vertices == len(expected) == 13
    torch.testing.assert_close(
        projector.sample(maps)[0], torch.stack(expected)[:, :2], atol=2e-3, rtol=0
    )


def test_pooling():
    maps = torch.randn(3, 4, 8, 8)
    average = PooledProjector(4, 10, map_size=8)
    cells = PooledProjector(4, 10, map_size=8, pooling="cells")
    cells.linear.load_state_dict(average.linear.state_dict())
    expected = torch.relu(average.linear(maps.mean(dim=(2, 3))))[:, None]
    torch.testing.assert_close(average(maps), expected)
    torch.testing.assert_close(cells(maps), expected)  # at the start
    torch.testing.assert_close(average(torch.rot90(maps, 1, (2, 3))), expected)
    torch.nn.init.normal_(cells.weight)
    direct = torch.einsum("bcij,cij->bc", maps, cells.weight.view(4, 8, 8))
    torch.testing.assert_close(
        cells(maps), torch.relu(cells.linear(direct))[:, None], atol=1e-5, rtol=1e-5
    )
    assert not torch.allclose(cells(torch.rot90(maps, 1, (2, 3))), cells(maps), atol=1e-2)


def test_pooling_without_a_linear_map_is_the_average_itself():
    maps = torch.randn(3, 4, 8, 8)
    projector = PooledProjector(4, 4, map_size=8, linear=False)
    assert not list(projector.parameters())
    torch.testing.assert_close(projector(maps)[:, 0], maps.mean(dim=(2, 3)))
    with pytest.raises(ValueError, match="reading=pooled"):
        PooledProjector(4, 5, map_size=8, linear=False)


def test_the_choice_of_the_variant_chooses_the_projector():
    def kind(factory, out_channels=10, **options):
        return type(factory(4, out_channels, map_size=8, **options))

    assert kind(full_group_projector, support="identity", sigma=0.3) is PooledProjector
    assert kind(full_group_projector, support="local13", sigma=0.3) is GroupElementProjector
    assert kind(unconstrained_projector, sigma=0.3) is IcosahedralProjector
    assert kind(unconstrained_projector, 4, reading="pooled", sigma=0.3) is PooledProjector
    with pytest.raises(ValueError, match="sampled, pooled"):
        kind(unconstrained_projector, reading="flat")
    with pytest.raises(ValueError, match="identity, local13"):
        kind(full_group_projector, support="all")
    with pytest.raises(ValueError, match="average, cells"):
        kind(full_group_projector, pooling="max")


def test_state_dict_is_the_parameters():
    assert set(IcosahedralProjector(2, 3, map_size=8).state_dict()) == {
        "linear.weight",
        "linear.bias",
    }


@pytest.mark.parametrize(
    "options",
    [{"sigma_unit": "pixel"}, {"projector_axes": "image"}, {"sigma": 0.0}, {"coverage": -1.0}],
)
def test_errors(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        IcosahedralProjector(2, 3, map_size=8, **options)


def test_wrong_map_is_refused():
    with pytest.raises(ValueError, match="8×8"):
        IcosahedralProjector(2, 3, map_size=8)(torch.zeros(1, 2, 9, 9))
    with pytest.raises(ValueError, match="8×8"):
        PooledProjector(2, 3, map_size=8)(torch.zeros(1, 2, 9, 9))


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.8])
def test_narrow_gaussians_leave_no_denormal_weights(sigma):
    points = icosahedron(1).visible_xy
    positions = sampling_positions(points, 8, coverage=0.9, projector_axes="raster")
    weights = sampling_weights(positions, 8, sigma)
    single = weights.float()
    assert not ((single > 0) & (single < torch.finfo(torch.float32).tiny)).any()
    assert (single >= 0).all()
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(16).double(), rtol=0, atol=1e-12)


def test_weights_are_a_gaussian():
    weights = sampling_weights(torch.tensor([[1.0, 2.5]]), 4, 0.7).view(4, 4)
    row, column = 2, 1
    distance = (row + 0.5 - 1.0) ** 2 + (column + 0.5 - 2.5) ** 2
    nearest = (0.5 + 0.5 - 1.0 - 0.5) ** 2
    ratio = weights[row, column] / weights[0, 2]
    assert ratio.item() == pytest.approx(math.exp(-(distance - nearest) / (2 * 0.49)))
