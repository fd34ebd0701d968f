"""Pictures of distributions, through the real Trainer, into event files and the run folder."""

import dataclasses
import logging

import numpy as np
import pytest
import torch
from callback_fakes import INFO, FakeData, FakeTask, make_trainer
from PIL import Image
from torch import nn

from i2i.callbacks import DistributionImages
from i2i.callbacks.distributions import group_of, picks
from i2i.geometry.icosahedron import icosahedron
from i2i.models.prediction import PosePrediction


class GroupTask(FakeTask):
    """Gives mass to the 60 elements; sure of the one nearest to the truth."""

    def __init__(self, *, target="view", info=INFO, broken=False):
        super().__init__()
        self.info, self.broken = info, broken
        self.network = nn.Module()
        self.network.target = target
        self.network.register_buffer("elements", icosahedron(1).rotations.float())

    def predict(self, batch):
        views = self.network.elements if self.network.target == "view" else (
            self.network.elements.mT
        )  # fmt: skip
        logits = torch.einsum("bji,gij->bg", batch["rotation"], views) * 20.0
        if self.broken:
            logits = logits * float("nan")
        rotation = views[logits.argmax(dim=1)].mT
        return PosePrediction(
            rotation, logits=logits, log_prob=logits.log_softmax(dim=1), candidates=views.mT
        )


@pytest.fixture
def drawn(monkeypatch):
    """The samples that would have been drawn, without the time that drawing takes."""
    calls = []

    def remember(samples, **settings):
        from i2i.viz.style import new_figure

        calls.append((samples, settings))
        return new_figure(1.0, 1.0)

    monkeypatch.setattr("i2i.callbacks.distributions.so3_figure", remember)
    return calls


def test_pictures_reach_tensorboard_and_the_run_folder(tmp_path, events):
    trainer = make_trainer(tmp_path, DistributionImages(max_images=1))
    task, data = GroupTask(), FakeData()
    trainer.fit(task, datamodule=data)
    trainer.test(task, datamodule=data, verbose=False)
    tags = events(tmp_path).Tags()["images"]
    assert {"val/distribution", "test/distribution"} <= set(tags)
    assert Image.open(tmp_path / "figures" / "distributions.png").size[0] > 500


def test_every_other_validation_and_not_in_the_sanity_check(tmp_path, events, drawn):
    callback = DistributionImages(every_n_validations=2, max_images=3)
    trainer = make_trainer(tmp_path, callback, max_epochs=3, num_sanity_val_steps=2)
    trainer.fit(GroupTask(), datamodule=FakeData())
    steps = [image.step for image in events(tmp_path).Images("val/distribution")]
    assert steps == [3, 9]
    assert [len(samples) for samples, _ in drawn] == [3, 3]


@pytest.mark.parametrize("target", ["view", "rotation"])
def test_samples_carry_what_the_network_said(tmp_path, drawn, target):
    make_trainer(tmp_path, DistributionImages(max_images=3, max_candidates=5), logger=False).test(
        GroupTask(target=target), datamodule=FakeData(), verbose=False
    )
    samples, settings = drawn[0]
    elements = settings["group"]
    assert [float(s.image[0, 0, 0]) for s in samples] == pytest.approx([0.0, 0.2, 0.4])
    for sample in samples:
        mass = np.asarray(sample.group_mass)
        assert mass.sum() == pytest.approx(1.0, abs=1e-5)
        assert mass.argmax() == sample.group_target
        # The group is handed on as camera -> object whatever the network classifies.
        np.testing.assert_allclose(elements[sample.group_target].T, sample.predicted, atol=1e-6)
        assert len(sample.distribution.mass) <= 5
        np.testing.assert_allclose(sample.distribution.rotations[0], sample.predicted, atol=1e-6)
        assert sample.title.startswith("chair, ")


@pytest.mark.parametrize(("stripped", "shown"), [(True, "none"), (False, "z")])
def test_equivalents_are_marked_where_the_labels_kept_them(tmp_path, drawn, stripped, shown):
    info = dataclasses.replace(INFO, symmetry=("z",), symmetry_stripped=stripped)
    trainer = make_trainer(tmp_path, DistributionImages(), logger=False)
    trainer.test(GroupTask(info=info), datamodule=FakeData(), verbose=False)
    assert {sample.symmetry for sample in drawn[0][0]} == {shown}


@pytest.mark.parametrize("classes", [False, True])
def test_networks_without_a_distribution_are_left_alone(tmp_path, events, caplog, classes):
    trainer = make_trainer(tmp_path, DistributionImages())
    task, data = FakeTask(classes=classes), FakeData()
    trainer.fit(task, datamodule=data)
    trainer.test(task, datamodule=data, verbose=False)
    assert events(tmp_path).Tags()["images"] == []
    assert not (tmp_path / "figures").exists()
    assert "DistributionImages" not in caplog.text


def test_a_diverged_network_is_said_once_and_training_goes_on(tmp_path, events, caplog):
    with caplog.at_level(logging.WARNING, logger="i2i"):
        trainer = make_trainer(tmp_path, DistributionImages(every_n_validations=1), max_epochs=2)
        trainer.fit(GroupTask(broken=True), datamodule=FakeData())
    assert trainer.global_step == 6
    said = [r.getMessage() for r in caplog.records if "DistributionImages" in r.getMessage()]
    assert len(said) == 1
    assert "not to 1" in said[0]
    assert events(tmp_path).Tags()["images"] == []


def test_a_folder_that_cannot_be_written_is_said_and_the_test_goes_on(tmp_path, drawn, caplog):
    (tmp_path / "figures").write_text("a file where the folder should be")
    trainer = make_trainer(tmp_path, DistributionImages(), logger=False)
    trainer.test(GroupTask(), datamodule=FakeData(), verbose=False)
    assert "writing failed" in caplog.text


@pytest.mark.parametrize(
    ("batches", "size", "count"), [(1, 10, 4), (3, 2, 5), (50, 8, 4), (2, 9, 7)]
)
def test_picks_are_as_many_as_wanted_and_spread(batches, size, count):
    found = [
        b * size + i for b in range(batches) for i in picks(b, batches, size=size, count=count)
    ]
    assert len(found) == len(set(found)) == count
    gaps = np.diff(found)
    assert gaps.max() <= 2.5 * batches * size / count


def test_picks_of_an_unknown_number_of_batches_are_the_first():
    assert [picks(b, float("inf"), size=2, count=3) for b in range(3)] == [[0, 1], [0], []]


def test_group_is_found_only_where_there_are_60_elements():
    assert group_of(FakeTask()) is None
    task = GroupTask()
    task.network.elements = torch.eye(3).expand(24, 3, 3)
    assert group_of(task) is None


def test_settings_are_checked_and_the_count_survives_a_resume():
    with pytest.raises(ValueError, match="distributions=null"):
        DistributionImages(max_images=0)
    with pytest.raises(ValueError, match="Allowed: view, object"):
        DistributionImages(axis="x")
    first, second = DistributionImages(), DistributionImages()
    first._validations = 5
    second.load_state_dict(first.state_dict())
    assert second._validations == 5
