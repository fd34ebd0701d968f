"""Pictures of what a network saw."""

import numpy as np
import pytest
import torch

from i2i.viz.inputs import cloud_picture, input_pictures, tiled


def test_images_are_shown_as_they_are():
    image = torch.rand(2, 3, 8, 8)
    np.testing.assert_array_equal(input_pictures({"image": image}), image.numpy())


def test_a_cloud_is_seen_from_the_front_with_x_right_and_y_up():
    corner = cloud_picture(np.array([[0.8, 0.8, 0.0], [-0.8, 0.8, 0.0], [0.8, -0.8, 0.5]]))[0]
    half = corner.shape[0] // 2
    dark = corner < 1
    assert dark[:half, half:].any()
    assert dark[:half, :half].any()
    assert dark[half:, half:].any()
    assert not dark[half:, :half].any()


def test_near_points_hide_far_ones_and_are_darker():
    near, far = [0.0, 0.0, 0.9], [0.0, 0.0, -0.9]
    for order in ([near, far], [far, near]):
        both = cloud_picture(np.array(order))
        np.testing.assert_array_equal(both, cloud_picture(np.array([near])))
    assert cloud_picture(np.array([near])).min() < cloud_picture(np.array([far])).min()


def test_views_are_tiled_row_by_row_and_the_rest_is_white():
    views = (
        np.arange(5, dtype=np.float32)[None, :, None, None, None] / 10 * np.ones((1, 5, 1, 2, 3))
    )
    table = tiled(views)
    assert table.shape == (1, 1, 4, 9)
    np.testing.assert_allclose(table[0, 0, 0, ::3], [0.0, 0.1, 0.2])
    np.testing.assert_allclose(table[0, 0, 2, ::3], [0.3, 0.4, 1.0])


def test_a_batch_with_nothing_to_draw_is_refused_with_what_it_has():
    with pytest.raises(ValueError, match="class_id"):
        input_pictures({"class_id": torch.zeros(2)})
