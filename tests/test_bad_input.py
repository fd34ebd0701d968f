"""What a user gets for a mistake: what was given, what is allowed, what to type; no traceback."""

import errno
import json
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from hydra.errors import HydraException
from omegaconf import open_dict

from i2i.cli import readable
from i2i.configuration import compose
from i2i.data.info import DataInfo
from i2i.errors import CheckpointError, ConfigurationError, NonFiniteLossError
from i2i.evaluate import evaluate
from i2i.predictor import Predictor
from i2i.runs.building import build_datamodule, build_network, build_task, check_fit, info_of
from i2i.runs.folder import RunFolder
from i2i.runs.loading import load_task, load_weights, locate, move_to, read_checkpoint
from i2i.training import LOCKS, train

TINY = ["scale=tiny", "trainer.accelerator=cpu"]


@pytest.mark.parametrize(
    ("door_name", "words", "expected"),
    [
        ("train", ["data.object=cahir"], ["cahir", "chair"]),
        ("train", ["data=modelnet40"], ["i2i.download", "modelnet40"]),
        ("train", ["data=shapenet_bed"], ["shapenet", "register"]),
        ("train", ["data=meshes"], ["data.root"]),
        ("train", ["data=meshes", "data.root=nowhere"], ["nowhere"]),
        ("train", ["data.modality=infrared"], ["infrared", "gray"]),
        ("train", ["model.label_frame=wrong"], ["consistent", "reference"]),
        ("train", ["+trainer.sync_batchnorm=true"], ["already", "leave it out"]),
        ("train", ["trainer.devices=2", "trainer.strategy=ddp_spawn"], ["trainer.strategy=ddp"]),
        ("train", ["resume=runs/nothing"], ["runs/nothing"]),
        ("predict", ["run=runs/nothing", "input=a.png"], ["runs/nothing", "ls -t runs"]),
        ("evaluate", ["run=runs/nothing"], ["runs/nothing"]),
        ("predict", ["input=a.png"], ["run"]),
    ],
)
def test_a_mistake_gets_a_message_and_not_a_traceback(door, tmp_path, door_name, words, expected):
    done = door(
        door_name, *(TINY if door_name == "train" else []), *words, cwd=tmp_path, check=False
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    for word in expected:
        assert word.lower() in done.stderr.lower(), done.stderr


def test_a_task_that_the_model_cannot_do_is_refused_with_what_it_can():
    config = compose([*TINY, "~model.networks.classification", "task=classification"])
    with pytest.raises(ConfigurationError, match="task=pose"):
        check_fit(config)


def test_axes_of_clouds_are_refused_with_a_picture():
    config = compose(TINY)
    predictor = Predictor(build_network(config, info(1)), info(1))
    with pytest.raises(ConfigurationError, match="axes=opencv is for clouds"):
        predictor.predict(np.zeros((32, 32), np.uint8), axes="opencv")


@pytest.mark.parametrize("model", ["epn", "kpconv"])
def test_clouds_too_small_for_the_network_are_refused_before_training(model):
    config = compose([*TINY, f"model={model}", "data.num_points=16"])
    with pytest.raises(HydraException, match=r"data\.num_points=16: this network needs 32"):
        build_network(config, info_of(config, ("chair",)))


def test_log_polar_views_want_a_trunk_with_circular_rows():
    config = compose([*TINY, "task=classification", "model=emvn_12", "model/trunk=alexnet"])
    with pytest.raises(HydraException, match=r"set model\.log_polar=false or model/trunk=resnet18"):
        build_network(config, info_of(config, ("chair", "car")))


def test_a_modality_that_the_model_does_not_see_is_refused():
    config = compose([*TINY, "model.modalities=[depth]", "data.modality=gray"])
    with pytest.raises(ConfigurationError, match=r"data\.modality=depth"):
        build_datamodule(config)


def info(classes: int) -> DataInfo:
    names = tuple(f"class{i}" for i in range(classes))
    return DataInfo(names, ("none",) * classes, channels=1, image_size=32, modality="gray")


def checkpoint_of(classes: int, path) -> None:
    config = compose(TINY)
    task = build_task(config, info(classes))
    content: dict = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(content)
    torch.save(content, path)


def test_weights_for_another_number_of_classes_are_refused(tmp_path):
    path = tmp_path / "two.ckpt"
    checkpoint_of(2, path)
    three = build_task(compose(TINY), info(3))
    with pytest.raises(CheckpointError, match="trained for 2 class"):
        load_weights(three, read_checkpoint(path), path)


def test_checkpoints_of_another_format_or_origin_or_cut_short_are_refused(tmp_path):
    path = tmp_path / "a.ckpt"
    checkpoint_of(1, path)
    whole = path.read_bytes()
    content = torch.load(path, weights_only=True)
    content["i2i"]["format"] = 99
    torch.save(content, path)
    with pytest.raises(CheckpointError, match="format 99"):
        load_task(path)
    torch.save({"state_dict": {}}, path)
    with pytest.raises(CheckpointError, match="not a checkpoint of i2i"):
        load_task(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_task(path)
    with pytest.raises(CheckpointError, match="no checkpoint yet"):
        locate(tmp_path)


def test_a_checkpoint_that_holds_code_is_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (print, ("boom",))

    torch.save({"i2i": Bomb()}, tmp_path / "bad.ckpt")
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_checkpoint(tmp_path / "bad.ckpt")


def test_a_loaded_network_predicts_as_the_saved_one_whatever_mode_it_was_saved_in(tmp_path):
    config = compose(TINY)
    task = build_task(config, info(1))
    batch = {"image": torch.rand(4, 1, 32, 32), "class_id": torch.zeros(4, dtype=torch.int64)}
    for mode in (True, False):
        task.train(mode)
        with torch.no_grad():
            for parameter in task.network.parameters():
                parameter.add_(0.01 * torch.randn_like(parameter))
        content: dict = {"state_dict": task.state_dict()}
        task.on_save_checkpoint(content)
        torch.save(content, tmp_path / "x.ckpt")
        loaded = load_task(tmp_path / "x.ckpt")
        task.train()
        task.eval()
        expected = task.network(batch).logits
        np.testing.assert_allclose(
            loaded.network(batch).logits.detach(), expected.detach(), atol=1e-6
        )


def test_networks_build_from_configuration_for_any_number_of_channels_and_classes():
    network = build_network(compose([*TINY, "data.modality=rgb"]), info(3))
    assert sum(p.numel() for p in network.parameters()) > 0


def tiny_run(tmp_path, *words):
    return compose(
        [
            *TINY,
            "data.source.instances_per_class=4",
            "data.source.test_instances_per_class=2",
            "data.views_per_instance=8",
            "data.test_views_per_instance=2",
            "data.render_workers=0",
            "trainer.enable_progress_bar=false",
            "callbacks.images=null",
            f"paths.data_dir={tmp_path}/data",
            f"run_dir={tmp_path}/run",
            *words,
        ]
    )


@pytest.fixture
def breaks_at_step(monkeypatch):
    """Makes the task do something else than its training step at a step."""
    from i2i.tasks.pose import PoseTask

    def install(step, action):
        original = PoseTask.training_step

        def training_step(self, batch, batch_idx):
            loss = original(self, batch, batch_idx)
            return action(loss) if self.global_step == step else loss

        monkeypatch.setattr(PoseTask, "training_step", training_step)

    return install


def raise_(error):
    def action(loss):
        raise error

    return action


def state(tmp_path):
    return json.loads((tmp_path / "run" / "status.json").read_text())["state"]


def test_nan_in_training_stops_keeps_the_last_good_checkpoint_and_names_the_batch(
    tmp_path, breaks_at_step
):
    breaks_at_step(7, lambda loss: loss * float("nan"))
    with pytest.raises(NonFiniteLossError, match=r"(?s)step 7.*instance") as error:
        train(tiny_run(tmp_path))
    assert ".ckpt" in str(error.value)
    assert state(tmp_path) == "failed"
    kept = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert kept["global_step"] == 5
    assert all(torch.isfinite(v).all() for v in kept["state_dict"].values())


def test_ctrl_c_keeps_the_last_checkpoint_and_says_how_to_go_on(tmp_path, breaks_at_step, capfd):
    breaks_at_step(7, raise_(KeyboardInterrupt()))
    with pytest.raises(SystemExit):
        train(tiny_run(tmp_path))
    assert state(tmp_path) == "interrupted"
    assert f"resume={tmp_path}/run" in capfd.readouterr().err
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()


def test_ctrl_c_before_the_first_checkpoint_says_that_there_is_none(
    tmp_path, breaks_at_step, capfd
):
    breaks_at_step(2, raise_(KeyboardInterrupt()))
    with pytest.raises(SystemExit):
        train(tiny_run(tmp_path))
    told = capfd.readouterr().err
    assert "before the first checkpoint" in told
    assert "resume=" not in told


FULL = OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_in_training_leaves_the_last_checkpoint_whole(tmp_path, monkeypatch, capfd):
    """Full when the second checkpoint is half written, and for the status after it."""
    write = torch.save

    def fail(*_, **__):
        raise FULL

    def save(content, stream):
        write(content, stream)
        if content["global_step"] > 5:
            monkeypatch.setattr(RunFolder, "write_status", fail)
            fail()

    monkeypatch.setattr(torch, "save", save)
    with pytest.raises(OSError, match="No space left") as caught:
        train(tiny_run(tmp_path))
    assert f"resume={tmp_path}/run" in capfd.readouterr().err
    assert "the disk is full" in readable(caught.value)
    folder = tmp_path / "run" / "checkpoints"
    assert read_checkpoint(folder / "last.ckpt")["global_step"] == 5
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_run_that_got_nowhere_may_be_begun_again(tmp_path, breaks_at_step):
    times = []

    def only_once(loss):
        times.append(1)
        if len(times) == 1:
            raise KeyboardInterrupt
        return loss

    breaks_at_step(2, only_once)
    with pytest.raises(SystemExit):
        train(tiny_run(tmp_path))
    train(tiny_run(tmp_path))
    assert state(tmp_path) == "done"


def test_a_setting_that_does_not_fit_leaves_no_run_folder(tmp_path):
    with pytest.raises(HydraException):
        train(tiny_run(tmp_path, "model.projector.sigma=-1"))
    assert not (tmp_path / "run" / "config.yaml").exists()


def test_a_run_that_is_running_is_not_resumed(tmp_path):
    train(tiny_run(tmp_path, "trainer.max_steps=2", "run=[fit]", f"paths.runs_dir={tmp_path}"))
    script = (
        "import sys, time; from pathlib import Path; from i2i.runs.locks import job_lock\n"
        "with job_lock(Path(sys.argv[1]), sys.argv[2]) as ours: print(ours, flush=True); "
        "time.sleep(60)"
    )
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    other = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / LOCKS), status["config_hash"]],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert other.stdout.readline().strip() == "True"
        with pytest.raises(ConfigurationError, match=f"is running.*process {other.pid}"):
            train(compose([f"resume={tmp_path}/run"]))
    finally:
        other.kill()
        other.wait()


def test_a_run_from_before_a_setting_existed_is_resumed(tmp_path):
    train(tiny_run(tmp_path, "trainer.max_steps=2", "run=[fit]"))
    saved = tmp_path / "run" / "config.yaml"
    kept = [line for line in saved.read_text().splitlines() if not line.startswith("convolution")]
    saved.write_text("\n".join(kept) + "\n")
    train(compose([f"resume={tmp_path}/run"]))
    assert state(tmp_path) == "done"


def test_a_device_that_is_not_there_is_refused():
    if torch.cuda.is_available():
        pytest.skip("it is there")
    with pytest.raises(ConfigurationError, match=r"device=cuda.*use device=cpu"):
        move_to(torch.nn.Linear(1, 1), "cuda")


def test_ctrl_c_while_rendering_says_that_it_goes_on(tmp_path):
    words = ["data=synthetic", "data.object=chair", "scale=small", "data.render_workers=0",
             "data.source.instances_per_class=20"]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "i2i.render", *words], cwd=tmp_path, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
        # A suite in the background of a script inherits that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    while "Rendered" not in process.stdout.readline():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=120)[0]
    assert process.returncode == 130, told
    assert "the same command again goes on" in told
    assert "Traceback" not in told


def test_a_second_run_never_overwrites_the_first(tmp_path):
    train(tiny_run(tmp_path, "trainer.max_steps=2", "run=[fit]"))
    before = (tmp_path / "run" / "config.yaml").read_bytes()
    with pytest.raises(ConfigurationError, match="holds a run already"):
        train(tiny_run(tmp_path, "trainer.max_steps=2", "seed=5"))
    assert (tmp_path / "run" / "config.yaml").read_bytes() == before


def test_evaluating_with_data_of_another_meaning_is_refused(tmp_path):
    train(tiny_run(tmp_path, "trainer.max_steps=2", "run=[fit]"))
    config = compose([f"run={tmp_path}/run"], "evaluate")
    with open_dict(config):
        config.data.object = "car"
    with pytest.raises(ConfigurationError, match="class_names"):
        evaluate(config)
