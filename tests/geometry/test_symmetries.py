"""Rotations that look the same: labels, angles, and the sets of them."""

import pytest
import torch

from i2i.geometry.rotations import axis_rotation, geodesic_angle_rad, random_rotations
from i2i.geometry.symmetries import equivalents, strip_symmetry, symmetric_angle_rad

ROTATIONS = random_rotations(200, torch.Generator().manual_seed(0), dtype=torch.float64)
OTHERS = random_rotations(200, torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize(("symmetry", "turn_deg"), [("z", 77.0), ("z2", 180.0)])
def test_what_looks_the_same_has_one_label_and_no_angle(symmetry, turn_deg):
    turned = ROTATIONS @ axis_rotation("z", turn_deg)
    labels = strip_symmetry(ROTATIONS, symmetry), strip_symmetry(turned, symmetry)
    torch.testing.assert_close(*labels, atol=1e-12, rtol=0)
    assert symmetric_angle_rad(ROTATIONS, turned, symmetry).max() < 1e-7
    assert symmetric_angle_rad(ROTATIONS, labels[0], symmetry).max() < 1e-7


def test_other_turns_are_told_apart():
    quarter = ROTATIONS @ axis_rotation("z", 90.0)
    tilted = ROTATIONS @ axis_rotation("x", 40.0)
    assert symmetric_angle_rad(ROTATIONS, quarter, "z2").min() > 1.57
    assert symmetric_angle_rad(ROTATIONS, quarter, "none").min() > 1.57
    for symmetry in ("none", "z", "z2"):
        torch.testing.assert_close(
            torch.rad2deg(symmetric_angle_rad(ROTATIONS, tilted, symmetry)),
            torch.full((200,), 40.0, dtype=torch.float64),
        )
    assert torch.equal(strip_symmetry(ROTATIONS, "none"), ROTATIONS)


@pytest.mark.parametrize("symmetry", ["none", "z2", "z"])
def test_the_angle_is_the_smallest_over_the_equivalents(symmetry):
    same = equivalents(OTHERS, symmetry, count=720)
    by_hand = geodesic_angle_rad(ROTATIONS[:, None], same).amin(dim=1)
    found = symmetric_angle_rad(ROTATIONS, OTHERS, symmetry)
    torch.testing.assert_close(found, by_hand, atol=0.005 if symmetry == "z" else 1e-9, rtol=0)
    assert symmetric_angle_rad(same, OTHERS[:, None], symmetry).max() < 1e-6


def test_the_half_turn_label_points_right():
    assert (strip_symmetry(ROTATIONS, "z2")[:, 0, 0] >= 0).all()
