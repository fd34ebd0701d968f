"""Grids: every picture in its place, every error above its own column."""

import numpy as np
import pytest

from i2i.viz.grids import class_grid, prediction_grid


def shown(axes):
    return np.asarray(axes.images[0].get_array())


def test_rows_columns_and_titles():
    images = np.random.default_rng(0).random((3, 1, 8, 8))
    figure = prediction_grid(
        images, predicted=images / 2, true=images / 4, error_deg=np.array([3.0, 20.0, 100.0])
    )
    axes = np.array(figure.axes).reshape(3, 3)
    for column in range(3):
        np.testing.assert_array_equal(shown(axes[0, column]), images[column, 0])
        np.testing.assert_array_equal(shown(axes[1, column]), images[column, 0] / 2)
        np.testing.assert_array_equal(shown(axes[2, column]), images[column, 0] / 4)
    assert [a.get_title() for a in axes[0]] == ["3.0°", "20.0°", "100.0°"]
    assert len({a.title.get_color() for a in axes[0]}) == 3
    assert [a.get_ylabel() for a in axes[:, 0]] == ["input", "predicted", "true"]


def test_more_than_eight_samples_go_on_below_and_color_stays_color():
    images = np.random.default_rng(0).random((11, 3, 4, 4))
    figure = prediction_grid(images, error_deg=np.full(11, np.nan), titles=[*"abcdefghijk"])
    used = [axes for axes in figure.axes if axes.images]
    assert len(used) == 11
    np.testing.assert_array_equal(shown(used[10]), images[10].transpose(1, 2, 0))
    assert used[10].get_title() == "k\nnot finite"


def test_class_grid_names_the_truth_only_where_it_differs():
    images = np.zeros((2, 1, 4, 4))
    figure = class_grid(images, predicted=["chair", "sofa"], true=["chair", "desk"])
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == ["chair", "sofa\n(is desk)"]


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="no images"):
        prediction_grid(np.zeros((0, 1, 4, 4)))
