"""Densities on SO(3) against integrals over uniform rotations, and their samples."""

import math

import pytest
import torch

from i2i.geometry.densities import (
    HAAR_VOLUME,
    cosine_defect,
    isotropic_log_density,
    isotropic_samples,
)
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations


def test_defect_is_one_minus_the_cosine():
    a = random_rotations(500, torch.Generator().manual_seed(0), dtype=torch.float64)
    b = random_rotations(500, torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(cosine_defect(a, b), 1 - torch.cos(geodesic_angle_rad(a, b)))


@pytest.mark.parametrize("kappa", [0.0, 0.5, 3.0])
def test_density_integrates_to_one(kappa):
    uniform = random_rotations(200_000, torch.Generator().manual_seed(2), dtype=torch.float64)
    density = isotropic_log_density(cosine_defect(uniform, torch.eye(3).double()), kappa).exp()
    assert density.mean().item() * HAAR_VOLUME == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("kappa", [20.0, 1e3, 1e5])
def test_narrow_densities_integrate_to_one_over_the_angle(kappa):
    angle = torch.linspace(0, min(math.pi, 15 / math.sqrt(kappa)), 200_001, dtype=torch.float64)
    density = isotropic_log_density(2 * torch.sin(angle / 2).square(), kappa).exp()
    # Haar: a shell of angle θ has the volume π² (1 − cos θ)/π dθ.
    volume = HAAR_VOLUME * 2 * torch.sin(angle / 2).square() / math.pi
    assert torch.trapezoid(density * volume, angle).item() == pytest.approx(1.0, abs=1e-4)


def test_uniform_is_one_over_the_volume():
    assert isotropic_log_density(torch.tensor(0.7), 0.0).item() == pytest.approx(-2.2894, abs=1e-3)


@pytest.mark.parametrize("kappa", [0.0, 2.0, 100.0, 1e4])
def test_samples_have_the_distribution_of_the_angle(kappa):
    drawn = isotropic_samples(kappa, (4000,), torch.Generator().manual_seed(3))
    torch.testing.assert_close(drawn @ drawn.mT, torch.eye(3).double().expand(4000, 3, 3))
    angle = geodesic_angle_rad(drawn, torch.eye(3).double()).sort().values
    grid = torch.linspace(0, min(math.pi, 15 / math.sqrt(max(kappa, 1e-9))), 100_001).double()
    weight = torch.exp(kappa * (grid.cos() - 1)) * (1 - grid.cos())
    cumulative = torch.cumulative_trapezoid(weight, grid)
    expected = cumulative[torch.searchsorted(grid[1:], angle).clamp(max=99_999)] / cumulative[-1]
    empirical = (torch.arange(4000).double() + 0.5) / 4000
    assert (expected - empirical).abs().max() < 1.63 / math.sqrt(4000)  # Kolmogorov, 1 %
    # No direction is preferred.
    mean = drawn.mean(dim=0)
    assert (mean - torch.diag(mean.diagonal())).abs().max() < 0.05
