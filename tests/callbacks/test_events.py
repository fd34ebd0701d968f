"""Figures and histograms arrive in TensorBoard at the trainer's step."""

import io

import numpy as np
import torch
from callback_fakes import FakeData, FakeTask, make_trainer
from PIL import Image

from i2i.callbacks.events import log_figure, log_histogram
from i2i.viz.style import figure_to_array, new_figure


def test_figure_and_histogram_round_trip(tmp_path, events):
    trainer = make_trainer(tmp_path)
    trainer.fit(FakeTask(), datamodule=FakeData())
    figure = new_figure(1.0, 0.5)
    figure.set_facecolor((0.0, 1.0, 0.0))
    log_figure(trainer, "picture", figure)
    log_histogram(trainer, "numbers", torch.tensor([1.0, float("nan"), 3.0]))
    log_histogram(trainer, "nothing", torch.tensor([float("nan")]))
    trainer.logger.experiment.flush()
    found = events(tmp_path)
    logged = found.Images("picture")[0]
    assert logged.step == 3
    pixels = np.asarray(Image.open(io.BytesIO(logged.encoded_image_string)))
    np.testing.assert_array_equal(pixels, figure_to_array(figure))
    assert found.Histograms("numbers")[0].histogram_value.sum == 4.0
    assert "nothing" not in found.Tags()["histograms"]
