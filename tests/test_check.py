"""`python -m i2i.check`: on a run as a user runs it, and the ways round missing data."""

import json

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from i2i.check import check
from i2i.configuration import compose as compose_training
from i2i.configuration import config_dir
from i2i.data.info import DataInfo
from i2i.errors import CheckpointError, ConfigurationError
from i2i.runs.building import build_task

TINY = (
    "scale=tiny", "data.source.instances_per_class=3", "data.source.test_instances_per_class=2",
    "data.views_per_instance=6", "data.test_views_per_instance=4", "trainer.accelerator=cpu",
)  # fmt: skip


def test_a_trained_run_is_measured_from_the_command_line(door, tmp_path):
    door("train", *TINY, "trainer.max_steps=3", "callbacks=no_pictures", "run_name=a", cwd=tmp_path)
    done = door("check", "run=runs/a", "images=5", cwd=tmp_path)
    folder = tmp_path / "runs" / "a" / "check"
    content = json.loads((folder / "equivariance.json").read_text())
    assert (content["data"], content["images"], content["notice"]) == ("test images", 5, "")
    layers = {(row["layer"], row["group"]): row for row in content["layers"]}
    stem = layers["trunk.encoder.stem", "C4"]
    assert stem["verdict"] == "exact"
    assert stem["max_error"] < 1e-4 < 0.1 < stem["min_control"]
    assert layers["trunk.group_conv", "I60"]["verdict"] == "exact"
    assert len(layers["trunk.group_conv", "I60"]["error"]) == 60
    assert not layers["end to end", "C4"]["claimed"]
    assert (folder / "equivariance.png").stat().st_size > 5000
    for word in ("trunk.encoder.stem", "verdict", "predicted rotation is off by", "notice"):
        assert (word in done.stdout) is (word != "notice")


def untrained_run(folder, *words):
    """A run folder with a checkpoint and without data."""
    words = [*words, f"paths.data_dir={folder / 'nowhere'}"]
    config = OmegaConf.to_container(compose_training(["scale=tiny", *words]), resolve=True)
    info = DataInfo(("chair", "car"), ("none", "none"), channels=1, image_size=32, modality="gray")
    task = build_task(config, info)
    checkpoint = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(checkpoint)
    (folder / "checkpoints").mkdir(parents=True)
    torch.save(checkpoint, folder / "checkpoints" / "last.ckpt")
    return folder


def settings(folder, *words):
    with initialize_config_dir(config_dir(), version_base="1.3"):
        return compose("check", overrides=[f"run={folder}", "images=4", *words])


def test_without_its_data_a_run_is_measured_on_noise_with_a_notice(tmp_path, capsys):
    run = untrained_run(tmp_path / "run", "data.object=[chair,car]")
    done = check(settings(run))
    assert done["data"] == "noise"
    assert "noise is used instead" in done["notice"]
    asked = check(settings(run, "noise=true", f"output={tmp_path / 'out'}"))
    assert (asked["data"], asked["notice"]) == ("noise", "")
    assert asked["layers"] == done["layers"]
    assert (tmp_path / "out" / "equivariance.json").is_file()


def test_the_published_stem_is_reported_and_no_failure(tmp_path):
    run = untrained_run(tmp_path / "run", "model.encoder.stem_mode=ref", "data.object=[chair,car]")
    done = check(settings(run, "noise=true"))
    stem = next(row for row in done["layers"] if row["layer"] == "trunk.encoder.stem")
    assert stem["max_error"] > 0.01
    assert stem["verdict"] == "none"


def test_a_network_that_claims_nothing(tmp_path):
    run = untrained_run(tmp_path / "run", "model=cnn_gs", "data.object=[chair,car]")
    done = check(settings(run, "noise=true"))
    assert not done["claims"]
    assert [row["layer"] for row in done["layers"]] == ["end to end"]


def test_refusals(tmp_path):
    with pytest.raises(CheckpointError, match="no such run folder"):
        check(settings(tmp_path / "nothing"))
    for bad in ("images=0", "tolerance=0"):
        with pytest.raises(ConfigurationError, match="at least 1"):
            check(settings(tmp_path, bad))
