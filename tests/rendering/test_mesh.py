from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2i.errors import MeshError
from i2i.rendering import prepare_mesh

AXES = {
    "x": (1, 0, 0),
    "-x": (-1, 0, 0),
    "y": (0, 1, 0),
    "-y": (0, -1, 0),
    "z": (0, 0, 1),
    "-z": (0, 0, -1),
}


def odd_mesh() -> trimesh.Trimesh:
    post = trimesh.creation.box(extents=(0.2, 0.5, 3.0))
    post.apply_translation((1.0, -2.0, 5.0))
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=2), post])


@pytest.mark.parametrize("up_axis", AXES)
def test_named_axis_points_up(up_axis):
    mesh = prepare_mesh(odd_mesh(), up_axis=up_axis)
    turn = mesh.object_from_mesh[:3, :3]
    scale = np.cbrt(np.linalg.det(turn))
    assert scale > 0  # a mirror image would have a negative determinant
    np.testing.assert_allclose(turn @ turn.T, scale**2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn @ AXES[up_axis] / scale, [0, 0, 1], atol=1e-12)


def test_unknown_axis_is_refused_with_the_list():
    with pytest.raises(ValueError, match="-y, -z, x, y, z"):
        prepare_mesh(odd_mesh(), up_axis="up")


def test_normalisation_agrees_with_sampling_the_surface():
    mesh = prepare_mesh(odd_mesh())
    # Independent of our own area sum: the mean of points drawn evenly from the surface.
    points, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(mesh.vertices, mesh.faces), 200_000, seed=0
    )
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.01)
    assert np.percentile(np.linalg.norm(mesh.vertices, axis=1), 98) == pytest.approx(1)


def test_object_from_mesh_maps_the_file_to_the_object_frame():
    loaded = odd_mesh()
    mesh = prepare_mesh(loaded, up_axis="y")
    moved = trimesh.transform_points(loaded.vertices, mesh.object_from_mesh)
    distance = np.linalg.norm(moved[:, None] - mesh.vertices[None], axis=-1).min(axis=1)
    assert distance.max() < 1e-7


def test_invariant_to_scale_and_place_of_the_file():
    loaded = odd_mesh()
    far = loaded.copy()
    far.apply_scale(1e4)
    far.apply_translation((3e4, -1e4, 2e4))
    np.testing.assert_allclose(
        prepare_mesh(loaded).vertices[prepare_mesh(loaded).faces],
        prepare_mesh(far).vertices[prepare_mesh(far).faces],
        atol=1e-6,
    )


def test_scene_is_flattened_with_transforms_and_normalised():
    loaded = odd_mesh()
    ball, post = loaded.split(only_watertight=False)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", [0.3, 1.0, -0.4]).as_matrix()
    turn[:3, 3] = (4.0, 5.0, 6.0)
    scene = trimesh.Scene()
    scene.add_geometry(ball)
    moved = post.copy()
    moved.apply_transform(np.linalg.inv(turn))
    scene.add_geometry(moved, transform=turn)
    whole, parts = prepare_mesh(loaded), prepare_mesh(scene)
    corners = [np.sort(m.vertices[m.faces].reshape(-1, 9), axis=0) for m in (whole, parts)]
    np.testing.assert_allclose(corners[0], corners[1], atol=1e-6)


def test_split_vertices_do_not_change_the_scale():
    loaded = odd_mesh()
    torn = trimesh.Trimesh(loaded.triangles.reshape(-1, 3), process=False)
    torn.faces = np.arange(len(torn.vertices)).reshape(-1, 3)
    whole, split = prepare_mesh(loaded), prepare_mesh(torn)
    assert len(split.vertices) == len(whole.vertices)
    np.testing.assert_allclose(split.vertices[split.faces], whole.vertices[whole.faces], atol=1e-9)


def test_mixed_winding_does_not_move_the_centre():
    loaded = odd_mesh()
    flipped = loaded.copy()
    flipped.faces[::2] = flipped.faces[::2, ::-1]
    np.testing.assert_allclose(
        np.sort(prepare_mesh(loaded).vertices, axis=0),
        np.sort(prepare_mesh(flipped).vertices, axis=0),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("loaded", "reason"),
    [
        (trimesh.Trimesh(), "no faces"),
        (trimesh.Scene(), "no faces"),
        (trimesh.Trimesh(vertices=np.eye(3)), "no faces"),
        (trimesh.PointCloud(np.eye(3)), "no triangle mesh"),
        (trimesh.Trimesh([[0, 0, 0]] * 3, [[0, 1, 2]], process=False), "area"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False), "area"),
        (
            trimesh.Trimesh([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], [[0, 1, 2]], process=False),
            "1 of 3 vertices are not finite.*number 1",
        ),
        (
            trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.inf, 0]], [[0, 1, 2]], process=False),
            "not finite",
        ),
        (
            trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 7]], process=False),
            "vertex 7.*3 vertices",
        ),
    ],
)
def test_broken_meshes_say_why(loaded, reason):
    with pytest.raises(MeshError, match=reason):
        prepare_mesh(loaded)


def test_flat_faces_are_dropped():
    box = trimesh.creation.box()
    broken = trimesh.Trimesh(
        box.vertices, np.concatenate([box.faces, [[0, 0, 1], [2, 2, 2]]]), process=False
    )
    assert len(prepare_mesh(broken).faces) == 12
