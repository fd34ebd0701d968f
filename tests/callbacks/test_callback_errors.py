"""Error histograms: the numbers in the event file are those of the predictions."""

import numpy as np
import pytest
from callback_fakes import ERRORS_DEG, FakeData, FakeTask, make_trainer

from i2i.callbacks import ErrorHistogram


def test_errors_of_the_whole_set_are_logged_in_degrees(tmp_path, events):
    trainer = make_trainer(tmp_path, ErrorHistogram(), max_epochs=2)
    task, data = FakeTask(), FakeData()
    trainer.fit(task, datamodule=data)
    trainer.test(task, datamodule=data, verbose=False)
    found = events(tmp_path)
    assert {"val/error_deg", "test/error_deg"} <= set(found.Tags()["histograms"])
    assert {"val/errors", "test/errors"} <= set(found.Tags()["images"])
    for event in [*found.Histograms("val/error_deg"), *found.Histograms("test/error_deg")]:
        values = event.histogram_value
        assert values.num == len(ERRORS_DEG)  # of one validation, not of all so far
        assert values.sum == pytest.approx(ERRORS_DEG.sum(), rel=1e-3)
        assert (values.min, values.max) == pytest.approx((1.0, 170.0), rel=1e-3)


def test_not_finite_errors_are_left_out_and_said(tmp_path, events, caplog):
    class Diverged(FakeTask):
        def predict(self, batch):
            prediction = super().predict(batch)
            prediction.rotation[0] *= np.nan
            return prediction

    make_trainer(tmp_path, ErrorHistogram()).fit(Diverged(), datamodule=FakeData())
    assert events(tmp_path).Histograms("val/error_deg")[0].histogram_value.num == 3
    assert "3 of 6 val errors are not finite" in caplog.text


def test_classes_have_no_rotation_error(tmp_path, events):
    make_trainer(tmp_path, ErrorHistogram()).fit(FakeTask(classes=True), datamodule=FakeData())
    assert events(tmp_path).Tags()["histograms"] == []
