"""Numbers that are not finite stop training before they reach the weights."""

import pytest
import torch
from callback_fakes import FakeData, FakeTask, make_trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from i2i.callbacks import NonFiniteLossGuard
from i2i.errors import NonFiniteLossError


@pytest.mark.parametrize("kind", ["loss", "gradient"])
def test_training_stops_with_the_batch_named_and_good_weights(tmp_path, kind):
    task = FakeTask(explode_at=(kind, 1))
    trainer = make_trainer(tmp_path, NonFiniteLossGuard())
    with pytest.raises(NonFiniteLossError) as caught:
        trainer.fit(task, datamodule=FakeData())
    message = str(caught.value)
    assert "optimiser step 1 (epoch 0, batch 1; instances 102, 103; views 2, 3)" in message
    assert ("The loss is inf" if kind == "loss" else "gradient of layer.weight") in message
    assert "No checkpoint had been written yet" in message
    assert "scale.optimizer.lr=" in message
    assert all(torch.isfinite(p).all() for p in task.parameters())


def test_without_the_guard_the_same_step_destroys_the_weights(tmp_path):
    task = FakeTask(explode_at=("gradient", 1))
    make_trainer(tmp_path).fit(task, datamodule=FakeData())
    assert not all(torch.isfinite(p).all() for p in task.parameters())


def test_the_last_good_checkpoint_is_kept_and_named(tmp_path):
    checkpoint = ModelCheckpoint(dirpath=tmp_path / "checkpoints", every_n_train_steps=1,
                                 filename="last", monitor=None)  # fmt: skip
    trainer = make_trainer(tmp_path, NonFiniteLossGuard(), checkpoint, enable_checkpointing=True)
    with pytest.raises(NonFiniteLossError) as caught:
        trainer.fit(FakeTask(explode_at=("gradient", 2)), datamodule=FakeData())
    kept = checkpoint.best_model_path
    assert kept in str(caught.value)
    weights = torch.load(kept, weights_only=True)["state_dict"]
    assert all(torch.isfinite(value).all() for value in weights.values())


def test_broken_data_are_told_from_a_broken_network(tmp_path):
    trainer = make_trainer(tmp_path, NonFiniteLossGuard())
    with pytest.raises(NonFiniteLossError, match="not finite in the data themselves: image"):
        trainer.fit(FakeTask(), datamodule=FakeData(broken=3))


def test_a_healthy_run_is_left_alone(tmp_path):
    guarded, plain = FakeTask(), FakeTask()
    plain.load_state_dict(guarded.state_dict())
    make_trainer(tmp_path / "a", NonFiniteLossGuard()).fit(guarded, datamodule=FakeData())
    make_trainer(tmp_path / "b").fit(plain, datamodule=FakeData())
    torch.testing.assert_close(guarded.state_dict(), plain.state_dict())
