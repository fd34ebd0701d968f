"""Rotations that cut SO(3) into cells of equal volume: HEALPix points times a circle.

A grid of level L has 12·4^L directions (HEALPix with nside = 2^L, in ring order) and 6·2^L turns,
72·8^L rotations in all: ``Rz(azimuth) @ Ry(polar) @ Rz(turn)``, the turn fastest. HEALPix pixels
have equal areas and the turns equal arcs, so each rotation stands for the same share of SO(3). Both
factors are closed under quarter turns about z from level 1 on.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

MAX_LEVEL = 5  # 2.36 million rotations


@dataclass(frozen=True, eq=False)
class RotationGrid:
    """A grid of 72·8^level rotations; made by `rotation_grid`, shared, never to be written to.

    P = 12·4^level directions, T = 6·2^level turns, K = P·T.

    Attributes:
        level: 0 to 5.
        azimuth_rad: Azimuth of each direction, shape (P,), float64.
        polar_rad: Angle of each direction to +z, shape (P,), float64.
        turn_rad: The turns, shape (T,), float64.
        rotations: Rotation i·T + j of direction i and turn j, shape (K, 3, 3), float64.
    """

    level: int
    azimuth_rad: Tensor
    polar_rad: Tensor
    turn_rad: Tensor
    rotations: Tensor

    def __len__(self) -> int:
        return len(self.rotations)

    def __repr__(self) -> str:
        spacing = 360.0 / len(self.turn_rad)
        return f"RotationGrid(level={self.level}: {len(self)} rotations, about {spacing:g}° apart)"


def healpix_angles(nside: int) -> tuple[Tensor, Tensor]:
    """Centres of the HEALPix pixels in ring order: rings from +z to −z, azimuth rising.

    Args:
        nside: Pixels along a side of each of the twelve base pixels.

    Returns:
        Polar angle and azimuth in radians, each of shape (12·nside²,), float64.

    Raises:
        ValueError: If ``nside`` is not positive.

    Reference:
        Górski et al. 2005, "HEALPix: a framework for high-resolution discretization and fast
        analysis of data distributed on the sphere", §5.1.
    """
    if nside < 1:
        raise ValueError(f"nside={nside} is not possible: give a positive integer, such as 4")
    cosines, azimuths = [], []
    for ring in range(1, 4 * nside):
        from_pole = min(ring, 4 * nside - ring)
        if from_pole < nside:  # a polar cap: the ring has four pixels for each step from the pole
            count, shift = 4 * from_pole, 0.5
            cosine = math.copysign(1 - from_pole**2 / (3 * nside**2), 2 * nside - ring)
        else:  # the belt: rings of equal length, every other one shifted by half a pixel
            count, shift = 4 * nside, 0.5 * ((ring - nside + 1) % 2)
            cosine = 4 / 3 - 2 * ring / (3 * nside)
        cosines.append(torch.full((count,), cosine, dtype=torch.float64))
        azimuths.append((torch.arange(count, dtype=torch.float64) + shift) * (2 * math.pi / count))
    return torch.cat(cosines).acos(), torch.cat(azimuths)


def healpix_points(nside: int) -> Tensor:
    """Unit vectors to the HEALPix pixels in ring order, shape (12·nside², 3), float64.

    See `healpix_angles`.
    """
    polar, azimuth = healpix_angles(nside)
    ring = polar.sin()
    return torch.stack((ring * azimuth.cos(), ring * azimuth.sin(), polar.cos()), dim=-1)


def rotation_grid(level: int) -> RotationGrid:
    """The grid of 72·8^level rotations, built once per process and shared.

    Args:
        level: 0 (72 rotations, 60° apart) to 5 (2,359,296, 1.9° apart).

    Returns:
        The grid.

    Raises:
        ValueError: If the level is another.

    Reference:
        Yershova et al. 2010, "Generating uniform incremental grids on SO(3) using the Hopf
        fibration", with Euler angles in place of Hopf coordinates.

    Example:
        >>> rotation_grid(1)
        RotationGrid(level=1: 576 rotations, about 30° apart)
    """
    if level not in range(MAX_LEVEL + 1):
        raise ValueError(f"rotation grid level {level!r} is not one of 0 to {MAX_LEVEL}")
    return _build(level)


def nearest_cell(target: Tensor, rotations: Tensor, *, chunk: int = 4096) -> Tensor:
    """The grid rotation nearest to each rotation.

    The trace of ``target.T @ rotation`` is a dot product of nine numbers, so the whole is a matrix
    product; it is made ``chunk`` targets at a time.

    Args:
        target: Rotations, shape (B, 3, 3).
        rotations: The grid, shape (K, 3, 3), cast to the type and device of ``target``.
        chunk: Most targets compared at once, that is, at most chunk·K numbers.

    Returns:
        Numbers of the nearest rotations, shape (B,), int64; the first of equals.

    Raises:
        ValueError: If the shapes are others.
    """
    for name, given in (("target", target), ("rotations", rotations)):
        if given.ndim != 3 or given.shape[1:] != (3, 3):
            raise ValueError(f"{name} wants shape (n, 3, 3), got {tuple(given.shape)}")
    table = rotations.to(target).flatten(1).T
    parts = [(part @ table).argmax(dim=1) for part in target.flatten(1).split(chunk)]
    return torch.cat(parts)


@lru_cache(maxsize=MAX_LEVEL + 1)
def _build(level: int) -> RotationGrid:
    polar, azimuth = healpix_angles(2**level)
    count = 6 * 2**level
    turn = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    directions = about_z(azimuth) @ _about_y(polar)
    rotations = (directions[:, None] @ about_z(turn)[None]).flatten(0, 1)
    return RotationGrid(level, azimuth, polar, turn, rotations)


def about_z(angle_rad: Tensor) -> Tensor:
    """Rotations about z by angles in radians, (...) -> (..., 3, 3)."""
    cos, sin = angle_rad.cos(), angle_rad.sin()
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = (cos, -sin, zero, sin, cos, zero, zero, zero, one)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _about_y(angle_rad: Tensor) -> Tensor:
    cos, sin = angle_rad.cos(), angle_rad.sin()
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = (cos, zero, sin, zero, one, zero, -sin, zero, cos)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
