"""Exported programs, beside the network in torch, fed by another runtime where there is one."""

import json

import numpy as np
import pytest
import torch
from torch import nn

import i2i
from i2i.configuration import compose, plain
from i2i.data.noise import noise_batch
from i2i.errors import ConfigurationError
from i2i.exporting import METADATA, export_run
from i2i.runs.building import build_task, info_of
from i2i.runs.loading import load_task


def finished(folder, *words, classes=("chair",)):
    """A run folder with a checkpoint whose batch norms have seen images."""
    config = compose(["scale=tiny", "data=synthetic", *words])
    torch.manual_seed(0)
    task = build_task(plain(config), info_of(config, classes))
    for module in task.network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.3)
    task.train()
    with torch.no_grad():
        task.network(noise_batch(task.info, 6))
    checkpoint = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(checkpoint)
    (folder / "checkpoints").mkdir(parents=True)
    torch.save(checkpoint, folder / "checkpoints" / "last.ckpt")
    return folder


RUNS = {
    "pose": ([], ("chair",)),
    "joint": ([], ("chair", "stool", "car")),
    "classes": (["task=classification"], ("chair", "stool", "car")),
    "regressor": (["model=cnn_gs"], ("chair",)),
    "signs": (["model=cnn_s3exp"], ("chair", "car")),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {
        name: finished(folder / name, *words, classes=classes)
        for name, (words, classes) in RUNS.items()
    }


def asked(run, count):
    """Images, the classes where they are looked at, and what the network itself answers."""
    task = load_task(run / "checkpoints" / "last.ckpt")
    batch = noise_batch(task.info, count, seed=7)
    with torch.no_grad():
        prediction = task.network(batch)
    given = {"image": batch["image"]}
    if task.run_config["task"]["name"] == "classification":
        return given, {"logits": prediction.logits}
    if task.info.num_classes > 1:
        given["class_id"] = batch["class_id"]
    answers = {"rotation": prediction.rotation}
    if prediction.log_prob is not None:
        answers["probability"] = prediction.log_prob.exp()
    return given, answers


@pytest.mark.parametrize("name", RUNS)
def test_a_torch_program_answers_as_the_network_for_any_number_of_images(runs, name, tmp_path):
    written = export_run(runs[name], tmp_path / "model.pt2")
    extra = {METADATA: ""}
    program = torch.export.load(written, extra_files=extra).module()
    for count in (1, 5):
        given, answers = asked(runs[name], count)
        found = program(*given.values())
        assert len(found) == len(answers)
        for one, expected in zip(found, answers.values(), strict=True):
            torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-4)
    assert json.loads(extra[METADATA])["input"]["image_size"] == 32


@pytest.mark.parametrize("name", RUNS)
def test_another_runtime_answers_as_torch_does(runs, name, tmp_path):
    reason = "needs the packages of i2i[onnx]"
    pytest.importorskip("onnxscript", reason=reason)
    runtime = pytest.importorskip("onnxruntime", reason=reason)
    written = export_run(runs[name], tmp_path / "model.onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(written, options, providers=["CPUExecutionProvider"])
    for count in (1, 5):
        given, answers = asked(runs[name], count)
        assert [one.name for one in session.get_inputs()] == list(given)
        assert [one.name for one in session.get_outputs()] == list(answers)
        found = session.run(None, {key: value.numpy() for key, value in given.items()})
        for one, expected in zip(found, answers.values(), strict=True):
            np.testing.assert_allclose(one, expected, rtol=1e-4, atol=1e-4)
    told = json.loads(session.get_modelmeta().custom_metadata_map[METADATA])
    assert told["input"]["shape"][1:] == list(session.get_inputs()[0].shape[1:]) == [1, 32, 32]
    assert told["input"]["background"] == 1.0
    assert told["class_names"] == list(RUNS[name][1])


def test_the_class_is_looked_at(runs, tmp_path):
    """Negative control: another class of the same image has another answer."""
    program = torch.export.load(export_run(runs["joint"], tmp_path / "m.pt2")).module()
    given, _ = asked(runs["joint"], 2)
    first, second = (program(given["image"], torch.full((2,), index))[1] for index in (0, 1))
    assert (first - second).abs().max() > 1e-3


def test_an_exported_folder_predicts_as_the_run(runs, tmp_path):
    folder = i2i.export_run(runs["pose"], tmp_path / "out")
    picture = np.full((32, 32), 255, np.uint8)
    picture[8:24, 12:20] = 90
    theirs, ours = (i2i.load(where).predict(picture) for where in (runs["pose"], folder))
    np.testing.assert_array_equal(ours.rotation, theirs.rotation)
    optimized = i2i.load(folder, optimize=True).predict(picture)
    np.testing.assert_allclose(optimized.rotation, theirs.rotation, atol=1e-4)
    assert optimized.confidence == pytest.approx(theirs.confidence, abs=1e-5)


def test_what_onnx_cannot_say_is_refused_with_what_can(tmp_path):
    pytest.importorskip("onnxscript", reason="needs the packages of i2i[onnx]")
    run = finished(tmp_path / "run", "model=cnn_procrustes")
    with pytest.raises(ConfigurationError, match=r"no operation for .*write output=.*m\.pt2"):
        export_run(run, tmp_path / "m.onnx")
    assert not (tmp_path / "m.onnx").exists()


def test_networks_of_clouds_are_refused_and_their_weights_are_not(tmp_path):
    run = finished(tmp_path / "run", "model=epn", "data.modality=partial_points")
    with pytest.raises(ConfigurationError, match=r"gray \| depth \| rgb.*partial_points"):
        export_run(run, tmp_path / "m.pt2")
    export_run(run, tmp_path / "m")
    assert i2i.load(tmp_path / "m").info.num_points == 64


def test_an_unknown_suffix_is_refused(runs, tmp_path):
    with pytest.raises(ConfigurationError, match=r"\.onnx, \.pt2, or a folder"):
        export_run(runs["pose"], tmp_path / "model.tflite")


def test_missing_packages_are_named(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r"onnx, onnxscript.*pip install 'i2i\[onnx\]'"):
        export_run(runs["pose"], tmp_path / "model.onnx")


def test_the_door(runs, fresh_door, tmp_path):
    done = fresh_door("export", f"run={runs['pose']}", "output=model.pt2", cwd=tmp_path)
    assert "written to model.pt2" in done.stdout
    assert (tmp_path / "model.pt2").stat().st_size > 10_000
    assert [path.name for path in tmp_path.iterdir()] == ["model.pt2"]
    refused = fresh_door("export", f"run={runs['pose']}", "output=m.h5", cwd=tmp_path, check=False)
    assert refused.returncode == 1
    assert "error: output=m.h5" in refused.stderr
    assert "Traceback" not in refused.stderr
