"""The group is proved here, not trusted: against closed forms, brute force and matrix products."""

import math

import numpy as np
import pytest
import torch

from i2i.geometry.icosahedron import compose, icosahedron, nearest_element, residual
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations

LEVELS = (0, 1, 2)
AXES = ("vertex", "twofold")
PHI = (1 + math.sqrt(5)) / 2

# Checkpoints depend on these orders. If this test fails, old checkpoints mean something else:
# do not update the numbers without a migration.
CHECKSUMS = {
    (0, "conjugated", False): "f0a3ccc58f7267de7005f26a3f11cc25e16b1ec81291ebd4385d06f28050e77d",
    (1, "conjugated", False): "4c9d123cf02a624965c9885705537248f85daaac4b2e5a4bd35c31dedba5531d",
    (2, "conjugated", False): "dd362b2d3e762f350b130a7841d78a05a63d5f01bb14fe63b2ac7505f3bb8da0",
    (1, "standard", False): "c98e3a69d27790b541ded746c070f7d48e0a3dd87dc01b3a4fc9312907d78cb8",
    (1, "conjugated", True): "9ba1bf3c7b7b94eef2eef1fc4811df0b527d7672bea9ac1b309e3868acec1ffd",
}
TWOFOLD_CHECKSUMS = {
    (0, "conjugated", False): "ae0b416d9654cc1a5a2cf6b9afb229b693a6d226c09ce6c3af7ae0532ab7e4c4",
    (1, "conjugated", False): "c2d53f9e1eaba8230f6cee2633ede798c85096b6892eff8b16dce3e5f6585ffd",
    (2, "conjugated", False): "2143821ac49f48231dc697b7cf4f3a09a1d5b982639b054fd5ebe6fb2d91709a",
    (1, "standard", False): "c2d53f9e1eaba8230f6cee2633ede798c85096b6892eff8b16dce3e5f6585ffd",
    (1, "conjugated", True): "936e8af405b8d66725dc120e9f16a2a9215a2340fd7e4c46dfd29bd36219e3bb",
}


@pytest.fixture(params=[(level, axis) for axis in AXES for level in LEVELS], ids=str)
def mesh(request):
    level, axis = request.param
    return icosahedron(level, mesh_axis=axis)


def as_set(points):
    return {tuple(p) for p in (np.round(np.asarray(points), 6) + 0.0).tolist()}


@pytest.mark.parametrize(("key", "expected"), CHECKSUMS.items())
def test_orders_are_those_of_old_checkpoints(key, expected):
    level, frame, normalize = key
    assert icosahedron(level, frame, normalize_midpoints=normalize).checksum == expected


@pytest.mark.parametrize(("key", "expected"), TWOFOLD_CHECKSUMS.items())
def test_orders_with_an_edge_to_the_viewer(key, expected):
    level, frame, normalize = key
    mesh = icosahedron(level, frame, normalize_midpoints=normalize, mesh_axis="twofold")
    assert mesh.checksum == expected


def test_corners_are_the_closed_form_with_a_vertex_up():
    ring = 2 / math.sqrt(5)
    expected = [(0, 0, 1)]
    for k in range(5):
        azimuth = math.radians(72 * k)
        expected.append((ring * math.cos(azimuth), ring * math.sin(azimuth), 1 / math.sqrt(5)))
    for k in range(5):
        azimuth = math.radians(72 * k + 36)
        expected.append((ring * math.cos(azimuth), ring * math.sin(azimuth), -1 / math.sqrt(5)))
    expected.append((0, 0, -1))
    np.testing.assert_allclose(icosahedron(0).vertices, expected, atol=1e-12)


def test_corners_are_the_closed_form_with_an_edge_up():
    one, phi = np.array([1, PHI]) / math.sqrt(1 + PHI**2)
    expected = [
        (0, one, phi), (0, -one, phi), (phi, 0, one), (-phi, 0, one),
        (one, phi, 0), (-one, phi, 0), (-one, -phi, 0), (one, -phi, 0),
        (phi, 0, -one), (-phi, 0, -one), (0, one, -phi), (0, -one, -phi),
    ]  # fmt: skip
    mesh = icosahedron(0, mesh_axis="twofold")
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-12)
    assert torch.equal(mesh.tilt, torch.eye(3).double())
    assert icosahedron(1, mesh_axis="twofold").vertices[12].tolist() == pytest.approx([0, 0, phi])


def test_tilt_leads_back_to_the_standard_corners():
    length = math.sqrt(1 + PHI**2)
    standard = [
        np.roll((0, s / length, t * PHI / length), shift)
        for s in (1, -1)
        for t in (1, -1)
        for shift in range(3)
    ]
    mesh = icosahedron(0)
    assert as_set(mesh.vertices @ mesh.tilt) == as_set(standard)
    assert torch.det(mesh.tilt).item() == pytest.approx(1)


def test_edges_have_the_length_of_the_literature():
    mesh = icosahedron(0)
    a, b = mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]]
    torch.testing.assert_close((a - b).norm(dim=-1), torch.full((20,), 1.05146222).double())


@pytest.mark.parametrize(
    ("level", "axis", "count", "half"),
    [(0, "vertex", 12, 6), (1, "vertex", 42, 16), (2, "vertex", 162, 71),
     (0, "twofold", 12, 4), (1, "twofold", 42, 17), (2, "twofold", 162, 73)],
)  # fmt: skip
def test_census_of_vertices_and_half_mesh(level, axis, count, half):
    mesh = icosahedron(level, mesh_axis=axis)
    assert mesh.vertices.shape == (count, 3)
    assert mesh.visible.tolist() == [i for i in range(count) if mesh.vertices[i, 2] > 1e-6]
    assert len(mesh.visible) == half
    assert torch.bincount(mesh.vertex_level).tolist() == [12, 30, 120][: level + 1]


@pytest.mark.parametrize(
    ("normalize", "middle_heights", "middle_radii"),
    [
        (False, (0.723607, 0.447214), (0.447214, 0.723607)),
        (True, (0.850651, 0.525731), (0.525731, 0.850651)),
    ],
)
def test_heights_and_projected_radii_of_the_half_mesh(normalize, middle_heights, middle_radii):
    mesh = icosahedron(1, normalize_midpoints=normalize)
    heights = [1.0] + [0.447214] * 5 + [middle_heights[0]] * 5 + [middle_heights[1]] * 5
    radii = [0.0] + [0.894427] * 5 + [middle_radii[0]] * 5 + [middle_radii[1]] * 5
    np.testing.assert_allclose(mesh.vertices[mesh.visible, 2], heights, atol=1e-6)
    np.testing.assert_allclose(mesh.visible_xy.norm(dim=-1), radii, atol=1e-6)
    horizon = (mesh.vertices[:, 2].abs() < 1e-6).sum()
    assert horizon == 10


def test_midpoints_stay_on_the_edges_unless_normalised():
    as_cut, on_sphere = icosahedron(1), icosahedron(1, normalize_midpoints=True)
    np.testing.assert_allclose(as_cut.vertices[12:].norm(dim=-1), 0.850651, atol=1e-6)
    np.testing.assert_allclose(on_sphere.vertices.norm(dim=-1), 1.0, atol=1e-12)
    torch.testing.assert_close(as_cut.directions, on_sphere.vertices)
    assert torch.equal(as_cut.action, on_sphere.action)
    assert torch.equal(icosahedron(2).action, icosahedron(2, normalize_midpoints=True).action)


def test_vertices_follow_the_documented_order(mesh):
    for batch in range(mesh.level + 1):
        points = mesh.vertices[mesh.vertex_level == batch]
        keys = []
        for x, y, z in points.tolist():
            turn = math.atan2(y, x) % (2 * math.pi) if math.hypot(x, y) > 1e-6 else 0.0
            keys.append((round(-z, 6), round(0.0 if turn > 6.283184 else turn, 6)))
        assert keys == sorted(keys)
        assert len(set(keys)) == len(keys)
    assert mesh.vertex_level.tolist() == sorted(mesh.vertex_level.tolist())


def test_faces_close_the_surface_and_look_outwards(mesh):
    faces = mesh.faces
    assert len(faces) == 20 * 4**mesh.level
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    edges = {tuple(e) for e in directed}
    assert len(edges) == len(directed)  # each directed edge once: consistent winding
    assert edges == {(b, a) for a, b in edges}  # and its reverse once: closed
    a, b, c = (mesh.vertices[faces[:, i]] for i in range(3))
    volume = (torch.linalg.cross(b - a, c - a) * a).sum() / 6
    assert volume.item() == pytest.approx(2.536151, abs=1e-5)  # of the icosahedron of unit radius


@pytest.mark.parametrize(
    ("frame", "axis"), [("conjugated", "vertex"), ("standard", "vertex"), ("conjugated", "twofold")]
)
def test_group_axioms(frame, axis):
    mesh = icosahedron(1, frame, mesh_axis=axis)
    r = mesh.rotations
    assert r.shape == (60, 3, 3)
    torch.testing.assert_close(r @ r.mT, torch.eye(3).double().expand(60, 3, 3))
    torch.testing.assert_close(torch.det(r), torch.ones(60).double())
    torch.testing.assert_close(r[mesh.identity], torch.eye(3).double())
    products = torch.einsum("gij,hjk->ghik", r, r)
    torch.testing.assert_close(r[mesh.multiplication], products, atol=1e-12, rtol=0)
    torch.testing.assert_close(r[mesh.inverse], r.mT, atol=1e-12, rtol=0)
    for table in (mesh.multiplication, mesh.multiplication.T):
        assert torch.equal(table.sort(dim=1).values, torch.arange(60).expand(60, 60))
    apart = (r[:, None] - r[None]).flatten(2).norm(dim=-1) + 9 * torch.eye(60)
    assert apart.min() > 1


@pytest.mark.parametrize("frame", ["conjugated", "standard"])
def test_angle_census(frame):
    degrees = torch.rad2deg(icosahedron(1, frame).angles_rad)
    counts = {
        angle: int((degrees - angle).abs().lt(1e-6).sum()) for angle in (0, 72, 120, 144, 180)
    }
    assert counts == {0: 1, 72: 12, 120: 20, 144: 12, 180: 15}


def test_elements_within_an_angle_are_the_first_shell():
    assert len(icosahedron(1).elements_within(72)) == 13
    assert icosahedron(1).elements_within(10).tolist() == [0]


def test_standard_frame_is_generated_by_the_textbook_axes():
    from scipy.spatial.transform import Rotation

    def about(axis, angle_deg):
        axis = np.array(axis) / np.linalg.norm(axis)
        return Rotation.from_rotvec(np.radians(angle_deg) * axis).as_matrix()

    found = [np.eye(3)]
    generators = [about((0, 1, PHI), 72), about((1, 1, 1), 120)]
    for element in found:  # grows while it is walked through: the closure
        for generator in generators:
            new = generator @ element
            if min(np.abs(new - old).max() for old in found) > 1e-6:
                found.append(new)
    assert as_set(np.reshape(found, (-1, 9))) == as_set(
        icosahedron(1, "standard").rotations.reshape(-1, 9)
    )


def test_viewing_axis_is_fivefold_or_twofold():
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    for frame, order in (("conjugated", 5), ("standard", 2)):
        fixed = (icosahedron(1, frame).rotations @ up - up).norm(dim=-1) < 1e-9
        assert fixed.sum() == order


def test_frames_share_their_tables_and_differ_by_the_tilt():
    conjugated, standard = icosahedron(1), icosahedron(1, "standard")
    for name in ("vertices", "multiplication", "inverse", "action", "visible"):
        assert torch.equal(getattr(conjugated, name), getattr(standard, name))
    tilt = conjugated.tilt
    torch.testing.assert_close(standard.rotations, tilt.T @ conjugated.rotations @ tilt)
    untilted = standard.vertices @ tilt
    moved = torch.einsum("gij,vj->gvi", standard.rotations, untilted)
    torch.testing.assert_close(untilted[standard.action], moved, atol=1e-12, rtol=0)


def test_action_moves_vertices_and_is_a_homomorphism(mesh):
    moved = torch.einsum("gij,vj->gvi", mesh.rotations, mesh.vertices)
    torch.testing.assert_close(mesh.vertices[mesh.action], moved, atol=1e-12, rtol=0)
    everything = torch.arange(len(mesh.vertices))
    assert torch.equal(mesh.action.sort(dim=1).values, everything.expand(60, -1))
    for g in range(0, 60, 7):
        for h in range(60):
            assert torch.equal(
                mesh.action[mesh.multiplication[g, h]], mesh.action[g][mesh.action[h]]
            )


def test_orbits_are_12_30_and_two_free_ones():
    action = icosahedron(2).action
    orbits = {frozenset(action[:, j].tolist()) for j in range(162)}
    assert sorted(len(orbit) for orbit in orbits) == [12, 30, 60, 60]
    assert frozenset(range(12)) in orbits
    assert frozenset(range(12, 42)) in orbits


def test_elements_follow_the_documented_order():
    mesh = icosahedron(1)
    assert mesh.identity == 0
    keys = mesh.action[:, :2].tolist()
    assert keys == sorted(keys)
    for k in range(5):
        a = math.radians(72 * k)
        expected = [[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]]
        np.testing.assert_allclose(mesh.rotations[k], expected, atol=1e-12)


def test_turns_about_the_viewing_axis_permute_the_half_mesh(mesh):
    xy = mesh.visible_xy
    number = 5 if mesh.mesh_axis == "vertex" else 2
    assert len(mesh.visible_permutation) == number
    for k, permutation in enumerate(mesh.visible_permutation):
        a = 2 * math.pi * k / number
        rows = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
        turn = torch.tensor(rows, dtype=torch.float64)
        torch.testing.assert_close(xy[permutation], xy @ turn.T, atol=1e-12, rtol=0)


def test_only_turns_about_the_viewing_axis_keep_the_half_mesh(mesh):
    visible = set(mesh.visible.tolist())
    keep = [g for g in range(60) if set(mesh.action[g, mesh.visible].tolist()) == visible]
    assert keep == mesh.viewing_turns.tolist()
    assert keep == [g for g in range(60) if mesh.rotations[g, 2, 2] > 1 - 1e-9]
    if mesh.mesh_axis == "vertex":
        assert keep == [0, 1, 2, 3, 4]
    else:
        half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
        assert len(keep) == 2
        torch.testing.assert_close(mesh.rotations[keep[1]], half_turn)


@pytest.mark.parametrize("axis", AXES)
def test_marks_are_the_corners_of_a_football(axis):
    mesh = icosahedron(1, mesh_axis=axis)
    marks = mesh.marks
    first = (2 * mesh.vertices[0] + mesh.vertices[1]) / 3
    torch.testing.assert_close(marks, mesh.rotations @ first, atol=1e-12, rtol=0)
    # Every edge is cut into three equal parts: the nearest other mark is that far away.
    distance = (marks[:, None] - marks).norm(dim=-1)
    near = distance.sort(dim=1).values
    edge = 1.05146222 / 3
    torch.testing.assert_close(near[:, 1:4], torch.full((60, 3), edge).double())
    assert near[:, 4].min() > edge + 0.1
    assert torch.equal(icosahedron(1, "standard", mesh_axis=axis).marks, marks)


@pytest.mark.parametrize("axis", AXES)
def test_marks_of_the_first_shell_are_visible(axis):
    mesh = icosahedron(1, mesh_axis=axis)
    shell = mesh.marks[mesh.elements_within(72)]
    assert shell[:, 2].min() > 0.1
    assert shell[:, :2].norm(dim=-1).max() < 0.9


@pytest.mark.parametrize("frame", ["conjugated", "standard"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_nearest_element_and_residual_recompose(frame, dtype):
    rotations = icosahedron(1, frame).rotations.to(dtype)
    target = random_rotations(500, torch.Generator().manual_seed(1)).to(dtype)
    index, angle = nearest_element(target, rotations)
    every = torch.stack([geodesic_angle_rad(target, r) for r in rotations], dim=-1)
    torch.testing.assert_close(angle, every.min(dim=-1).values)
    assert index.dtype == torch.int64
    delta = residual(target, rotations[index])
    torch.testing.assert_close(compose(delta, rotations[index]), target, atol=1e-6, rtol=0)
    assert torch.rad2deg(geodesic_angle_rad(delta, torch.eye(3).to(dtype))).max() < 44.48 + 1e-2


def test_nearest_element_takes_any_batch_shape():
    rotations = icosahedron(1).rotations
    target = random_rotations(6, torch.Generator().manual_seed(2))
    flat = nearest_element(target, rotations)
    shaped = nearest_element(target.reshape(2, 3, 3, 3), rotations)
    single = nearest_element(target[4], rotations)
    assert torch.equal(flat[0].reshape(2, 3), shaped[0])
    assert single[0] == flat[0][4]
    torch.testing.assert_close(shaped[1].flatten()[4], single[1])


def test_left_residual_is_a_scalar_on_the_group():
    """A turn of the camera by a group element moves the class and leaves the residual alone."""
    mesh = icosahedron(1)
    view = random_rotations(200, torch.Generator().manual_seed(3))
    index, _ = nearest_element(view, mesh.rotations)
    delta = residual(view, mesh.rotations[index])
    for q in (3, 17, 42):
        moved = view @ mesh.rotations[q].T
        index_moved, _ = nearest_element(moved, mesh.rotations)
        assert torch.equal(index_moved, mesh.multiplication[index, mesh.inverse[q]])
        torch.testing.assert_close(residual(moved, mesh.rotations[index_moved]), delta)


def test_nearest_element_statistics():
    target = random_rotations(60_000, torch.Generator().manual_seed(4))
    _, angle = nearest_element(target, icosahedron(1).rotations)
    degrees = torch.rad2deg(angle)
    # standard errors: 0.04° of the mean, about 0.05° of the median
    assert degrees.mean().item() == pytest.approx(29.5, abs=0.2)
    assert degrees.median().item() == pytest.approx(31.1, abs=0.25)
    assert 43.0 < degrees.max().item() <= 44.48


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((3,), "0, 1, 2"), ((-1,), "0, 1, 2"), ((1, "tilted"), "conjugated, standard")],
)
def test_wrong_arguments_name_the_right_ones(arguments, message):
    with pytest.raises(ValueError, match=message):
        icosahedron(*arguments)
    with pytest.raises(ValueError, match="vertex, twofold"):
        icosahedron(mesh_axis="face")


def test_it_is_built_once_and_says_what_it_is():
    assert icosahedron(1) is icosahedron(level=1, frame="conjugated")
    assert "V42, half mesh 16, I60 conjugated" in repr(icosahedron(1))
    assert "half mesh 17" in repr(icosahedron(1, mesh_axis="twofold"))
    assert "twofold axis" in repr(icosahedron(1, mesh_axis="twofold"))
