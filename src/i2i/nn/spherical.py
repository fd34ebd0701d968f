"""Real spherical harmonics and Wigner matrices in this project's axes, on top of e3nn.

e3nn's polar axis is y. Its (x, y, z) are our (y, z, x), a turn of the axes, so that here the polar
axis is z and the three harmonics of l = 1 are those of (y, z, x), order m = −1, 0, 1.

A function on SO(3) that is band-limited to l <= lmax is written by its coefficients in
``U[l, n, m](R) = √(2l+1) · D^l(R)[n, m]``, an orthonormal basis for the Haar measure of total mass
1. There are Σ (2l+1)² of them (455 for lmax 6), in the order l, n, m, n and m from −l to l.
"""

from functools import lru_cache

import torch
from e3nn import o3
from torch import Tensor

from i2i.geometry.rotation_grids import about_z, healpix_points, rotation_grid
from i2i.geometry.rotations import axis_rotation

MAX_LMAX = 11  # e3nn's spherical harmonics end here

_TO_E3NN = [1, 2, 0]


def num_harmonics(lmax: int) -> int:
    """Spherical harmonics up to lmax: (lmax + 1)²."""
    return (lmax + 1) ** 2


def num_wigner(lmax: int) -> int:
    """Entries of the Wigner matrices up to lmax, Σ (2l+1)²: 455 for lmax 6."""
    return sum((2 * degree + 1) ** 2 for degree in range(lmax + 1))


def check_lmax(lmax: int) -> int:
    """Return `lmax` if tables can be made for it; ValueError otherwise."""
    if lmax not in range(MAX_LMAX + 1):
        raise ValueError(f"lmax={lmax!r} is not possible: give an integer from 0 to {MAX_LMAX}")
    return int(lmax)


def spherical_harmonics(points: Tensor, lmax: int) -> Tensor:
    """Real spherical harmonics, orthonormal on the unit sphere (their squares integrate to 1).

    Args:
        points: Unit vectors, shape (..., 3).
        lmax: Highest degree.

    Returns:
        Shape (..., (lmax+1)²), degree by degree, m from −l to l.
    """
    degrees = list(range(check_lmax(lmax) + 1))
    harmonics: Tensor = o3.spherical_harmonics(
        degrees, points[..., _TO_E3NN], normalize=True, normalization="integral"
    )
    return harmonics


def wigner_blocks(rotation: Tensor, lmax: int) -> list[Tensor]:
    """Wigner matrices: ``spherical_harmonics(R p) = D(R) spherical_harmonics(p)``, by degree.

    R = Rz(α) Ry(β) Rz(γ); turns about z are known in closed form, and Ry is Rz between two constant
    quarter turns. Accurate everywhere, also where α and γ are not determined.

    Args:
        rotation: Shape (..., 3, 3).
        lmax: Highest degree.

    Returns:
        For each l = 0..lmax a tensor (..., 2l+1, 2l+1).
    """
    alpha, beta, gamma = _euler_zyz_rad(rotation)
    blocks = []
    for degree, quarter in enumerate(_quarter_turns(check_lmax(lmax))):
        quarter = quarter.to(rotation)
        tilted = _about_z_block(alpha, degree) @ quarter @ _about_z_block(beta, degree)
        blocks.append(tilted @ quarter.T @ _about_z_block(gamma, degree))
    return blocks


def wigner_basis(rotation: Tensor, lmax: int) -> Tensor:
    """The orthonormal basis of functions on SO(3) at rotations: (..., 3, 3) -> (..., Σ(2l+1)²)."""
    blocks = wigner_blocks(rotation, lmax)
    return torch.cat(
        [(2 * degree + 1) ** 0.5 * block.flatten(-2) for degree, block in enumerate(blocks)], dim=-1
    )


def coefficient_index(lmax: int) -> Tensor:
    """Degree l and orders n, m of each coefficient, shape (Σ(2l+1)², 3), int64."""
    return torch.tensor(
        [
            (degree, n, m)
            for degree in range(lmax + 1)
            for n in range(-degree, degree + 1)
            for m in range(-degree, degree + 1)
        ]
    )


@lru_cache(maxsize=8)
def generator_table(lmax: int) -> Tensor:
    """How ``D(exp(ω) R)`` varies with ω at 0: (9, Σ(2l+1)²), float64.

    Rows 0–2 are the derivatives G_x, G_y, G_z of D at the identity, in the order of the
    coefficients; rows 3–8 are the symmetric products ½(G_a G_b + G_b G_a) for xx, xy, xz, yy, yz,
    zz.
    """
    rows: list[list[Tensor]] = [[] for _ in range(9)]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    for degree in range(check_lmax(lmax) + 1):
        about_z_ = _z_generator(degree)
        # D(Q) G_z D(Q)ᵀ is the generator about Q z: quarter turns that take z to x and to y.
        to_x = wigner_blocks(axis_rotation("y", 90), degree)[degree]
        to_y = wigner_blocks(axis_rotation("x", -90), degree)[degree]
        axes = [to_x @ about_z_ @ to_x.T, to_y @ about_z_ @ to_y.T, about_z_]
        second = [(axes[a] @ axes[b] + axes[b] @ axes[a]) / 2 for a, b in pairs]
        for row, matrix in zip(rows, axes + second, strict=True):
            row.append(matrix.flatten())
    return torch.stack([torch.cat(row) for row in rows])


@lru_cache(maxsize=8)
def direction_table(lmax: int, level: int) -> Tensor:
    """First half of the values on a rotation grid: (P, 2·lmax+1, Σ(2l+1)²), float64.

    On the rotations of `rotation_grid(level)` with direction i, a function with coefficients c is
    a Fourier series in the turn: ``Σ_k a_k cos(k·turn) + b_k sin(k·turn)``. Row i of the table
    times c is (a_0, ..., a_lmax, b_1, ..., b_lmax); `turn_table` has the cosines and sines. The
    two tables are a fraction of that of all K values: 18 MB for 67 MB at lmax 6 and level 3.
    """
    grid = rotation_grid(level)
    turns = len(grid.turn_rad)
    basis = wigner_basis(grid.rotations[::turns], lmax)  # of turn 0
    degree, n, m = coefficient_index(lmax).unbind(dim=1)
    position = {
        key: i for i, key in enumerate(zip(*(t.tolist() for t in (degree, n, m)), strict=True))
    }
    mirrored = torch.tensor([position[d, a, -b] for d, a, b in coefficient_index(lmax).tolist()])
    table = torch.zeros(len(basis), 2 * lmax + 1, basis.shape[1], dtype=torch.float64)
    column = torch.arange(basis.shape[1])
    # D(R Rz(t))[n, m] = D(R)[n, m] cos(m t) + D(R)[n, −m] sin(m t)
    table[:, m.abs(), column] = basis
    turning = m != 0
    table[:, lmax + m.abs()[turning], column[turning]] = (
        basis[:, mirrored[turning]] * m[turning].sign()
    )
    return table


def turn_table(lmax: int, level: int) -> Tensor:
    """Cosines (k = 0..lmax) and sines (k = 1..lmax) of the grid's turns: (2·lmax+1, T), float64."""
    frequency = torch.arange(lmax + 1, dtype=torch.float64)[:, None]
    angle = frequency * rotation_grid(level).turn_rad
    return torch.cat((angle.cos(), angle.sin()[1:]))


@lru_cache(maxsize=8)
def float32_tables(lmax: int, level: int) -> tuple[Tensor, Tensor]:
    """`direction_table`, flat (P·(2·lmax+1), Σ(2l+1)²), and `turn_table` in float32, shared."""
    table = direction_table(lmax, level).flatten(0, 1).float()
    return table, turn_table(lmax, level).float()


@lru_cache(maxsize=4)
def _quarter_turns(lmax: int) -> tuple[Tensor, ...]:
    """Wigner matrices of the quarter turn that takes z to y, one for each degree, float64.

    They are read off the harmonics of turned points, which are exact to rounding; e3nn's own Wigner
    matrices come from generators in float32.
    """
    points = healpix_points(8)
    here = spherical_harmonics(points, lmax)
    there = spherical_harmonics(points @ axis_rotation("x", -90).T, lmax)
    widths = [2 * degree + 1 for degree in range(lmax + 1)]
    pairs = zip(here.split(widths, dim=1), there.split(widths, dim=1), strict=True)
    return tuple(torch.linalg.lstsq(a, b).solution.T.contiguous() for a, b in pairs)


def _z_generator(degree: int) -> Tensor:
    """Derivative of `_about_z_block` at 0: entry [m, −m] is −m."""
    return torch.diag(-torch.arange(-degree, degree + 1, dtype=torch.float64)).flip(1)


def _about_z_block(angle_rad: Tensor, degree: int) -> Tensor:
    """Wigner matrix of Rz: cos(mα) on the diagonal, −sin(mα) at [m, −m]. (...) -> (..., d, d)."""
    order = torch.arange(-degree, degree + 1, device=angle_rad.device)
    angle = angle_rad[..., None] * order
    return torch.diag_embed(angle.cos()) - torch.diag_embed(angle.sin()).flip(-1)


def _euler_zyz_rad(rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """α, β, γ with R = Rz(α) Ry(β) Rz(γ), each (...); any α will do where β is 0 or π."""
    alpha = torch.atan2(rotation[..., 1, 2], rotation[..., 0, 2])
    # What Rz(α) leaves is Ry(β) Rz(γ): each angle from its own row, so that no error is inherited.
    rest = about_z(-alpha) @ rotation
    beta = torch.atan2(rest[..., 0, 2], rest[..., 2, 2])
    gamma = torch.atan2(rest[..., 1, 0], rest[..., 1, 1])
    return alpha, beta, gamma
