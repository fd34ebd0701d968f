"""The built-in objects: same key, same mesh; real variation; the symmetries that are claimed."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from i2i.data.sources.synthetic import SyntheticSource, solids
from i2i.data.sources.synthetic import primitives as shapes
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.source import MAKERS
from i2i.errors import MeshError

CLASSES = (
    *("airplane", "bench", "bottle", "car", "chair", "desk"),
    *("guitar", "sofa", "stool", "table", "toilet"),
)
WITHOUT_SYMMETRY = tuple(name for name in CLASSES if name not in ("bottle", "stool", "table"))
COUNT = 50


@pytest.fixture(scope="module")
def meshes():
    """The first fifty objects of every class."""
    source = SyntheticSource(instances_per_class=COUNT, test_instances_per_class=0)
    return {name: [source.load(item) for item in source.items([name])] for name in CLASSES}


def turned(points, angle_deg):
    angle = np.radians(angle_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]).T


def centred(mesh):
    """Vertices about the area-weighted centroid, over the 98th percentile of their norms."""
    area = mesh.area_faces
    vertices = mesh.vertices - (mesh.triangles_center * area[:, None]).sum(0) / area.sum()
    return vertices / np.percentile(np.linalg.norm(vertices, axis=1), 98)


def largest_gap(points, others):
    """Hausdorff distance of two sets of points."""
    return max(cKDTree(points).query(others)[0].max(), cKDTree(others).query(points)[0].max())


def chamfer_ratio(mesh, angle_deg, count=5000):
    """Chamfer distance of the surface to itself turned about z, over that of two samples of it.

    It is 1, up to noise, if the turn is a symmetry.
    """
    surface = trimesh.Trimesh(centred(mesh), mesh.faces, process=False)
    one, two = (trimesh.sample.sample_surface(surface, count, seed=seed)[0] for seed in (1, 2))

    def chamfer(a, b):
        return cKDTree(a).query(b)[0].mean() + cKDTree(b).query(a)[0].mean()

    return chamfer(one, turned(two, angle_deg)) / chamfer(one, two)


# === the source ===


def test_classes_and_symmetry():
    source = SyntheticSource()
    assert source.classes == CLASSES
    assert {name for name, kind in source.symmetry.items() if kind == "z"} == {"bottle", "stool"}
    assert {name for name, kind in source.symmetry.items() if kind == "z2"} == {"table"}
    assert set(source.symmetry.values()) == {"none", "z", "z2"}
    assert SyntheticSource(symmetry="none").symmetry["table"] == "none"
    assert (source.name, source.up_axis) == ("synthetic", "z")
    assert "MIT" in source.licence


def test_items_have_the_official_split_and_can_be_sent_to_workers():
    items = SyntheticSource(instances_per_class=3, test_instances_per_class=2).items(
        ["desk", "car"]
    )
    assert [item.class_name for item in items] == ["desk"] * 5 + ["car"] * 5
    assert [item.split for item in items[:5]] == ["train"] * 3 + ["test"] * 2
    assert [item.instance_id for item in items[:2]] == ["desk_0000", "desk_0001"]
    assert len({item.group for item in items}) == 10
    assert pickle.loads(pickle.dumps(items)) == items


def test_errors_say_what_is_allowed():
    with pytest.raises(ValueError, match="airplane"):
        SyntheticSource().items(["spaceship"])
    with pytest.raises(ValueError, match="airplane"):
        SyntheticSource(classes=["spaceship"])
    with pytest.raises(ValueError, match="car"):
        SyntheticSource(classes=["car"]).items(["desk"])
    with pytest.raises(ValueError, match="instances_per_class"):
        SyntheticSource(instances_per_class=0, test_instances_per_class=0)
    item = SyntheticSource().items(["car"])[0]
    for ref in ("car", "car:one:0", "spaceship:1:0"):
        with pytest.raises(MeshError, match="class:index:seed"):
            SyntheticSource().load(type(item)("car", "car_0000", "train", "car_0000", ref))


# === determinism and variation ===


@pytest.mark.parametrize("name", CLASSES)
def test_a_mesh_is_a_function_of_its_key(name, meshes):
    source = SyntheticSource(instances_per_class=1, test_instances_per_class=COUNT - 1)
    item = source.items([name])[7]  # another split of the same instances
    again = source.load(item)
    np.testing.assert_array_equal(again.vertices, meshes[name][7].vertices)
    np.testing.assert_array_equal(again.faces, meshes[name][7].faces)
    np.testing.assert_array_equal(again.visual.face_colors, meshes[name][7].visual.face_colors)
    other = SyntheticSource(seed=1).load(SyntheticSource(seed=1).items([name])[7])
    assert other.vertices.shape != again.vertices.shape or not np.allclose(
        other.vertices, again.vertices, atol=1e-3
    )


def test_another_process_makes_the_same_mesh(meshes):
    code = (
        "from i2i.data.sources.synthetic import SyntheticSource as S;"
        "s = S(); print(s.load(s.items(['chair'])[3]).vertices.sum().hex())"
    )
    path = [entry for entry in sys.path if entry]
    answer = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {path!r}; {code}"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert answer.stdout.strip() == meshes["chair"][3].vertices.sum().hex()


@pytest.mark.parametrize("name", CLASSES)
def test_no_two_objects_are_alike(name, meshes):
    # Shape without size: distances of sorted, normalised vertices from the centroid, by quantile.
    steps = np.linspace(0, 1, 41)
    shape = np.stack(
        [np.quantile(np.abs(centred(mesh)), steps, axis=0).ravel() for mesh in meshes[name]]
    )
    distance = np.abs(shape[:, None] - shape[None]).max(axis=2)
    assert distance[~np.eye(COUNT, dtype=bool)].min() > 0.002
    assert np.median(distance) > 0.05
    assert len({mesh.visual.face_colors.tobytes() for mesh in meshes[name]}) > 0.9 * COUNT


def test_draws_are_uniform_and_independent():
    first = np.array([Draws("chair", index, seed=0).uniform(0, 1) for index in range(2000)])
    assert abs(first.mean() - 0.5) < 0.03
    assert abs(first.var() - 1 / 12) < 0.01
    assert abs(np.corrcoef(first[:-1], first[1:])[0, 1]) < 0.08
    draws = Draws("chair", 0, seed=0)
    picks = [draws.choice(("a", "b", "c"), (0.7, 0.3, 0.0)) for _ in range(2000)]
    assert "c" not in picks
    assert abs(picks.count("a") / 2000 - 0.7) < 0.05
    assert {draws.integer(1, 3) for _ in range(100)} == {1, 2, 3}


# === sane meshes ===


@pytest.mark.parametrize("name", CLASSES)
def test_meshes_are_sane(name, meshes):
    for mesh in meshes[name]:
        assert 200 <= len(mesh.faces) <= 6000
        assert np.isfinite(mesh.vertices).all()
        vertices = centred(mesh)
        assert trimesh.triangles.area(vertices[mesh.faces]).min() > 1e-9
        # The camera sees a radius of 1.22 at the distance of 3.2 with 45° (3.2 sin 22.5°).
        assert np.linalg.norm(vertices, axis=1).max() < 1.22
        assert (mesh.extents > 0.03).all()
        assert np.abs(mesh.vertices).max() < 6.0
        assert (mesh.visual.face_colors[:, 3] == 255).all()


@pytest.mark.parametrize("name", CLASSES)
def test_every_part_is_closed_and_wound_outwards(name):
    for index in range(8):
        for part, colors in MAKERS[name](Draws(name, index, seed=0)).parts():
            surface = trimesh.Trimesh(part.vertices, part.faces, process=False)
            assert surface.is_watertight
            assert surface.volume > 0
            assert colors.shape == (len(part.faces), 3)


@pytest.mark.parametrize("name", ["chair", "bench", "sofa", "toilet"])
def test_the_front_is_at_minus_y(name, meshes):
    """Backs and tanks are at the rear, so the upper part of an object lies behind its middle."""
    for mesh in meshes[name]:
        high = mesh.triangles_center[:, 2] > mesh.bounds[0, 2] + 0.75 * mesh.extents[2]
        centre, area = mesh.triangles_center[:, 1], mesh.area_faces
        rear = (centre * area)[high].sum() / area[high].sum()
        assert rear > (centre * area).sum() / area.sum()


# === symmetries ===


@pytest.mark.parametrize("steps", [1, 5, 18])
def test_bottles_are_surfaces_of_revolution(steps, meshes):
    for mesh in meshes["bottle"]:
        assert largest_gap(mesh.vertices, turned(mesh.vertices, 10.0 * steps)) < 1e-12
        radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
        assert largest_gap(mesh.vertices, turned(mesh.vertices, 5.0)) > 0.05 * radius.max()


def test_stools_repeat_with_their_legs_and_have_round_seats(meshes):
    folds = (3, 4, 5, 8)
    found = set()
    for mesh in meshes["stool"]:
        exact = [
            n for n in folds if largest_gap(mesh.vertices, turned(mesh.vertices, 360 / n)) < 1e-9
        ]
        assert exact
        found.add(exact[0])
        # Only the legs tell turns apart: the top reaches its largest radius all around.
        top = mesh.vertices[mesh.vertices[:, 2] > mesh.bounds[1, 2] - 0.03]
        angle = np.degrees(np.arctan2(top[:, 1], top[:, 0]))
        rim = np.linalg.norm(top[:, :2], axis=1) > 0.9 * np.linalg.norm(top[:, :2], axis=1).max()
        assert np.diff(np.sort(angle[rim])).max() < 16.0
    assert found >= {3, 4, 5}


def test_tables_are_exactly_twofold_and_no_more(meshes):
    for mesh in meshes["table"]:
        colors = mesh.visual.face_colors[:, :3] / 255.0
        here = np.column_stack([mesh.triangles_center, colors])
        there = np.column_stack([turned(mesh.triangles_center, 180.0), colors])
        assert largest_gap(here, there) < 1e-12
        assert mesh.extents[0] > 1.2 * mesh.extents[1]
        assert largest_gap(mesh.vertices, turned(mesh.vertices, 90.0)) > 0.1


@pytest.mark.parametrize("name", WITHOUT_SYMMETRY)
def test_no_other_class_has_a_rotation_symmetry(name, meshes):
    ratios = [chamfer_ratio(mesh, angle) for mesh in meshes[name][:8] for angle in (90.0, 180.0)]
    assert min(ratios) > 1.35


def test_the_measure_of_symmetry_finds_the_symmetric_ones(meshes):
    for name, angle in (("table", 180.0), ("bottle", 180.0), ("bottle", 90.0)):
        ratios = [chamfer_ratio(mesh, angle) for mesh in meshes[name][:8]]
        assert max(ratios) < 1.1


def test_left_differs_from_right_where_it_really_does(meshes):
    def differs(mesh):
        return largest_gap(mesh.vertices, mesh.vertices * np.array([-1.0, 1.0, 1.0])) > 0.03

    assert all(differs(mesh) for mesh in meshes["desk"])
    # Some acoustic guitars have neither cutaway nor pickguard, some sofas no chaise; airplanes are
    # mirror-symmetric but for their propellers.
    assert 0.5 * COUNT < sum(differs(mesh) for mesh in meshes["guitar"]) < COUNT
    assert 0 < sum(differs(mesh) for mesh in meshes["sofa"]) < COUNT
    assert sum(differs(mesh) for mesh in meshes["airplane"]) < 0.6 * COUNT


# === primitives, against closed forms ===


def test_volumes_of_primitives():
    segments = 360
    disc = 0.5 * segments * np.sin(2 * np.pi / segments)  # area of the polygon in the unit circle
    rod = shapes.rod((0, 0, 0), (0, 0, 2), 0.5, segments=segments)
    assert shapes.signed_volume(rod) == pytest.approx(2 * 0.25 * disc)
    cone = shapes.lathe([(0, 0), (1, 0), (0, 3)], segments=segments)
    assert shapes.signed_volume(cone) == pytest.approx(disc)
    assert shapes.signed_volume(solids.box((1, 2, 3), radius=1e-9)) == pytest.approx(6.0)
    assert shapes.signed_volume(solids.ball(1.0, steps=40)) == pytest.approx(
        4 * np.pi / 3, rel=5e-3
    )
    hoop = solids.ring(
        np.column_stack([2 * shapes.circle(200), np.zeros(200)]), shapes.circle(200) * 0.5
    )
    assert shapes.signed_volume(hoop) == pytest.approx(2 * np.pi**2 * 2 * 0.25, rel=1e-3)
    grid = np.stack([*np.meshgrid([0, 1, 2], [0, 1], indexing="ij"), np.zeros((3, 2))], axis=-1)
    assert shapes.signed_volume(shapes.slab(grid, 0.1)) == pytest.approx(0.2)
    plate = shapes.plate(shapes.superellipse(1, 2, power=2.0, segments=segments), 0, 0.5)
    assert shapes.signed_volume(plate) == pytest.approx(0.5 * 2 * np.pi, rel=1e-3)


def test_turns_and_mirrors_of_parts():
    part = solids.box((1, 2, 3), (4, 5, 6))
    np.testing.assert_allclose(part.rotated("z", 90).vertices.mean(0), (-5, 4, 6))
    np.testing.assert_allclose(part.rotated("x", 90).vertices.mean(0), (4, -6, 5))
    np.testing.assert_allclose(part.rotated("y", 90).vertices.mean(0), (6, 5, -4))
    np.testing.assert_allclose(
        part.half_turned().vertices, part.rotated("z", 180).vertices, atol=1e-12
    )
    assert shapes.signed_volume(part.mirrored("y")) == pytest.approx(shapes.signed_volume(part))


def test_spline_goes_through_its_points():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]])  # chords of equal length
    np.testing.assert_allclose(shapes.spline(points, 4), points, atol=1e-12)
    line = shapes.spline(points[:2], 5)
    np.testing.assert_allclose(line[:, 0], np.linspace(0, 1, 5))
