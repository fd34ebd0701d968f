from __future__ import annotations

import numpy as np

from i2i.geometry.cameras import Camera
from i2i.rendering.raygrid import SAMPLE_OFFSETS, RayGrid, edge_pixels


def test_samples_lie_around_the_pixel_centre():
    camera = Camera()
    grid = RayGrid(camera, 32)
    pixel = np.array([0, 5, 500, 1023])
    directions = np.moveaxis(grid.samples(pixel), 0, -1)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    on_plane = directions[..., :2] / -directions[..., 2:]
    centre = camera.rays(32).reshape(-1, 3)[pixel]
    np.testing.assert_allclose(on_plane.mean(axis=1), centre[:, :2] / -centre[:, 2:], atol=1e-12)
    half_pixel = 0.5 * 2 * np.tan(np.radians(22.5)) / 32
    assert np.abs(on_plane - on_plane.mean(axis=1, keepdims=True)).max() < half_pixel


def test_sample_pattern_survives_a_quarter_turn():
    turned = {(-y, x) for x, y in SAMPLE_OFFSETS}
    assert turned == set(SAMPLE_OFFSETS)


def test_edges_are_marked_on_both_sides():
    pictures = np.zeros((1, 1, 5, 5), np.float32)
    pictures[0, 0, 1, 2] = 100
    marked = np.zeros((5, 5), bool)
    marked.reshape(-1)[edge_pixels(pictures, 25.0)] = True
    expected = np.zeros((5, 5), bool)
    expected[[0, 1, 2, 1, 1], [2, 2, 2, 1, 3]] = True
    np.testing.assert_array_equal(marked, expected)


def test_edges_of_many_pictures_are_those_of_each_in_any_channel():
    """Against the plain comparison of neighbours; also at the borders, where there is no edge."""
    pictures = np.random.default_rng(0).choice([0.0, 20.0, 40.0], (3, 4, 6, 6), p=[0.8, 0.1, 0.1])
    expected = np.zeros((4, 6, 6), bool)
    for index in np.ndindex(4, 6, 6):
        number, row, column = index
        for down, right in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            near = (row + down, column + right)
            if min(near) >= 0 and max(near) < 6:
                step = pictures[:, number, *near] - pictures[:, number, row, column]
                expected[index] |= np.abs(step).max() > 25.0
    edge = edge_pixels(pictures.astype(np.float32), 25.0)
    np.testing.assert_array_equal(edge, np.flatnonzero(expected))
