from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2i.geometry.cameras import Camera
from i2i.rendering import RenderMesh
from i2i.rendering.embree import EmbreeRenderer
from i2i.rendering.shading import GRAY_LIGHT, display_value, reflected_light


def plain(loaded: trimesh.Trimesh) -> RenderMesh:
    """A mesh as it is, without normalisation."""
    faces = np.asarray(loaded.faces, dtype=np.int64)
    return RenderMesh(
        vertices=np.asarray(loaded.vertices, dtype=np.float64),
        faces=faces,
        face_material=np.zeros(len(faces), dtype=np.int64),
    )


def sphere_depth(camera: Camera, image_size: int, radius: float = 1.0) -> np.ndarray:
    """Ray length to a sphere at the origin in closed form; 0 where the ray misses."""
    along = -camera.distance * camera.rays(image_size)[..., 2]
    inside = radius**2 - (camera.distance**2 - along**2)
    return np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)


@pytest.fixture(scope="module")
def sphere():
    return plain(trimesh.creation.icosphere(subdivisions=5))


@pytest.mark.parametrize("camera", [Camera(), Camera(distance=5.0, fov_deg=30.0)])
def test_depth_of_a_sphere_in_closed_form(embree, sphere, rotations, camera):
    depth = embree.depth(sphere, rotations, camera=camera, image_size=96)
    expected = sphere_depth(camera, 96)
    assert depth.dtype == np.float32
    assert depth.shape == (len(rotations), 96, 96)
    both = (depth > 0) & (expected > 0)
    assert ((depth > 0) != (expected > 0)).mean() < 2e-3
    assert np.median(np.abs(depth - expected)[both]) < 5e-4
    assert np.percentile(np.abs(depth - expected)[both], 99) < 5e-3


def test_depth_picture_of_a_sphere(embree, sphere):
    picture = embree.render(sphere, np.eye(3)[None], modality="depth", image_size=129)[0, 0]
    assert picture[64, 64] == 255  # nearest: 2.2 from the camera
    assert picture[0, 0] == 255  # background
    row = picture[64].astype(int)
    hit = embree.depth(sphere, np.eye(3)[None], image_size=129)[0, 64] > 0
    expected = np.rint((4.2 - sphere_depth(Camera(), 129)[64]) / 2 * 255)
    assert np.abs(row - expected)[hit][2:-2].max() <= 1


def test_gray_of_a_sphere_in_closed_form(embree, sphere):
    camera = Camera()
    picture = embree.render(sphere, np.eye(3)[None])[0, 0]
    depth = sphere_depth(camera, 128)
    points = depth[..., None] * camera.rays(128) + [0, 0, camera.distance]
    cosine = -(points * camera.rays(128)).sum(axis=-1)  # a unit sphere's points are its normals
    safe = depth > 0
    safe[1:-1, 1:-1] &= safe[2:, 1:-1] & safe[:-2, 1:-1] & safe[1:-1, 2:] & safe[1:-1, :-2]
    light = reflected_light(
        cosine[safe].astype(np.float32),
        depth[safe].astype(np.float32),
        albedo=1.0,
        intensity=GRAY_LIGHT,
    )
    assert np.abs(picture[safe] - display_value(light)).mean() < 2


def test_axes_of_the_picture(embree):
    """x_camera = rotation @ x_object, row down, column right."""
    tetra = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    tetra.apply_translation((0.0, 0.0, 0.9))
    mesh = plain(tetra)
    for angles, where in (
        (("x", -90), (0, 1)),  # object z to camera y: up
        (("x", 90), (0, -1)),
        (("y", 90), (1, 0)),  # object z to camera x: right
        (("y", -90), (-1, 0)),
    ):
        rotation = Rotation.from_euler(angles[0], angles[1], degrees=True).as_matrix()
        hit = np.argwhere(embree.depth(mesh, rotation[None])[0] > 0).mean(axis=0)
        centre = 63.5
        expected = 0.9 / (3.2 * np.tan(np.radians(22.5))) * 64
        np.testing.assert_allclose(
            [hit[1] - centre, centre - hit[0]], np.multiply(where, expected), atol=0.7
        )


def test_rendering_at_once_or_one_by_one_is_the_same(embree, wedge, rotations):
    whole = embree.render(wedge, rotations)
    single = EmbreeRenderer()
    for index in (2, 0, 3, 1):
        np.testing.assert_array_equal(
            single.render(wedge, rotations[index : index + 1])[0], whole[index]
        )


def test_change_of_mesh_camera_and_size_is_noticed(embree, wedge, sphere, rotations):
    first = embree.render(wedge, rotations)
    embree.render(sphere, rotations, image_size=64, camera=Camera(distance=4.0))
    np.testing.assert_array_equal(embree.render(wedge, rotations), first)


@pytest.mark.parametrize("image_size", [24, 64, 128])
def test_pictures_do_not_depend_on_how_many_are_drawn_together(
    wedge, rotations, monkeypatch, image_size
):
    settings = [(modality, image_size) for modality in ("gray", "depth", "rgb")]
    together = [
        EmbreeRenderer().render(wedge, rotations, modality=m, image_size=s) for m, s in settings
    ]
    monkeypatch.setattr("i2i.rendering.embree._PIXELS_AT_ONCE", 1)
    for (modality, size), expected in zip(settings, together, strict=True):
        alone = EmbreeRenderer().render(wedge, rotations, modality=modality, image_size=size)
        np.testing.assert_array_equal(alone, expected)


def test_antialiasing_only_touches_edges(wedge, rotations):
    smooth = EmbreeRenderer().render(wedge, rotations)[:, 0].astype(int)
    hard = EmbreeRenderer(antialias=False).render(wedge, rotations)[:, 0].astype(int)
    changed = smooth != hard
    assert 0 < changed.mean() < 0.1
    coverage = EmbreeRenderer(antialias=False).render(wedge, rotations, image_size=512)
    fine = coverage[:, 0].reshape(-1, 128, 4, 128, 4).mean(axis=(2, 4))
    assert np.abs(smooth - fine)[changed].mean() < 0.6 * np.abs(hard - fine)[changed].mean()


def test_version_names_what_makes_the_pixels():
    assert "embreex" in EmbreeRenderer().version
    assert EmbreeRenderer().version != EmbreeRenderer(antialias=False).version
