from __future__ import annotations

import numpy as np
import pytest
import trimesh

from i2i.geometry.cameras import Camera
from i2i.rendering import RenderMesh
from i2i.rendering.culling import Culling, covering_balls
from i2i.rendering.embree import EmbreeRenderer
from i2i.rendering.raygrid import RayGrid


def with_triangle(mesh: RenderMesh, corners: list[list[float]]) -> RenderMesh:
    """The mesh and one more face."""
    return RenderMesh(
        vertices=np.concatenate([mesh.vertices, np.array(corners, dtype=np.float64)]),
        faces=np.concatenate([mesh.faces, len(mesh.vertices) + np.arange(3)[None]]),
        face_material=np.zeros(len(mesh.faces) + 1, dtype=np.int64),
    )


SPIKES = {
    "none": None,
    "out of the picture": [[0, 0, 2.5], [0.1, 0, 2.5], [0, 0.1, 0.2]],
    "behind the camera": [[0, 0, 5.0], [0.1, 0, 5.0], [0, 0.1, 0.2]],
    "far out": [[0, 0, 1e4], [0.1, 0, 1e4], [0, 0.1, 0.2]],
}


@pytest.mark.parametrize("spike", SPIKES)
@pytest.mark.parametrize("camera", [Camera(), Camera(distance=2.0, fov_deg=80.0)])
def test_no_ray_that_meets_the_object_is_left_out(wedge, rotations, monkeypatch, spike, camera):
    """Against casting every ray of the picture."""
    mesh = wedge if SPIKES[spike] is None else with_triangle(wedge, SPIKES[spike])
    culled = EmbreeRenderer().depth(mesh, rotations, camera=camera)
    monkeypatch.setattr(Culling, "pixels", lambda self, views: np.arange(len(views) * 128**2))
    everything = EmbreeRenderer().depth(mesh, rotations, camera=camera)
    np.testing.assert_array_equal(culled, everything)
    assert (everything > 0).any()


def test_most_of_the_rays_that_miss_are_left_out(wedge, rotations):
    hits = (EmbreeRenderer().depth(wedge, rotations) > 0).sum()
    rays = len(Culling(wedge, RayGrid(Camera(), 128)).pixels(rotations))
    assert hits <= rays < 0.6 * len(rotations) * 128**2
    assert rays < 2 * hits


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_balls_hold_the_surface(wedge, scale):
    vertices = wedge.vertices * scale
    mesh = RenderMesh(vertices=vertices, faces=wedge.faces, face_material=wedge.face_material)
    centers, radius = covering_balls(mesh)
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, wedge.faces), 500, seed=0)
    points = np.concatenate([points, vertices])
    nearest = np.linalg.norm(points[:, None] - centers, axis=-1).min(axis=1)
    assert nearest.max() <= radius


def test_nothing_in_view_gives_no_rays(wedge):
    mesh = RenderMesh(
        vertices=wedge.vertices + np.array([50.0, 0.0, 0.0]),
        faces=wedge.faces,
        face_material=wedge.face_material,
    )
    culling = Culling(mesh, RayGrid(Camera(), 64))
    assert len(culling.pixels(np.eye(3)[None])) == 0
    assert (EmbreeRenderer().render(mesh, np.eye(3)[None], image_size=64) == 255).all()


def test_every_point_of_a_ball_is_in_a_marked_pixel(wedge, rotations):
    camera, size = Camera(distance=2.0, fov_deg=80.0), 128
    culling = Culling(wedge, RayGrid(camera, size))
    centers, radius = covering_balls(wedge)
    rng = np.random.default_rng(0)
    offset = rng.normal(size=(20, *centers.shape))
    points = centers + radius * offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    points = points[np.linalg.norm(points, axis=-1) < wedge.bounding_radius]
    for rotation in rotations:
        marked = np.zeros(size * size, dtype=bool)
        marked[culling.pixels(rotation[None])] = True
        x, y, z = (points @ rotation.T - [0, 0, camera.distance]).T
        scale = size / 2 / np.tan(np.radians(camera.fov_deg / 2))
        column, row = np.rint(63.5 - scale * x / z), np.rint(63.5 + scale * y / z)
        # Only a ray through the pixel's centre counts: one that passes this very point.
        seen = (np.hypot(column - 63.5 + scale * x / z, row - 63.5 - scale * y / z) < 0.1) & (
            np.maximum(np.abs(column - 63.5), np.abs(row - 63.5)) < size / 2
        )
        assert seen.sum() > 100
        assert marked[(row[seen] * size + column[seen]).astype(int)].mean() > 0.999
