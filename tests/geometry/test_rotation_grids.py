"""HEALPix and rotation grids: numbers, equal shares, symmetry, covering, nearest cells."""

import math

import pytest
import torch

from i2i.geometry.rotation_grids import (
    healpix_angles,
    healpix_points,
    nearest_cell,
    rotation_grid,
)
from i2i.geometry.rotations import axis_rotation, geodesic_angle_rad, random_rotations


def pixel_angles(nside, pixel):
    """Centre of one pixel by the published formulas with square roots (ring order)."""
    total, cap = 12 * nside**2, 2 * nside * (nside - 1)
    if pixel < cap:
        half = (pixel + 1) / 2
        ring = int(math.sqrt(half - math.sqrt(int(half)))) + 1
        place = pixel + 1 - 2 * ring * (ring - 1)
        return 1 - ring**2 / (3 * nside**2), math.pi / (2 * ring) * (place - 0.5)
    if pixel < total - cap:
        offset = pixel - cap
        ring, place = offset // (4 * nside) + nside, offset % (4 * nside) + 1
        shift = (ring - nside + 1) % 2
        cosine = 4 / 3 - 2 * ring / (3 * nside)
        return cosine, math.pi / (2 * nside) * (place - 1 + (shift / 2))
    half = (total - pixel) / 2
    ring = int(math.sqrt(half - math.sqrt(int(half)))) + 1
    place = 4 * ring - (total - pixel - 2 * ring * (ring - 1)) + 1
    return -1 + ring**2 / (3 * nside**2), math.pi / (2 * ring) * (place - 0.5)


@pytest.mark.parametrize("nside", [1, 2, 4, 5])
def test_pixels_are_those_of_the_published_formulas(nside):
    polar, azimuth = healpix_angles(nside)
    assert len(polar) == 12 * nside**2
    expected = torch.tensor(
        [pixel_angles(nside, pixel) for pixel in range(12 * nside**2)], dtype=torch.float64
    )
    torch.testing.assert_close(polar.cos(), expected[:, 0], atol=1e-12, rtol=0)
    torch.testing.assert_close(azimuth, expected[:, 1], atol=1e-12, rtol=0)


def test_nside_must_be_positive():
    with pytest.raises(ValueError, match="positive integer"):
        healpix_angles(0)


@pytest.mark.parametrize("nside", [2, 4])
def test_points_are_equal_shares_of_the_sphere(nside):
    """The means are those of S², and random points fall into all cells alike."""
    points = healpix_points(nside)
    torch.testing.assert_close(points.norm(dim=1), torch.ones(len(points)).double())
    assert points.mean(dim=0).abs().max() < 1e-12
    second = points.T @ points / len(points)
    torch.testing.assert_close(second, torch.eye(3).double() / 3, atol=0.04 / nside**2, rtol=0)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(100_000, 3, generator=generator, dtype=torch.float64)
    count = torch.bincount((drawn @ points.T).argmax(dim=1), minlength=len(points)).double()
    # Cells of nearest points are not quite the pixels, whose areas are equal exactly.
    assert (count / count.mean() - 1).abs().max() < 0.15


def test_points_are_closed_under_quarter_turns_and_half_turns_over():
    points = healpix_points(4)
    for turn in (axis_rotation("z", 90), axis_rotation("x", 180)):
        distance = torch.cdist(points @ turn.T, points)
        assert distance.min(dim=1).values.max() < 1e-7


@pytest.mark.parametrize(("level", "count"), [(0, 72), (1, 576), (2, 4608), (3, 36_864)])
def test_numbers_and_rotations(level, count):
    grid = rotation_grid(level)
    assert len(grid) == count
    assert rotation_grid(level) is grid
    torch.testing.assert_close(
        grid.rotations @ grid.rotations.mT, torch.eye(3).double().expand(count, 3, 3)
    )
    torch.testing.assert_close(torch.linalg.det(grid.rotations), torch.ones(count).double())
    assert str(count) in repr(grid)


@pytest.mark.parametrize("level", [-1, 6, 2.5])
def test_unknown_levels(level):
    with pytest.raises(ValueError, match="0 to 5"):
        rotation_grid(level)


# Means and largest angles over 20,000 random rotations (level 3: 4,000) were 28.4, 14.2, 7.0, 3.5
# and 49.5, 26.3, 13.4, 5.9: each level halves them.
@pytest.mark.parametrize(
    ("level", "mean_deg", "largest_deg"), [(0, 28.4, 51), (1, 14.2, 28), (2, 7.0, 14), (3, 3.5, 7)]
)
def test_covering(level, mean_deg, largest_deg):
    target = random_rotations(600, torch.Generator().manual_seed(level))
    grid = rotation_grid(level).rotations
    angle = torch.rad2deg(geodesic_angle_rad(target, grid[nearest_cell(target, grid)]))
    assert angle.mean() == pytest.approx(mean_deg, rel=0.04)
    assert angle.max() < largest_deg
    assert angle.max() > largest_deg / 2


def test_equal_volume_by_counts():
    """Nearest cells of random rotations spread like draws from equal boxes (Poisson)."""
    grid = rotation_grid(1)
    target = random_rotations(50_000, torch.Generator().manual_seed(0)).float()
    count = torch.bincount(nearest_cell(target, grid.rotations), minlength=576).double()
    assert count.min() > 0
    poisson = 1 / count.mean().sqrt()  # relative spread of 87 draws a cell: 10.7 %
    assert count.std() / count.mean() < 1.15 * poisson
    # An Euler grid of as many rotations crowds the poles: the control.
    polar = torch.linspace(0, 180, 7, dtype=torch.float64)[:-1] + 15
    turns = torch.arange(12, dtype=torch.float64) * 30
    euler = (
        axis_rotation("z", turns[:8] * 1.5)[:, None, None]
        @ axis_rotation("y", polar)[None, :, None]
        @ axis_rotation("z", turns)[None, None]
    ).flatten(0, 2)
    count = torch.bincount(nearest_cell(target, euler), minlength=576).double()
    assert count.std() / count.mean() > 2 * poisson


def test_rotations_are_closed_under_quarter_turns_on_both_sides():
    grid = rotation_grid(1).rotations
    quarter = axis_rotation("z", 90)
    for turned in (grid @ quarter, quarter @ grid):
        cell = nearest_cell(turned, grid)
        assert len(set(cell.tolist())) == len(grid)
        torch.testing.assert_close(grid[cell], turned, atol=1e-12, rtol=0)


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_nearest_cell_is_the_smallest_angle(chunk):
    target = random_rotations(40, torch.Generator().manual_seed(3))
    grid = rotation_grid(1).rotations
    expected = geodesic_angle_rad(target[:, None], grid[None]).argmin(dim=1)
    assert torch.equal(nearest_cell(target, grid, chunk=chunk), expected)
    assert torch.equal(nearest_cell(target.float(), grid, chunk=chunk), expected)
    assert torch.equal(nearest_cell(grid, grid, chunk=chunk), torch.arange(len(grid)))


def test_nearest_cell_wants_matrices():
    with pytest.raises(ValueError, match="target wants shape"):
        nearest_cell(torch.eye(3), rotation_grid(0).rotations)
