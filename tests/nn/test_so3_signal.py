"""Hemisphere, correlation, values on the grid, and climbing to a maximum."""

import pytest
import torch

from i2i.geometry.rotation_grids import healpix_points, nearest_cell, rotation_grid
from i2i.geometry.rotations import axis_rotation, geodesic_angle_rad, random_rotations
from i2i.nn.so3_signal import (
    HemisphereProjector,
    RotationGridValues,
    SO3Convolution,
    SphereCorrelation,
    climb,
    taper_weights,
    values_at,
)
from i2i.nn.spherical import num_wigner, spherical_harmonics, wigner_basis, wigner_blocks
from i2i.testing.oracle import paint_maps, random_field


def turned(signal, rotation, lmax):
    """Harmonics (B, M, k) of ψ(Qᵀ u) from those of ψ(u)."""
    return torch.block_diag(*wigner_blocks(rotation, lmax)) @ signal


def degrees(a, b):
    return torch.rad2deg(geodesic_angle_rad(a, b))


def test_sampling_points_and_taper():
    projector = HemisphereProjector(4, 10, map_size=8)
    assert projector.num_points == 88
    assert projector(torch.rand(2, 4, 8, 8)).shape == (2, 49, 10)
    tilt = axis_rotation("y", torch.tensor([0.0, 40, 75, 82.5, 90, 100]).double())[:, :, 2]
    expected = torch.tensor([1, 1, 1, 0.5, 0, 0]).double()
    torch.testing.assert_close(taper_weights(tilt, 75.0), expected, atol=1e-9, rtol=0)
    # A map that is constant gives the same value at all points, since the weights sum to 1.
    sampled = projector.sample(torch.full((1, 4, 8, 8), 3.0))
    torch.testing.assert_close(sampled, torch.full((1, 88, 4), 3.0))


def test_harmonics_of_the_hemisphere_are_the_written_out_sum():
    torch.manual_seed(0)
    projector = HemisphereProjector(3, 5, map_size=8, lmax=2)
    features = torch.rand(2, 3, 8, 8)
    points = healpix_points(4)
    points = points[points[:, 2] > 1e-9]
    psi = torch.relu(projector.linear(projector.sample(features))).double()
    expected = 0
    for v in range(88):
        weight = taper_weights(points[v : v + 1], 75.0) / 88**0.5
        harmonics = spherical_harmonics(points[v], 2)
        expected = expected + weight * harmonics[None, :, None] * psi[:, v, None, :]
    torch.testing.assert_close(projector(features).double(), expected, atol=1e-5, rtol=1e-5)


def test_projector_turns_with_the_picture():
    """A quarter turn of the map is a quarter turn of the sphere about the viewing axis."""
    torch.manual_seed(0)
    projector = HemisphereProjector(3, 5, map_size=8, lmax=4)
    features = torch.rand(2, 3, 8, 8)
    quarter = axis_rotation("z", 90).float()
    expected = turned(projector(features), quarter, 4)
    actual = projector(torch.rot90(features, 1, (2, 3)))
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)
    assert (actual - turned(projector(features), quarter.T, 4)).abs().max() > 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma_unit": "pixel"}, "cell, halfwidth"),
        ({"sigma": 0.0}, "positive"),
        ({"taper_deg": 90.0}, "below 90"),
        ({"lmax": 12}, "0 to 11"),
        ({"nside": 0}, "positive integer"),
    ],
)
def test_unknown_choices_of_the_projector(options, message):
    with pytest.raises(ValueError, match=message):
        HemisphereProjector(3, 5, map_size=8, **options)


def test_projector_wants_its_map():
    with pytest.raises(ValueError, match="8×8"):
        HemisphereProjector(3, 5, map_size=8)(torch.zeros(1, 3, 9, 9))


@pytest.mark.parametrize("lmax", [1, 4])
def test_correlation_is_the_integral(lmax):
    """Σ_k ∫ f_k(T u) ψ_k(u) du by an equal-area sum over many points of the sphere."""
    torch.manual_seed(0)
    layer = SphereCorrelation(3, lmax=lmax).double()
    signal = torch.randn(2, (lmax + 1) ** 2, 3, dtype=torch.float64)
    rotations = random_rotations(6)
    points = healpix_points(64)
    scale = torch.cat(
        [torch.full((2 * d + 1,), (2 * d + 1) ** 0.5).double() for d in range(lmax + 1)]
    )
    with torch.no_grad():
        filters = layer.filter[0, 0] * scale[:, None]
        psi = torch.einsum("pm,bmk->bpk", spherical_harmonics(points, lmax), signal)
        moved = spherical_harmonics(points @ rotations.mT, lmax) @ filters  # f(T u), (R, p, k)
        expected = torch.einsum("rpk,bpk->br", moved, psi) * 4 * torch.pi / len(points)
        actual = values_at(layer(signal)[:, 0], rotations.expand(2, -1, -1, -1), lmax)
    torch.testing.assert_close(actual, expected, atol=2e-3, rtol=0)


@pytest.mark.parametrize("lmax", [4, 6])
def test_equivariance(lmax):
    """The output for a signal turned by Q, at R, is that for the signal itself at R Q."""
    torch.manual_seed(0)
    layer = SphereCorrelation(8, lmax=lmax).double()
    signal = torch.randn(3, (lmax + 1) ** 2, 8, dtype=torch.float64)
    rotations = random_rotations(30).expand(3, -1, -1, -1)
    for q in random_rotations(4):
        with torch.no_grad():
            coefficients, moved = layer(signal)[:, 0], layer(turned(signal, q, lmax))[:, 0]
        found = values_at(moved, rotations, lmax)
        torch.testing.assert_close(
            found, values_at(coefficients, rotations @ q, lmax), atol=1e-10, rtol=0
        )
        for wrong in (rotations @ q.T, q @ rotations, q.T @ rotations, rotations):
            assert (found - values_at(coefficients, wrong, lmax)).abs().max() > 0.1 * found.std()


def test_filters_by_index():
    torch.manual_seed(0)
    layer = SphereCorrelation(4, 2, lmax=2, num_filters=3)
    signal = torch.randn(5, 9, 4)
    index = torch.tensor([0, 2, 1, 1, 0])
    together = layer(signal, index)
    assert together.shape == (5, 2, 35)
    for i, chosen in enumerate(index):
        single = SphereCorrelation(4, 2, lmax=2)
        single.filter.data = layer.filter.data[chosen : chosen + 1]
        torch.testing.assert_close(together[i : i + 1], single(signal[i : i + 1]))
    with pytest.raises(ValueError, match="class_id"):
        layer(signal)
    with pytest.raises(ValueError, match="expected a signal"):
        layer(signal[:, :4], index)


@pytest.mark.parametrize(("lmax", "level"), [(3, 1), (6, 2)])
def test_values_on_the_grid(lmax, level):
    coefficients = torch.randn(2, num_wigner(lmax))
    basis = wigner_basis(rotation_grid(level).rotations, lmax)
    values = RotationGridValues(lmax, level)
    expected = coefficients.double() @ basis.T
    torch.testing.assert_close(values(coefficients).double(), expected, atol=1e-4, rtol=1e-5)
    assert values.state_dict() == {}
    other = RotationGridValues(lmax, level)
    assert other.directions.data_ptr() == values.directions.data_ptr()
    projected = values.project(values(coefficients))
    torch.testing.assert_close(
        projected.double(), expected @ basis / len(basis), atol=1e-4, rtol=1e-4
    )


@pytest.mark.parametrize("lmax", [3, 6])
def test_climb_finds_the_peak_of_a_rotation(lmax):
    """The correlation with the Wigner matrices of R is largest at R, wherever R lies in a cell."""
    target = random_rotations(200, torch.Generator().manual_seed(1))
    grid = rotation_grid(1 if lmax == 3 else 2).rotations
    start = grid[nearest_cell(target, grid)]
    coefficients = wigner_basis(target, lmax)
    assert degrees(start, target).max() > 10  # what quantisation alone costs
    found = climb(coefficients.float(), start.float(), lmax)
    assert found.dtype == torch.float32
    assert degrees(found, target).max() < 0.05
    torch.testing.assert_close(found @ found.mT, torch.eye(3).expand_as(found), atol=1e-5, rtol=0)
    assert degrees(climb(coefficients, start, lmax), target).max() < 1e-4


def test_climb_of_random_functions_is_no_worse_than_a_fine_grid():
    torch.manual_seed(0)
    lmax = 4
    coefficients = torch.randn(30, num_wigner(lmax), dtype=torch.float64)
    basis = wigner_basis(rotation_grid(2).rotations, lmax)
    coarse = coefficients @ basis.T
    start = rotation_grid(2).rotations[coarse.argmax(dim=1)]
    found = climb(coefficients, start, lmax)
    value = values_at(coefficients, found, lmax)
    assert (value >= coarse.max(dim=1).values).all()
    assert (value > coarse.max(dim=1).values).any()
    # Nothing within 2° of it is higher: it is a maximum.
    vectors = torch.randn(30, 100, 3, dtype=torch.float64)
    skew = torch.linalg.cross(
        vectors[..., None, :] * 0.02, torch.eye(3).double().expand(30, 100, 3, 3)
    )
    around = torch.linalg.matrix_exp(skew) @ found[:, None]
    assert (values_at(coefficients, around, lmax) <= value[:, None] + 1e-9).all()
    # One sample's result does not depend on the others.
    torch.testing.assert_close(climb(coefficients[3:4], start[3:4], lmax), found[3:4])


def test_climb_stays_where_nothing_rises():
    start = random_rotations(3)
    flat = torch.zeros(3, num_wigner(2), dtype=torch.float64)
    torch.testing.assert_close(climb(flat, start, 2), start)
    constant = flat.clone()
    constant[:, 0] = 5.0
    torch.testing.assert_close(climb(constant, start, 2), start)
    target = wigner_basis(start, 2)
    torch.testing.assert_close(climb(target, start, 2), start, atol=1e-7, rtol=0)


def test_so3_convolution_turns():
    """Exactly for quarter turns about the viewing axis, nearly for any, never on the left."""
    torch.manual_seed(0)
    lmax = 3
    correlation = SphereCorrelation(4, 2, lmax=lmax).double()
    layer = SO3Convolution(2, lmax=lmax, level=2).double()
    signal = torch.randn(2, 16, 4, dtype=torch.float64)
    rotations = random_rotations(20).expand(2, -1, -1, -1)

    def error(q, side):
        with torch.no_grad():
            moved = layer(correlation(turned(signal, q, lmax)))[:, 0]
            plain = layer(correlation(signal))[:, 0]
        expected = values_at(plain, rotations @ q if side == "right" else q @ rotations, lmax)
        return ((values_at(moved, rotations, lmax) - expected).norm() / expected.norm()).item()

    assert error(axis_rotation("z", 90), "right") < 1e-6
    assert error(random_rotations(1)[0], "right") < 0.05
    assert error(random_rotations(1)[0], "left") > 0.3


@pytest.mark.parametrize("inverse", [False, True])
def test_oracle_finds_the_view(inverse):
    """A perfect encoder, the real sampling and a filter that is the object: the peak is `view`.

    0.6° in the median is left by the hidden half, the 8×8 map and the bound on the degree.
    """
    lmax, size = 6, 8
    generator = torch.Generator().manual_seed(0)
    field, views = random_field(64, generator=generator), random_rotations(60, generator)
    projector = HemisphereProjector(64, 64, map_size=size, lmax=lmax, sigma=0.35).double()
    maps = paint_maps(field, views, map_size=size, coverage=0.9)
    points = healpix_points(16)
    whole = spherical_harmonics(points, lmax).T @ field(points) * 4 * torch.pi / len(points)
    scale = torch.cat(
        [torch.full((2 * d + 1,), (2 * d + 1) ** -0.5).double() for d in range(lmax + 1)]
    )
    layer = SphereCorrelation(64, lmax=lmax).double()
    with torch.no_grad():
        layer.filter[0, 0] = whole * scale[:, None]
        coefficients = layer(projector.transform @ projector.sample(maps))[:, 0]
        grid = rotation_grid(2).rotations
        start = grid[RotationGridValues(lmax, 2)(coefficients).argmax(dim=1)]
        found = climb(coefficients, start, lmax)
    error = degrees(found, views.mT if inverse else views)
    if inverse:
        assert error.median() > 60
    else:
        assert error.median() < 1
        assert error.quantile(0.9) < 2
