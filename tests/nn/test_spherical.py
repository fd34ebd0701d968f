"""Harmonics and Wigner matrices against quadrature, homomorphism and turned points."""

import pytest
import torch
from e3nn import o3

from i2i.geometry.rotation_grids import healpix_points, rotation_grid
from i2i.geometry.rotations import axis_rotation, random_rotations
from i2i.nn.spherical import (
    coefficient_index,
    direction_table,
    float32_tables,
    generator_table,
    num_wigner,
    spherical_harmonics,
    turn_table,
    wigner_basis,
    wigner_blocks,
)


def random_points(n):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return points / points.norm(dim=1, keepdim=True)


def sphere_quadrature(degree):
    """Gauss-Legendre in z times equal steps in azimuth: exact for polynomials of that degree."""
    import numpy as np

    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    z, azimuth = torch.tensor(z)[:, None], torch.tensor(azimuth)[None]
    ring = (1 - z**2).sqrt()
    points = torch.stack((ring * azimuth.cos(), ring * azimuth.sin(), z.expand(-1, degree + 1)), -1)
    weights = torch.tensor(weight)[:, None].expand(-1, degree + 1) * 2 * torch.pi / (degree + 1)
    return points.flatten(0, 1), weights.flatten()


@pytest.mark.parametrize("lmax", [0, 4, 6])
def test_harmonics_are_orthonormal(lmax):
    points, weights = sphere_quadrature(2 * lmax + 1)
    harmonics = spherical_harmonics(points, lmax)
    gram = harmonics.T @ (harmonics * weights[:, None])
    torch.testing.assert_close(gram, torch.eye((lmax + 1) ** 2).double(), atol=1e-12, rtol=0)


def test_harmonics_of_degree_one_are_y_z_x():
    points = random_points(10)
    expected = (3 / (4 * torch.pi)) ** 0.5 * points[:, [1, 2, 0]]
    torch.testing.assert_close(spherical_harmonics(points, 1)[:, 1:], expected)


@pytest.mark.parametrize("lmax", [1, 4, 6])
def test_wigner_matrices_turn_the_harmonics(lmax):
    points, rotations = random_points(50), random_rotations(20)
    here = spherical_harmonics(points, lmax)
    there = spherical_harmonics(points @ rotations.mT, lmax)
    blocks = wigner_blocks(rotations, lmax)
    start = 0
    for degree, block in enumerate(blocks):
        part = slice(start, start := start + 2 * degree + 1)
        turned = torch.einsum("rnm,vm->rvn", block, here[:, part])
        torch.testing.assert_close(turned, there[..., part], atol=1e-12, rtol=0)
        # The control: of degrees with a direction, the transposed matrix does not.
        wrong = torch.einsum("rmn,vm->rvn", block, here[:, part])
        assert degree == 0 or (wrong - there[..., part]).abs().max() > 0.1


def special_rotations():
    """Where Euler angles are not determined, or nearly not, beside random ones."""
    small = torch.tensor([0.0, 1e-9, 1e-7, 1e-4, 180.0, 180 - 1e-7, 180 - 1e-4])
    tilts = axis_rotation("y", small.double())
    turns = axis_rotation("z", torch.tensor([0.0, 33.0, 200.0]).double())
    return torch.cat(
        [(turns[:, None] @ tilts @ axis_rotation("z", 71)).flatten(0, 1), random_rotations(20)]
    )


def test_homomorphism_and_orthogonality():
    a, b = special_rotations(), special_rotations().flip(0)
    for one, two, product in zip(
        wigner_blocks(a, 6), wigner_blocks(b, 6), wigner_blocks(a @ b, 6), strict=True
    ):
        torch.testing.assert_close(one @ two, product, atol=1e-12, rtol=0)
        eye = torch.eye(one.shape[-1]).double().expand_as(one)
        torch.testing.assert_close(one @ one.mT, eye, atol=1e-12, rtol=0)


def test_float32_is_as_good_as_its_rounding():
    rotation = special_rotations()
    exact, rounded = wigner_basis(rotation, 6), wigner_basis(rotation.float(), 6)
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded.double(), exact, atol=3e-5, rtol=0)


def test_agrees_with_e3nn():
    """e3nn's matrices, whose generators are in float32, in its own axes (y, z, x)."""
    rotation = random_rotations(8)
    theirs = rotation[:, [1, 2, 0]][:, :, [1, 2, 0]]
    for degree, block in enumerate(wigner_blocks(rotation, 6)):
        expected = o3.wigner_D(degree, *o3.matrix_to_angles(theirs))
        torch.testing.assert_close(block, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("lmax", [2, 4])
def test_basis_is_orthonormal(lmax):
    """By a product quadrature over Euler angles that is exact for these degrees."""
    points, weights = sphere_quadrature(2 * lmax + 1)
    turns = torch.arange(2 * lmax + 2).double() * 360 / (2 * lmax + 2)
    azimuth = torch.rad2deg(torch.atan2(points[:, 1], points[:, 0]))
    tilt = axis_rotation("z", azimuth) @ axis_rotation("y", torch.rad2deg(points[:, 2].acos()))
    basis = wigner_basis(tilt[:, None] @ axis_rotation("z", turns), lmax)
    weights = weights / (4 * torch.pi)
    gram = torch.einsum("ntc,ntd,n->cd", basis, basis, weights) / len(turns)
    torch.testing.assert_close(gram, torch.eye(num_wigner(lmax)).double(), atol=1e-11, rtol=0)
    mean = basis.mean(dim=1).T @ weights  # only the constant has a mean
    torch.testing.assert_close(mean, torch.eye(num_wigner(lmax))[0].double(), atol=1e-12, rtol=0)


def test_haar_grid_is_nearly_a_quadrature():
    off = []
    for level in (1, 2, 3):
        basis = wigner_basis(rotation_grid(level).rotations, 2)
        off.append((basis.T @ basis / len(basis) - torch.eye(num_wigner(2))).abs().max().item())
    assert off[0] > 3 * off[1] > 9 * off[2]
    assert off[2] < 0.005
    length = wigner_basis(random_rotations(5), 6).square().sum(dim=1)
    torch.testing.assert_close(length, torch.full((5,), 455.0).double())


def test_numbers_of_coefficients():
    assert [num_wigner(lmax) for lmax in (0, 1, 3, 6)] == [1, 10, 84, 455]
    assert coefficient_index(6).shape == (455, 3)


@pytest.mark.parametrize(("lmax", "level"), [(0, 0), (3, 1), (6, 2)])
def test_tables_of_a_grid_are_the_basis(lmax, level):
    grid = rotation_grid(level)
    coefficients = torch.randn(num_wigner(lmax), dtype=torch.float64)
    values = (direction_table(lmax, level) @ coefficients) @ turn_table(lmax, level)
    expected = wigner_basis(grid.rotations, lmax) @ coefficients
    torch.testing.assert_close(values.flatten(), expected, atol=1e-11, rtol=0)
    assert float32_tables(lmax, level)[0] is float32_tables(lmax, level)[0]


def test_generators_are_the_derivatives():
    """Against finite differences of matrices that are made another way."""
    table, step = generator_table(4), 1e-4
    identity = torch.cat([torch.eye(2 * degree + 1).double().flatten() for degree in range(5)])

    def entries(rotation):
        return torch.cat([block.flatten() for block in wigner_blocks(rotation, 4)])

    degrees = torch.rad2deg(torch.tensor(step)).item()
    for row, axis in enumerate("xyz"):
        forward, back = (entries(axis_rotation(axis, s * degrees)) for s in (1, -1))
        torch.testing.assert_close(table[row], (forward - back) / (2 * step), atol=1e-5, rtol=0)
        second = (forward - 2 * identity + back) / step**2
        torch.testing.assert_close(table[(3, 6, 8)[row]], second, atol=1e-4, rtol=0)
    # Mixed: the direction (1, 1, 0)/√2 bends by ½(xx + yy) + xy.
    diagonal = torch.matrix_exp(
        torch.tensor([[0, 0, 1], [0, 0, -1], [-1, 1, 0]]).double() * step / 2**0.5
    )
    second = (entries(diagonal) - 2 * identity + entries(diagonal.T)) / step**2
    torch.testing.assert_close((table[3] + table[6]) / 2 + table[4], second, atol=1e-4, rtol=0)


@pytest.mark.parametrize("lmax", [-1, 12, 1.5])
def test_unknown_degrees(lmax):
    with pytest.raises(ValueError, match="0 to 11"):
        spherical_harmonics(healpix_points(1), lmax)


def test_random_field_is_expanded_by_healpix_points():
    """The transform that the projector uses: equal weights, small error for low degrees."""
    coefficients = torch.randn(16, dtype=torch.float64)
    points = healpix_points(4)
    harmonics = spherical_harmonics(points, 3)
    found = harmonics.T @ (harmonics @ coefficients) * 4 * torch.pi / len(points)
    torch.testing.assert_close(found, coefficients, atol=0.05, rtol=0)
