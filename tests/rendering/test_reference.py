from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from i2i.errors import MeshError
from i2i.rendering import decimate_mesh, load_mesh, prepare_mesh, save_mesh


@pytest.fixture
def painted():
    torus = trimesh.creation.torus(1.0, 0.35, major_sections=80, minor_sections=40)
    image = Image.fromarray(np.full((100, 200, 3), (200, 100, 50), dtype=np.uint8))
    uv = np.random.default_rng(0).random((len(torus.vertices), 2))
    torus.visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=image))
    return prepare_mesh(torus)


def test_decimated_mesh_is_small_and_near(painted):
    small = decimate_mesh(painted, max_faces=1500)
    assert 500 < len(small.faces) <= 1500
    assert len(np.unique(small.faces)) == len(small.vertices)
    assert small.corner_uv.shape == (len(small.faces), 3, 2)
    points = [
        trimesh.sample.sample_surface(trimesh.Trimesh(m.vertices, m.faces), count, seed=0)[0]
        for m, count in ((painted, 2000), (small, 50_000))
    ]
    distance, _ = cKDTree(points[1]).query(points[0])
    assert np.percentile(distance, 99) < 0.05


def test_decimated_mesh_has_the_same_silhouette(painted, embree, rotations):
    before = embree.depth(painted, rotations) > 0
    after = embree.depth(decimate_mesh(painted), rotations) > 0
    assert (before & after).sum() / (before | after).sum() > 0.96


def test_small_mesh_is_left_alone(painted):
    assert decimate_mesh(painted, max_faces=10_000) is painted


def test_bound_that_cannot_be_met_by_clustering_still_holds():
    # A plate of separate triangles: every grid keeps either too many of them or none.
    plate = trimesh.creation.box((1, 1, 0.01)).subdivide_to_size(0.05)
    small = decimate_mesh(prepare_mesh(plate), max_faces=6)
    assert 1 <= len(small.faces) <= 6


def test_absurd_bound_is_refused(painted):
    with pytest.raises(ValueError, match="at least 4"):
        decimate_mesh(painted, max_faces=0)


def test_save_and_load(painted, tmp_path, embree, rotations):
    small = decimate_mesh(painted)
    path = save_mesh(small, tmp_path / "meshes" / "torus")
    assert path == tmp_path / "meshes" / "torus.npz"
    loaded = load_mesh(path)
    for name in ("vertices", "faces", "face_material", "corner_uv", "object_from_mesh"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(small, name))
    assert loaded.corner_color is None
    assert loaded.materials[0].texture.shape == (32, 64, 3)
    assert (loaded.materials[0].texture == (200, 100, 50)).all()
    np.testing.assert_array_equal(
        embree.render(loaded, rotations, modality="gray"),
        embree.render(small, rotations, modality="gray"),
    )


@pytest.mark.parametrize("content", [None, b"", b"not a mesh", "cut"])
def test_broken_files_say_so(content, painted, tmp_path):
    path = tmp_path / "broken.npz"
    if content == "cut":
        whole = save_mesh(painted, tmp_path / "whole.npz").read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshError, match=r"broken\.npz"):
        load_mesh(path)
