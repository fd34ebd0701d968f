"""Symmetries of objects about their own z axis, and what they mean for labels and errors.

The words: `none`; `z`, any turn about the object's z axis; `z2`, the half turn about it.
"""

import torch
from torch import Tensor

from i2i.geometry.rotations import (
    axis_rotation,
    geodesic_angle_rad,
    strip_z_symmetry,
    z_axis_angle_rad,
)


def strip_symmetry(rotation: Tensor, symmetry: str) -> Tensor:
    """One label for all rotations that look the same: `rotation` (..., 3, 3) -> (..., 3, 3).

    `z` loses its turn about the object's z axis. Of the two of `z2` the one is kept whose object x
    axis points to the right in the picture. Both jump somewhere: no choice is continuous.
    """
    if symmetry == "z":
        return strip_z_symmetry(rotation)
    if symmetry == "z2":
        half_turn = axis_rotation("z", 180.0).to(rotation)
        leftward = rotation[..., 0, 0] < 0
        return torch.where(leftward[..., None, None], rotation @ half_turn, rotation)
    return rotation


def symmetric_angle_rad(a: Tensor, b: Tensor, symmetry: str) -> Tensor:
    """Smallest angle between rotations over all turns that look the same: (...,) in radians."""
    if symmetry == "z":
        return z_axis_angle_rad(a, b)
    angle = geodesic_angle_rad(a, b)
    if symmetry == "z2":
        turned = b @ axis_rotation("z", 180.0).to(b)
        return torch.minimum(angle, geodesic_angle_rad(a, turned))
    return angle


def equivalents(rotation: Tensor, symmetry: str, *, count: int = 72) -> Tensor:
    """Rotations that look the same as `rotation` (..., 3, 3): (..., N, 3, 3).

    N is 1 for `none`, 2 for `z2`, and `count` evenly spaced turns for `z`.
    """
    turns = {"none": 1, "z2": 2, "z": count}[symmetry]
    angles = torch.arange(turns, dtype=torch.float64) * (360.0 / turns)
    return rotation[..., None, :, :] @ axis_rotation("z", angles).to(rotation)
