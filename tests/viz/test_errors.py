"""Error figures: what is drawn, against counting by hand and against simulation."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from i2i.viz.errors import error_figure, recall_at


def test_histogram_shares_and_median_are_those_of_the_data():
    errors = np.array([1.0, 2.0, 7.0, 179.0])
    histogram, recall = error_figure(errors).axes
    shares = histogram.patches[0].get_data().values
    assert shares[[0, 1, -1]].tolist() == [50.0, 25.0, 25.0]
    assert shares.sum() == 100.0
    assert "median 4.5°" in histogram.get_legend().get_texts()[0].get_text()
    x, y = recall.lines[0].get_data()
    assert y[np.searchsorted(x, 100.0)] == 75.0
    assert "degrees" in histogram.get_xlabel()
    assert "degrees" in recall.get_xlabel()


def test_random_guess_curve_is_that_of_random_rotations():
    recall = error_figure(np.array([1.0])).axes[1]
    x, y = recall.lines[1].get_data()
    angles = np.degrees(Rotation.random(200_000, random_state=0).magnitude())
    for threshold in (30.0, 90.0, 132.3, 170.0):
        drawn = np.interp(threshold, x, y)
        assert drawn == pytest.approx(100.0 * (angles <= threshold).mean(), abs=0.4)


def test_several_series_and_tensors():
    figure = error_figure({"a": torch.tensor([1.0, 2.0]), "b": np.array([50.0])}, heading="both")
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels[:2] == ["a: median 1.5°", "b: median 50.0°"]


def test_recall_counts_the_threshold_itself():
    assert recall_at(np.array([5.0, 15.0, 20.0, 40.0]), [15.0, 30.0]).tolist() == [0.5, 0.75]


def test_numbers_that_are_not_finite_are_left_out_or_refused():
    shares = error_figure(np.array([np.nan, 3.0])).axes[0].patches[0].get_data().values
    assert shares[0] == 100.0
    with pytest.raises(ValueError, match="No finite errors"):
        error_figure(np.array([np.nan]))
