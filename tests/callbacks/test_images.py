"""Validation pictures, through the real Trainer and back out of the event files."""

import logging

import pytest
from callback_fakes import FakeData, FakeTask, make_trainer

from i2i.callbacks import PredictionImages


def test_pictures_come_every_other_validation_and_not_from_the_sanity_check(tmp_path, events):
    callback = PredictionImages(every_n_validations=2, max_images=3)
    data = FakeData()
    trainer = make_trainer(tmp_path, callback, max_epochs=3, num_sanity_val_steps=2)
    trainer.fit(FakeTask(), datamodule=data)
    steps = [image.step for image in events(tmp_path).Images("val/predictions")]
    assert steps == [3, 9]  # after the first and the third of three epochs of three steps
    assert data.asked == ["chair"]  # once, not at every validation


def test_only_as_many_samples_as_wanted_are_kept(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        PredictionImages, "_draw",
        lambda self, trainer, module, samples: drawn.update(samples) or _empty_figure(),
    )  # fmt: skip
    make_trainer(tmp_path, PredictionImages(max_images=3)).fit(FakeTask(), datamodule=FakeData())
    assert {name: len(values) for name, values in drawn.items()} == dict.fromkeys(
        ("image", "class_id", "predicted", "true"), 3
    )


def _empty_figure():
    from i2i.viz.style import new_figure

    return new_figure(1.0, 1.0)


@pytest.mark.parametrize("mesh", [None, "not a mesh"])
def test_a_missing_or_broken_mesh_is_said_once_and_training_goes_on(tmp_path, events, caplog, mesh):
    with caplog.at_level(logging.WARNING, logger="i2i"):
        trainer = make_trainer(tmp_path, PredictionImages(), max_epochs=2)
        trainer.fit(FakeTask(), datamodule=FakeData(mesh=mesh))
    assert trainer.global_step == 6
    said = [r.getMessage() for r in caplog.records if "PredictionImages" in r.getMessage()]
    assert len(said) == 1
    assert ("no reference mesh" if mesh is None else "drawing failed") in said[0]
    pictures = events(tmp_path).Tags()["images"]
    assert pictures == (["val/predictions"] if mesh is None else [])


def test_classes_are_drawn_without_meshes(tmp_path, events):
    data = FakeData()
    make_trainer(tmp_path, PredictionImages()).fit(FakeTask(classes=True), datamodule=data)
    assert len(events(tmp_path).Images("val/predictions")) == 1
    assert data.asked == []


def test_without_a_logger_nothing_happens(tmp_path):
    make_trainer(tmp_path, PredictionImages(), logger=False).fit(FakeTask(), datamodule=FakeData())
    assert not list(tmp_path.rglob("events.out.tfevents.*"))


def test_settings_are_checked_and_the_count_survives_a_resume():
    with pytest.raises(ValueError, match="at least 1"):
        PredictionImages(every_n_validations=0)
    first, second = PredictionImages(), PredictionImages()
    first._validations = 5
    second.load_state_dict(first.state_dict())
    assert second._validations == 5
