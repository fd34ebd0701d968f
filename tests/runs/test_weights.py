"""Exported weights: loaded the one way that checkpoints are, and refused when damaged."""

import json

import pytest
import torch

from i2i.configuration import compose, plain
from i2i.data.noise import noise_batch
from i2i.errors import CheckpointError
from i2i.runs.building import build_task, info_of
from i2i.runs.loading import load_task, locate, read_checkpoint
from i2i.runs.weights import CONFIG, WEIGHTS, write_weights

TINY = ["scale=tiny", "data=synthetic"]


@pytest.fixture
def saved(tmp_path):
    config = compose(TINY)
    task = build_task(plain(config), info_of(config, ("chair",)))
    task.concentration.fill_(12.5)
    checkpoint = {"state_dict": task.state_dict(), "optimizer_states": [torch.zeros(3)]}
    task.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "last.ckpt")
    write_weights(read_checkpoint(tmp_path / "last.ckpt"), tmp_path / "out", made_from="last.ckpt")
    return task.eval(), tmp_path


def test_an_exported_folder_is_loaded_like_a_run(saved):
    task, folder = saved
    run, path = locate(folder / "out")
    assert run.path == folder / "out"
    loaded = load_task(path)
    assert loaded.run_config == task.run_config
    assert loaded.info == task.info
    assert loaded.concentration == 12.5
    batch = noise_batch(task.info, 2)
    with torch.no_grad():
        assert torch.equal(loaded.network(batch).logits, task.network(batch).logits)


def test_nothing_but_the_weights_is_written(saved):
    _, folder = saved
    assert sorted(p.name for p in (folder / "out").iterdir()) == [CONFIG, WEIGHTS]
    told = json.loads((folder / "out" / CONFIG).read_text())
    assert told["i2i"] == torch.load(folder / "last.ckpt", weights_only=True)["i2i"]
    assert told["checkpoint"] == "last.ckpt"


def test_another_checkpoint_cannot_be_asked_for(saved):
    with pytest.raises(CheckpointError, match="one set of weights"):
        locate(saved[1] / "out", "best")


@pytest.mark.parametrize("name", [CONFIG, WEIGHTS])
@pytest.mark.parametrize("how", ["missing", "cut"])
def test_damaged_weights_are_refused(saved, name, how):
    path = saved[1] / "out" / name
    whole = path.read_bytes()
    path.unlink()
    if how == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=r"model\.safetensors and config\.json"):
        read_checkpoint(saved[1] / "out" / WEIGHTS)


def test_weights_of_another_network_are_refused(saved):
    folder = saved[1] / "out"
    told = json.loads((folder / CONFIG).read_text())
    told["i2i"]["data"].update(class_names=["a", "b"], symmetry=["none", "none"])
    (folder / CONFIG).write_text(json.dumps(told))
    with pytest.raises(CheckpointError, match="does not fit"):
        load_task(folder / WEIGHTS)
