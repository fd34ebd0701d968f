"""Curves: panels by unit, smoothing against its definition, reading real event files."""

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from i2i.viz.curves import moving_average, read_curves, training_figure


def test_curves_of_one_unit_share_a_panel():
    curves = {
        "train/loss": ([0, 1], [2.0, 1.0]),
        "val/loss": ([0, 1], [3.0, 2.0]),
        "val/median_error_deg": ([0, 1], [90.0, 45.0]),
    }
    loss, degrees = training_figure(curves).axes
    assert [len(loss.lines), len(degrees.lines)] == [2, 1]
    assert (loss.get_ylabel(), degrees.get_ylabel()) == ("loss", "degrees")
    assert loss.get_xlabel() == "optimiser step"


def test_moving_average_is_the_weighted_mean_of_the_past():
    values = np.random.default_rng(0).random(6)
    smoothed = moving_average(values.tolist(), 0.7)
    weights = 0.7 ** np.arange(5, -1, -1)
    assert smoothed[-1] == pytest.approx((weights * values).sum() / weights.sum())


def test_short_curves_are_never_smoothed():
    axes = training_figure({"val/loss": ([0, 1, 2], [4.0, 2.0, 1.0])}, smooth=0.9).axes[0]
    assert len(axes.lines) == 1
    assert axes.lines[0].get_ydata().tolist() == [4.0, 2.0, 1.0]


def test_events_are_read_back_and_a_resumed_run_counts_once(tmp_path):
    for values in ({0: 5.0, 1: 4.0, 2: 9.0}, {2: 3.0, 3: 2.0}):  # step 2 was done again
        with SummaryWriter(tmp_path, filename_suffix=f".{len(values)}") as writer:
            for step, value in values.items():
                writer.add_scalar("train/loss", value, step)
    curves = read_curves(tmp_path, ["train/loss", "val/nothing"])
    assert list(curves) == ["train/loss"]
    steps, values = curves["train/loss"]
    assert list(steps) == [0, 1, 2, 3]
    assert values[0] == 5.0
    assert values[3] == 2.0


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="no curves"):
        training_figure({})
    with pytest.raises(ValueError, match="below 1"):
        training_figure({"loss": ([0], [1.0])}, smooth=1.0)
