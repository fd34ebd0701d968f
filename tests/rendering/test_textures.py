from __future__ import annotations

import numpy as np
import pytest

from i2i.rendering.textures import TexturePyramid, texel_density


@pytest.fixture
def texture():
    return np.random.default_rng(0).integers(0, 256, (4, 8, 3), dtype=np.uint8)


def test_texel_centres_give_the_texels(texture):
    pyramid = TexturePyramid(texture)
    row, column = np.mgrid[0:4, 0:8]
    uv = np.stack([(column + 0.5) / 8, 1 - (row + 0.5) / 4], axis=-1).reshape(-1, 2)
    for shift in (0, 3, -2):  # repeats in both directions
        got = pyramid.sample(uv + shift, np.ones(32))
        np.testing.assert_allclose(got * 255, texture.reshape(-1, 3), atol=1e-3)


def test_between_texels_is_their_mean(texture):
    uv = np.array([[2 / 8, 1 - 0.5 / 4], [1.0, 1 - 1.5 / 4]])
    got = TexturePyramid(texture).sample(uv, np.ones(2)) * 255
    np.testing.assert_allclose(got[0], texture[0, 1:3].astype(float).mean(axis=0), atol=1e-3)
    wrapped = texture[1, [7, 0]].astype(float).mean(axis=0)
    np.testing.assert_allclose(got[1], wrapped, atol=1e-3)


def test_a_pixel_wider_than_texels_sees_their_mean(texture):
    uv = np.array([[1 / 8, 1 - 1 / 4]])
    got = TexturePyramid(texture).sample(uv, np.array([2.0])) * 255
    np.testing.assert_allclose(got[0], texture[:2, :2].reshape(-1, 3).mean(axis=0), atol=1e-3)


def test_coarsest_level_is_the_limit(texture):
    got = TexturePyramid(texture).sample(np.array([[0.3, 0.3]]), np.array([1e9]))
    assert np.isfinite(got).all()


def test_texel_density_of_a_stretched_quad():
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [2, 8, 0]])
    uv = np.array([[[0.0, 0], [1, 0], [1, 1]]])
    assert texel_density(uv, vertices, np.array([[0, 1, 2]]))[0] == pytest.approx(0.25)
