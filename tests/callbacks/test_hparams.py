"""The HPARAMS tab: one session start with settings, final metrics as scalars."""

import pytest
from callback_fakes import FakeData, FakeTask, make_trainer
from tensorboard.plugins.hparams import plugin_data_pb2

from i2i.callbacks import HyperparameterMetrics
from i2i.callbacks.hparams import flatten


def session_parameters(found):
    """Parameters of the session that TensorBoard's own plugin would show."""
    content = found.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    parsed = plugin_data_pb2.HParamsPluginData.FromString(content)
    return dict(parsed.session_start_info.hparams)


def test_settings_and_final_metrics_are_written_together(tmp_path, events):
    trainer = make_trainer(tmp_path, HyperparameterMetrics())
    task, data = FakeTask(), FakeData()
    trainer.fit(task, datamodule=data)
    assert "_hparams_/session_start_info" not in events(tmp_path).summary_metadata
    trainer.test(task, datamodule=data, verbose=False)
    found = events(tmp_path)
    parameters = session_parameters(found)
    assert set(parameters) == {"model.name", "seed"}
    assert parameters["model.name"].string_value == "fake"
    assert found.Scalars("test/median_error_deg")[-1].value == 25.0


def test_runs_without_a_test_write_after_fitting(tmp_path, events):
    trainer = make_trainer(tmp_path, HyperparameterMetrics(stage="fit"))
    trainer.fit(FakeTask(), datamodule=FakeData())
    assert "seed" in session_parameters(events(tmp_path))


def test_flat_scalars_only():
    nested = {"a": {"b": {"c": 1}, "d": [1, 2]}, "e": None, "f": True, "g": 0.5}
    assert flatten(nested) == {"a.b.c": 1, "a.d": "[1, 2]", "e": "None", "f": True, "g": 0.5}


def test_unknown_stage_is_refused():
    with pytest.raises(ValueError, match="Allowed: fit, test"):
        HyperparameterMetrics(stage="train")
