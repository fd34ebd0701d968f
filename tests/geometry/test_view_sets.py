"""The cameras and how the group permutes them, against the matrices themselves."""

import hashlib

import numpy as np
import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.view_sets import (
    CAMERA_SETS,
    camera_directions,
    camera_rotations,
    num_views,
    view_permutations,
)

SIZES = {"icosahedron_12": 12, "dodecahedron_20": 20, "group_60": 60}
GROUP = icosahedron(0)
# Rendered views are stored in this order and with this roll: do not change one without the other.
CHECKSUMS = {
    "icosahedron_12": "85accdc9711a4766",
    "dodecahedron_20": "ae9f192dd096e3b2",
    "group_60": "1b1e7e750e508d34",
}
every = pytest.mark.parametrize("name", CAMERA_SETS)


@every
def test_cameras_are_those_of_stored_views(name):
    rounded = np.round(camera_rotations(name) * 1e4).astype("<i8")
    assert hashlib.sha256(rounded.tobytes()).hexdigest()[:16] == CHECKSUMS[name]


@every
def test_sizes_and_types(name):
    assert num_views(name) == SIZES[name]
    assert camera_rotations(name).shape == (SIZES[name], 3, 3)
    assert camera_directions(name).shape == (SIZES[name], 3)
    assert camera_directions(name).dtype == torch.float64
    assert view_permutations(name).shape == (60, SIZES[name])
    assert view_permutations(name).dtype == torch.int64


@every
def test_every_camera_is_a_rotation_that_brings_its_direction_to_the_viewer(name):
    cameras, directions = camera_rotations(name), camera_directions(name).numpy()
    np.testing.assert_allclose(
        cameras @ cameras.transpose(0, 2, 1), np.broadcast_to(np.eye(3), cameras.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(cameras), 1, atol=1e-12)
    seen = np.einsum("vij,vj->vi", cameras, directions)
    np.testing.assert_allclose(seen, np.tile([0.0, 0.0, 1.0], (len(seen), 1)), atol=1e-12)


@pytest.mark.parametrize("name", ["icosahedron_12", "dodecahedron_20"])
def test_roll_is_the_documented_one(name):
    cameras, directions = camera_rotations(name), camera_directions(name).numpy()
    on_axis = 0
    for camera, direction in zip(cameras, directions, strict=True):
        pole = np.hypot(*direction[:2]) < 1e-9
        on_axis += pole
        seen = camera @ ([0, 1, 0] if pole else [0, 0, 1])
        assert abs(seen[0]) < 1e-12, "up leans to the side"
        assert seen[1] > 0.5, "up points down"
    assert on_axis == (2 if name == "icosahedron_12" else 0)
    heights = np.abs(directions[np.hypot(*directions[:, :2].T) > 1e-9, 2])
    assert heights.max() < 0.8  # far from the threshold of the rule


def test_directions_are_the_two_solids():
    corners, middles = (camera_directions(name) for name in CAMERA_SETS[:2])
    # Closed forms of the distances: five neighbours at 63.43°, three at 41.81°.
    for points, neighbours, cosine in ((corners, 5, 1 / 5**0.5), (middles, 3, 5**0.5 / 3)):
        torch.testing.assert_close(points.norm(dim=1), torch.ones(len(points)).double())
        products = points @ points.T - 2 * torch.eye(len(points))
        near = (products - cosine).abs() < 1e-9
        assert (near.sum(dim=1) == neighbours).all()
        assert products.max() < cosine + 1e-9


def test_sixty_cameras_are_five_rolls_on_every_corner():
    cameras = camera_rotations("group_60")
    corner_of = (camera_directions("group_60") @ camera_directions("icosahedron_12").T).argmax(1)
    assert torch.bincount(corner_of).tolist() == [5] * 12
    for corner in range(12):
        here = cameras[(corner_of == corner).numpy()]
        turns = here @ here[0].T
        np.testing.assert_allclose(turns[:, 2, 2], 1, atol=1e-12)
        angles = np.degrees(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
        np.testing.assert_allclose(sorted(angles), [-144, -72, 0, 72, 144], atol=1e-9)


@every
def test_permutations_against_brute_force(name):
    directions, table = camera_directions(name), view_permutations(name)
    moved = torch.einsum("gij,vj->gvi", GROUP.rotations, directions)
    found = directions[table]
    torch.testing.assert_close(moved, found, atol=1e-9, rtol=0)
    if name != "group_60":  # there five cameras share a direction: see the next test
        distance = torch.cdist(moved, directions.expand(60, -1, -1))
        assert torch.equal(distance.argmin(dim=2), table)
        assert (distance < 1e-6).sum() == 60 * SIZES[name]


def test_sixty_cameras_see_a_turned_object_exactly_as_permuted():
    cameras, table = torch.from_numpy(camera_rotations("group_60")), view_permutations("group_60")
    for element in range(60):
        torch.testing.assert_close(
            cameras[table[element]] @ GROUP.rotations[element], cameras, atol=1e-12, rtol=0
        )


@pytest.mark.parametrize("name", ["icosahedron_12", "dodecahedron_20"])
def test_other_cameras_see_a_turned_object_as_permuted_up_to_a_roll(name):
    cameras, table = torch.from_numpy(camera_rotations(name)), view_permutations(name)
    turned = cameras[table] @ GROUP.rotations[:, None]  # (60, V, 3, 3)
    rolls = turned @ cameras.mT
    torch.testing.assert_close(rolls[..., 2, 2], torch.ones(60, SIZES[name]).double())
    assert (rolls[..., 0, 0] < 0.99).any()


@every
def test_permutations_are_the_group(name):
    table = view_permutations(name)
    everyone = torch.arange(SIZES[name])
    assert torch.equal(table[0], everyone)
    assert all(torch.equal(row.sort().values, everyone) for row in table)
    assert len({tuple(row) for row in table.tolist()}) == 60
    # [g, h, v]: the image under g of the image under h.
    assert torch.equal(table[:, table], table[GROUP.multiplication])
    assert torch.equal(table[GROUP.inverse].gather(1, table), everyone.expand(60, -1))
    assert {int(i) for i in table[:, 0]} == set(range(SIZES[name])), "not one orbit"


def test_tables_are_the_callers_own():
    for name in CAMERA_SETS:
        for make in (camera_rotations, camera_directions, view_permutations):
            make(name)[:] = 0
            assert (make(name) != 0).any()


@pytest.mark.parametrize(
    "make", [camera_rotations, camera_directions, view_permutations, num_views]
)
def test_unknown_set(make):
    with pytest.raises(ValueError, match="icosahedron_12, dodecahedron_20, group_60"):
        make("cube_6")
