"""The curves say what a measurement says, and training does not notice them."""

import contextlib
from types import SimpleNamespace

import lightning
import pytest
import torch
from callback_fakes import INFO, make_trainer
from torch import nn
from torch.utils.data import DataLoader

import i2i.callbacks.equivariance as module_under_test
from i2i.callbacks.equivariance import EquivarianceCurve, scalars
from i2i.models.e2cnn_eq import InPlanePose
from i2i.nn.c4_resnet import C4ResNet18
from i2i.testing.measured import measure


class Restless(nn.Module):
    """A pose network that draws random numbers in every mode."""

    def __init__(self, stem_mode="k4"):
        super().__init__()
        encoder = C4ResNet18(
            1, width=1, image_size=16, stem_mode=stem_mode, layer_strides=(2,), max_pool=False
        )
        self.inner = InPlanePose(encoder, channels=1, num_classes=1, image_size=16)
        self.drop = nn.Dropout(0.2)

    def forward(self, batch):
        torch.rand(3)
        return self.inner({**batch, "image": self.drop(batch["image"])})


class Broken(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(1, 1)

    def forward(self, batch):
        return self.layer(batch["image"].mean((2, 3)))

    def claims(self):
        return [("layer", "map", "nonsense")]


class Task(lightning.LightningModule):
    def __init__(self, network=None):
        super().__init__()
        self.network, self.info = network or Restless(), INFO

    def training_step(self, batch, batch_idx):
        prediction = self.network(batch)
        answer = prediction if torch.is_tensor(prediction) else prediction.rotation
        return answer.square().mean() + answer.sum() * torch.rand(())

    def validation_step(self, batch, batch_idx):
        self.network(batch)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.01, momentum=0.9)


def samples(count=6):
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(count, 1, 16, 16, generator=generator)
    return [{"image": image, "class_id": torch.tensor(0)} for image in images]


def fit(folder, *callbacks, network=None, epochs=2, **settings):
    torch.manual_seed(0)
    task = Task(network() if network else None)
    trainer = make_trainer(folder, *callbacks, max_epochs=epochs, **settings)
    train = DataLoader(samples(), batch_size=2, shuffle=True)  # the order comes from torch's RNG
    trainer.fit(task, train, DataLoader(samples(), batch_size=3))
    return task, torch.rand(4)


def curves(folder, events):
    found = events(folder)
    names = [n for n in found.Tags()["scalars"] if n.startswith("equivariance/")]
    return {name: [(e.step, e.value) for e in found.Scalars(name)] for name in names}


def test_training_is_bit_identical_with_and_without(tmp_path, events):
    plain, after_plain = fit(tmp_path / "plain")
    watched, after = fit(tmp_path / "watched", EquivarianceCurve(every_n_validations=1))
    for (name, a), b in zip(plain.state_dict().items(), watched.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert torch.equal(after_plain, after)
    assert watched.network.training
    assert len(curves(tmp_path / "watched", events)["equivariance/end_to_end"]) == 2


def test_without_restored_numbers_training_would_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(module_under_test, "isolate_rng", lambda **_: contextlib.nullcontext())
    plain, _ = fit(tmp_path / "plain")
    watched, _ = fit(tmp_path / "watched", EquivarianceCurve(every_n_validations=1))
    weights = [task.network.inner.encoder.stem.weights for task in (plain, watched)]
    assert not torch.equal(*weights)


def test_the_curves_are_the_measurement_of_the_first_images(tmp_path, events):
    task, _ = fit(tmp_path, EquivarianceCurve(every_n_validations=1, max_images=2), epochs=1)
    batch = {
        "image": torch.stack([s["image"] for s in samples()[:2]]),
        "class_id": torch.zeros(2, dtype=torch.long),
    }
    expected = scalars(measure(task.network, batch))
    logged = curves(tmp_path, events)
    assert set(logged) == set(expected)
    for name, value in expected.items():
        assert logged[name][0] == (3, pytest.approx(value, rel=1e-3, abs=1e-5))
    assert logged["equivariance/inner.encoder.stem"][0][1] < 1e-5
    assert logged["equivariance/end_to_end_deg"][0][1] < 0.01


def test_an_inexact_stem_shows_in_the_curve(tmp_path, events):
    fit(tmp_path, EquivarianceCurve(), network=lambda: Restless("ref"), epochs=1)
    assert curves(tmp_path, events)["equivariance/inner.encoder.stem"][0][1] > 0.01


def test_every_nth_validation_and_never_the_sanity_check(tmp_path, events):
    callback = EquivarianceCurve(every_n_validations=2)
    fit(tmp_path, callback, epochs=5, num_sanity_val_steps=2)
    steps = [step for step, _ in curves(tmp_path, events)["equivariance/end_to_end"]]
    assert steps == [3, 9, 15]
    again = EquivarianceCurve(every_n_validations=2)
    again.load_state_dict(callback.state_dict())
    assert again.state_dict() == {"validations": 5}


def test_what_cannot_be_measured_is_told_once_and_training_goes_on(tmp_path, caplog, events):
    task, _ = fit(tmp_path, EquivarianceCurve(every_n_validations=1), network=Broken)
    assert caplog.text.count("equivariance is not measured") == 1
    assert "nonsense" in caplog.text
    assert curves(tmp_path, events) == {}
    assert task.network.training


def test_names_of_curves():
    def row(layer, group, error, from_image, median=None):
        angles = median and SimpleNamespace(median=median)
        return SimpleNamespace(
            layer=layer, group=group, max_error=error, max_from_image=from_image, angles=angles
        )

    rows = [
        row("conv", "I60", 1.0, None), row("conv", "C5", 2.0, 3.0),
        row("dead", "C4", float("nan"), float("nan")),
        row("end to end", "C4", 4.0, 4.0, (5.0, 6.0)), row("end to end", "C5", 7.0, 7.0, (8.0,)),
    ]  # fmt: skip
    assert scalars(rows) == {
        "equivariance/conv": 1.0, "equivariance/conv_C5": 3.0, "equivariance/end_to_end": 4.0,
        "equivariance/end_to_end_deg": 6.0, "equivariance/end_to_end_C5": 7.0,
        "equivariance/end_to_end_deg_C5": 8.0,
    }  # fmt: skip


@pytest.mark.parametrize("bad", [{"every_n_validations": 0}, {"max_images": 0}])
def test_numbers_below_one_are_refused(bad):
    with pytest.raises(ValueError, match=r"callbacks\.equivariance=null"):
        EquivarianceCurve(**bad)
