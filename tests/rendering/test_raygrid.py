from __future__ import annotations

import numpy as np
import pytest

from i2i.geometry.cameras import Camera
from i2i.rendering.raygrid import SAMPLE_OFFSETS, RayGrid, edge_pixels


def test_samples_lie_around_the_pixel_centre():
    camera = Camera()
    grid = RayGrid(camera, 32, 1.0)
    pixel = np.array([0, 5, 500, 1023])
    directions = grid.samples(pixel)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    on_plane = directions[..., :2] / -directions[..., 2:]
    centre = camera.rays(32).reshape(-1, 3)[pixel]
    np.testing.assert_allclose(on_plane.mean(axis=1), centre[:, :2] / -centre[:, 2:], atol=1e-12)
    half_pixel = 0.5 * 2 * np.tan(np.radians(22.5)) / 32
    assert np.abs(on_plane - on_plane.mean(axis=1, keepdims=True)).max() < half_pixel


def test_sample_pattern_survives_a_quarter_turn():
    turned = {(-y, x) for x, y in SAMPLE_OFFSETS}
    assert turned == set(SAMPLE_OFFSETS)


def test_sphere_culling_keeps_every_ray_that_meets_it():
    camera = Camera()
    grid = RayGrid(camera, 64, 0.8)
    behind = np.array([[0.0, 0, 1.0]])  # switches the box off
    directions = camera.rays(64).reshape(-1, 3)
    closest = np.linalg.norm(np.cross(directions, [0, 0, camera.distance]), axis=1)
    np.testing.assert_array_equal(grid.around(behind), np.flatnonzero(closest <= 0.8 * 1.001))


def test_box_is_tight():
    grid = RayGrid(Camera(), 64, 1.0)
    points = np.array([[0.1, 0.2, -3.0], [0.3, 0.5, -3.0]])
    rows, columns = np.divmod(grid.around(points), 64)
    scale = 32 / np.tan(np.radians(22.5)) / 3
    assert columns.min() == pytest.approx(31.5 + 0.1 * scale, abs=1.1)
    assert columns.max() == pytest.approx(31.5 + 0.3 * scale, abs=1.1)
    assert rows.min() == pytest.approx(31.5 - 0.5 * scale, abs=1.1)
    assert rows.max() == pytest.approx(31.5 - 0.2 * scale, abs=1.1)


def test_nothing_in_view_gives_no_rays():
    grid = RayGrid(Camera(), 64, 1.0)
    assert len(grid.around(np.array([[50.0, 0, -1.0]]))) == 0


def test_edges_are_marked_on_both_sides():
    picture = np.zeros((1, 4, 5), np.float32)
    picture[0, 1, 2] = 100
    marked = np.zeros((4, 5), bool)
    marked.reshape(-1)[edge_pixels(picture, 25.0)] = True
    expected = np.zeros((4, 5), bool)
    expected[[0, 1, 2, 1, 1], [2, 2, 2, 1, 3]] = True
    np.testing.assert_array_equal(marked, expected)
