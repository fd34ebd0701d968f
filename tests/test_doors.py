"""The commands, run as a user runs them: in a subprocess, on tiny data."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

TINY = (
    "scale=tiny", "data.source.instances_per_class=6", "data.source.test_instances_per_class=3",
    "data.views_per_instance=8", "data.test_views_per_instance=4", "trainer.accelerator=cpu",
)  # fmt: skip
NO_PICTURES = "callbacks=no_pictures"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A user's folder; its stores are shared by the tests of this file."""
    return tmp_path_factory.mktemp("workplace")


@pytest.fixture(scope="module")
def trained(fresh_door, workplace):
    """The folder of a run that went through."""
    done = fresh_door("train", *TINY, "run_name=whole", cwd=workplace)
    return workplace / "runs" / "whole", done.stdout


def test_training_leaves_everything_that_a_run_folder_promises(trained):
    folder, output = trained
    for name in ("config.yaml", "status.json", "metrics.json", "predictions.npz", "versions.json",
                 "result.json", "checkpoints/last.ckpt", "checkpoints/best.ckpt",
                 "reference_meshes/chair.npz"):  # fmt: skip
        assert (folder / name).is_file(), name
    assert list(folder.glob("events.out.tfevents.*"))
    assert list((folder / "figures").glob("*.png"))
    assert json.loads((folder / "status.json").read_text())["state"] == "done"
    lines = dict(line.rsplit(" ", 1) for line in output.splitlines() if line.startswith("test/"))
    metrics = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert float(lines["test/median_error_deg"]) == pytest.approx(
        metrics["median_error_deg"], rel=1e-3
    )


def test_the_reported_metrics_are_those_of_the_recorded_predictions(trained):
    folder, _ = trained
    arrays = np.load(folder / "predictions.npz")
    assert len(arrays["error_deg"]) == 3 * 4
    relative = arrays["rotation_pred"] @ arrays["rotation_true"].transpose(0, 2, 1)
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    expected = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    np.testing.assert_allclose(arrays["error_deg"], expected, atol=0.1)
    metrics = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert metrics["median_error_deg"] == pytest.approx(np.median(arrays["error_deg"]), abs=1e-3)
    assert metrics["acc_at_30deg"] == pytest.approx(np.mean(arrays["error_deg"] < 30), abs=1e-6)


def test_a_checkpoint_loads_without_running_code_and_holds_plain_data(trained):
    checkpoint = torch.load(trained[0] / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["i2i"]["config"]["model"]["name"] == "i2i"
    assert checkpoint["i2i"]["data"]["class_names"] == ["chair"]
    assert not [k for k in checkpoint["state_dict"] if "filter" in k.split(".")[-1]]


def test_tensorboard_has_curves_pictures_and_the_final_metrics(trained):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(trained[0])).Reload()
    scalars = set(events.Tags()["scalars"])
    assert {"train/loss", "train/loss_classification", "train/loss_regression", "lr-SGD",
            "val/median_error_deg", "val/acc_at_15deg", "val/acc_at_30deg",
            "test/median_error_deg"} <= scalars  # fmt: skip
    assert events.Tags()["images"]
    plugins = events.summary_metadata.values()
    assert any(m.plugin_data.plugin_name == "hparams" for m in plugins)


def test_evaluate_gives_the_same_numbers_as_the_test_after_training(door, workplace, trained):
    folder, output = trained
    done = door("evaluate", f"run={folder}", "trainer.accelerator=cpu", cwd=workplace)
    line = next(x for x in done.stdout.splitlines() if x.startswith("test/median_error_deg"))
    wanted = next(x for x in output.splitlines() if x.startswith("test/median_error_deg"))
    assert line.split()[1] == wanted.split()[1]
    assert "[" in line


def test_evaluate_draws_runs_side_by_side_and_refuses_what_is_no_run(door, workplace, trained):
    folder, _ = trained
    words = [f"run={folder}", "trainer.accelerator=cpu", "output=side"]
    door("evaluate", *words, f"compare=[{folder}]", cwd=workplace)
    for name in ("comparison", "comparison_errors"):
        assert (workplace / "side" / "figures" / f"{name}.png").stat().st_size > 5000
    done = door("evaluate", *words, "compare=[nowhere]", cwd=workplace, check=False)
    assert done.returncode == 1
    assert "run=nowhere: no such run folder" in done.stderr


def test_predict_says_rotation_confidence_and_alternatives_and_draws(door, workplace, trained):
    folder, _ = trained
    from PIL import Image

    store = next((workplace / "data" / "renders").rglob("test/images.npy"))
    Image.fromarray(np.load(store)[0, 0]).save(workplace / "view.png")
    done = door("predict", f"run={folder}", "input=view.png", "output=out", cwd=workplace)
    result = json.loads((workplace / "out" / "view_pose.json").read_text())
    rotation = np.array(result["rotation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    x, y, z, w = result["quaternion_xyzw"]
    assert 1 - 2 * (y * y + z * z) == pytest.approx(rotation[0, 0], abs=1e-5)
    assert 2 * (x * y - z * w) == pytest.approx(rotation[0, 1], abs=1e-5)
    assert len(result["alternatives"]) == 3
    assert 0 < result["confidence"] <= 1
    assert (workplace / "out" / "view_pose.png").stat().st_size > 5000
    for word in ("rotation", "quaternion", "confidence"):
        assert word in done.stdout


def _train_process(workplace, *words):
    return subprocess.Popen(
        [sys.executable, "-m", "i2i.train", *TINY, *words], cwd=workplace,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        # As many threads as the other runs: sums are rounded differently with another number.
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_a_run_killed_in_the_middle_goes_on_to_the_same_result(door, workplace):
    longer = (NO_PICTURES, "trainer.max_steps=60", "data.num_workers=0")
    whole = door("train", *TINY, *longer, "run_name=unbroken", cwd=workplace).stdout
    process = _train_process(workplace, *longer, "run_name=broken")
    last = workplace / "runs" / "broken" / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 300
    while not last.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    status = json.loads((workplace / "runs" / "broken" / "status.json").read_text())
    assert status["state"] == "running", "the run was over before it could be killed"
    resumed = door("train", "resume=runs/broken", cwd=workplace).stdout

    def scores(text):
        return [line for line in text.splitlines() if line.startswith("test/")]

    assert scores(resumed) == scores(whole)
    first, second = (
        torch.load(workplace / "runs" / name / "checkpoints" / "last.ckpt", weights_only=True)
        for name in ("unbroken", "broken")
    )
    assert first["global_step"] == second["global_step"] == 60
    for key, value in first["state_dict"].items():
        assert torch.equal(value, second["state_dict"][key]), key


def test_resume_refuses_words_that_would_change_the_result(door, workplace, trained):
    done = door("train", "resume=runs/whole", "seed=3", cwd=workplace, check=False)
    assert done.returncode == 1
    assert "seed=3" in done.stderr
    assert "Traceback" not in done.stderr


def test_two_processes_compute_what_one_does(fresh_door, workplace):
    """In float64: the same losses at every step, and every test image once."""
    words = (*TINY, NO_PICTURES, "scale.reg_on=gt_always", "trainer.precision=64-true",
             "trainer.log_every_n_steps=1")  # fmt: skip
    fresh_door("train", *words, "run_name=single", cwd=workplace)
    both = ("trainer.devices=2", "trainer.strategy=ddp")
    fresh_door("train", *words, *both, "run_name=ddp", cwd=workplace)
    curves = [train_losses(workplace / "runs" / name) for name in ("single", "ddp")]
    assert len(curves[0]) == 10
    np.testing.assert_allclose(curves[1], curves[0], rtol=1e-6)  # events are float32
    single, arrays = (
        np.load(workplace / "runs" / name / "predictions.npz") for name in ("single", "ddp")
    )
    pairs = set(zip(arrays["instance_id"].tolist(), arrays["view_id"].tolist(), strict=True))
    assert len(arrays["error_deg"]) == len(pairs) == 12
    np.testing.assert_allclose(
        np.sort(arrays["error_deg"]), np.sort(single["error_deg"]), rtol=1e-4, atol=1e-4
    )


def train_losses(folder):
    """The training loss of every step that was logged."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return [event.value for event in EventAccumulator(str(folder)).Reload().Scalars("train/loss")]


def test_an_encoder_from_another_package_trains_without_a_change_here(
    fresh_door, workplace, monkeypatch
):
    package = workplace / "their_package"
    (package / "theirs" / "conf" / "model" / "encoder").mkdir(parents=True)
    (package / "theirs" / "__init__.py").write_text("")
    (package / "theirs" / "conf" / "__init__.py").write_text("")
    (package / "theirs" / "encoder.py").write_text(
        "from torch import nn\n"
        "class Patches(nn.Module):\n"
        "    def __init__(self, in_channels, *, image_size, width):\n"
        "        super().__init__()\n"
        "        self.out_channels, self.map_size = width, image_size // 4\n"
        "        self.conv = nn.Conv2d(in_channels, width, 4, stride=4)\n"
        "    def forward(self, image):\n"
        "        return self.conv(image).relu()\n"
    )
    (package / "theirs" / "conf" / "model" / "encoder" / "patches.yaml").write_text(
        "_target_: theirs.encoder.Patches\n_partial_: true\nwidth: 12\n"
    )
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    )
    fresh_door(
        "train", *TINY, NO_PICTURES, "model/encoder=patches", "hydra.searchpath=[pkg://theirs.conf]",
        "run_name=theirs", cwd=workplace,
    )  # fmt: skip
    checkpoint = torch.load(workplace / "runs/theirs/checkpoints/last.ckpt", weights_only=True)
    assert checkpoint["state_dict"]["network.trunk.encoder.conv.weight"].shape == (12, 1, 4, 4)


def test_one_mesh_file_is_rendered_learned_and_recognised_by_three_commands(door, workplace):
    part = trimesh.util.concatenate(
        [trimesh.creation.box((1, 0.5, 0.25)), trimesh.creation.cylinder(0.1, 1.0)]
    )
    part.export(workplace / "bracket.stl")
    own = ("data=meshes", "data.root=bracket.stl", "scale=tiny", "data.views_per_instance=20",
           "data.test_views_per_instance=8")  # fmt: skip
    rendered = door("render", *own, cwd=workplace).stdout
    assert "store" in rendered
    door("train", *own, NO_PICTURES, "run_name=bracket", "trainer.accelerator=cpu", cwd=workplace)
    from PIL import Image

    store = next((workplace / "data" / "renders").rglob("bracket/test/images.npy"))
    Image.fromarray(np.load(store)[0, 0]).save(workplace / "bracket.png")
    done = door("predict", "run=runs/bracket", "input=bracket.png", cwd=workplace)
    assert "rotation" in done.stdout


@pytest.mark.parametrize("debug", ["fast", "overfit", "default"])
def test_debug_configurations_run(door, workplace, debug):
    small = TINY if debug != "default" else TINY[1:3]
    door("train", *small, f"debug={debug}", f"run_name=debug-{debug}",
         *(["trainer.max_steps=8"] if debug == "overfit" else []), cwd=workplace)  # fmt: skip
    assert Path(workplace / "runs" / f"debug-{debug}" / "config.yaml").is_file()


def test_classification_trains_from_the_command_line(door, workplace):
    done = door(
        "train", *TINY, NO_PICTURES, "task=classification", "data.object=[chair,car]",
        "run_name=classes", cwd=workplace,
    )  # fmt: skip
    metrics = json.loads((workplace / "runs/classes/metrics.json").read_text())["metrics"]
    arrays = np.load(workplace / "runs" / "classes" / "predictions.npz")
    right = arrays["logits"].argmax(1) == arrays["class_id"]
    assert metrics["accuracy"] == pytest.approx(right.mean())
    for name in ("test/map_retrieval ", "test/map_class ", "test/chair/accuracy "):
        assert name in done.stdout


def test_one_network_learns_the_poses_of_two_classes(door, workplace):
    door("train", *TINY, NO_PICTURES, "data.object=[chair,car]", "run_name=joint", cwd=workplace)
    metrics = json.loads((workplace / "runs/joint/metrics.json").read_text())["metrics"]
    mean = (metrics["chair/median_error_deg"] + metrics["car/median_error_deg"]) / 2
    assert metrics["mean_class_median_error_deg"] == pytest.approx(mean)
    done = door("predict", "run=runs/joint", "input=nothing.png", cwd=workplace, check=False)
    assert "nothing.png" in done.stderr


@pytest.mark.parametrize("layout", ["modelnet", "shapenet"])
def test_the_papers_row_trains_once_the_meshes_are_there(door, workplace, layout):
    from i2i.data.export import export_modelnet_layout, export_shapenet_layout
    from i2i.data.sources.synthetic import SyntheticSource

    source = SyntheticSource(instances_per_class=5, test_instances_per_class=2)
    export = {"modelnet": export_modelnet_layout, "shapenet": export_shapenet_layout}[layout]
    export(source, source.items(["chair"]), workplace / layout)
    door(
        "train", "model=i2i", "task=pose", f"data={layout}_chair", f"data.root={layout}",
        "scale=tiny", "data.views_per_instance=8", "data.test_views_per_instance=4",
        f"run_name={layout}", "trainer.accelerator=cpu", NO_PICTURES, cwd=workplace,
    )  # fmt: skip
    result = json.loads((workplace / "runs" / layout / "result.json").read_text())
    assert result["job"]["modality"] == ("rgb" if layout == "shapenet" else "gray")
    assert len(result["errors_deg"]) == (1 if layout == "shapenet" else 2)


def test_pictures_with_labels_are_a_data_set(door, workplace, trained):
    from PIL import Image
    from scipy.spatial.transform import Rotation

    folder = workplace / "pictures"
    folder.mkdir()
    store = next((workplace / "data" / "renders").rglob("chair/train/images.npy")).parent
    images, rotations = np.load(store / "images.npy"), np.load(store / "rotations.npy")
    rows = ["file,class,qx,qy,qz,qw,split"]
    for number in range(40):
        Image.fromarray(images[number, 0]).save(folder / f"{number}.png")
        quaternion = ",".join(f"{v:.8f}" for v in Rotation.from_matrix(rotations[number]).as_quat())
        split = "test" if number >= 32 else "val" if number >= 28 else "train"
        rows.append(f"{number}.png,chair,{quaternion},{split}")
    (folder / "labels.csv").write_text("\n".join(rows))
    door(
        "train", "data=images", "data.root=pictures", "data.modality=gray", "scale=tiny",
        "run_name=pictures", "trainer.accelerator=cpu", NO_PICTURES, cwd=workplace,
    )  # fmt: skip
    arrays = np.load(workplace / "runs" / "pictures" / "predictions.npz")
    np.testing.assert_allclose(arrays["rotation_true"], rotations[32:40], atol=1e-5)
