"""What a run says at its end, against numbers worked out by hand."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2i.data.info import DataInfo
from i2i.runs.identity import config_hash
from i2i.runs.results import collect, file_name, result, summarise, table

ERRORS_DEG = np.array([[10.0, 20.0, 170.0], [2.0, 4.0, 6.0]])
INFO = DataInfo(("chair",), ("none",), channels=1, image_size=8, modality="gray")
CONFIG = {
    "seed": 0,
    "label": "a label",
    "model": {"name": "i2i", "encoder": {"stem_mode": "ref"},
              "networks": {"pose": {"_target_": "x", "target": "view"}}},
    "task": {"name": "pose"},
    "data": {"name": "synthetic", "object": "chair", "modality": "gray", "image_size": 8,
             "views_per_instance": 60, "root": None, "source": {"_target_": "x", "root": "/a"}},
    "scale": {"name": "tiny"},
    "trainer": {"precision": "32-true", "max_steps": 5, "accelerator": "cpu"},
    "paths": {"data_dir": "data"},
}  # fmt: skip


def pose_arrays():
    errors = ERRORS_DEG.ravel()
    true = Rotation.random(6, random_state=0)
    turned = Rotation.from_rotvec(np.radians(errors)[:, None] * [0.6, 0, 0.8]) * true
    return {
        "rotation_true": true.as_matrix().astype(np.float32),
        "rotation_pred": turned.as_matrix().astype(np.float32),
        "error_deg": errors.astype(np.float32),
        "group_correct": np.array([True, True, False, True, True, True]),
        "class_id": np.zeros(6, np.int64),
        "instance_id": np.repeat([0, 1], 3),
        "view_id": np.tile([0, 1, 2], 2),
    }


def test_the_summary_of_poses_is_that_of_their_errors():
    summary = summarise(pose_arrays(), INFO)
    metrics = summary["metrics"]
    assert metrics["median_error_deg"] == pytest.approx(8.0, abs=1e-3)  # between 6 and 10
    assert metrics["mean_error_deg"] == pytest.approx(212 / 6, abs=1e-3)
    assert metrics["acc_at_15deg"] == pytest.approx(4 / 6)
    assert metrics["acc_at_30deg"] == pytest.approx(5 / 6)
    assert metrics["flip_rate"] == pytest.approx(1 / 6)
    assert metrics["group_accuracy"] == pytest.approx(5 / 6)
    assert summary["errors_deg"] == ERRORS_DEG.tolist()
    assert (summary["instances"], summary["images"]) == (2, 6)
    low, high = summary["intervals"]["median_error_deg"]
    assert (low, high) == pytest.approx((4.0, 20.0))  # one of the two instances alone


def test_the_summary_of_classes_counts_every_view():
    logits = np.array([[2.0, 0], [2, 0], [0, 2], [2, 0]], np.float32)
    arrays = {
        "logits": logits,
        "descriptor": logits,
        "class_id": np.array([0, 0, 1, 1]),
        "instance_id": np.array([0, 0, 1, 1]),
        "view_id": np.array([0, 1, 0, 1]),
    }
    info = DataInfo(("a", "b"), ("none", "none"), channels=1, image_size=8, modality="gray")
    summary = summarise(arrays, info)
    assert summary["metrics"]["accuracy"] == pytest.approx(0.75)
    assert summary["metrics"]["b/accuracy"] == pytest.approx(0.5)
    assert summary["correct"] == [1.0, 0.5]


def made(**changes):
    config = CONFIG | changes
    return result(
        summarise(pose_arrays(), INFO), config, identity=config_hash(config),
        instance_names=["chair/x", "chair/y"], parameters=7, steps=5,
    )  # fmt: skip


def test_the_table_pools_seeds_and_keeps_labels_apart(tmp_path):
    for number, content in enumerate([made(), made(seed=1), made(label="other")]):
        (tmp_path / f"{number}.json").write_text(json.dumps(content))
    (tmp_path / "unrelated.json").write_text("{}")
    lines = table(collect(tmp_path)).splitlines()
    assert len(lines) == 4
    cells = [cell.strip() for cell in lines[2].split("|")]
    assert cells[1:5] == ["a label", "60", "2", "5"]
    assert cells[5].startswith("8.0 [")
    assert cells[6].startswith("67 [")
    assert [cell.strip() for cell in lines[3].split("|")][1:4] == ["other", "60", "1"]


def test_rows_are_compared_in_pairs_over_the_seeds_that_both_have(tmp_path):
    shifted = made(label="other")
    shifted["errors_deg"] = [[e - 1 for e in errors] for errors in shifted["errors_deg"]]
    for number, content in enumerate([made(), made(seed=1), shifted]):
        (tmp_path / f"{number}.json").write_text(json.dumps(content))
    lines = table(collect(tmp_path), against="a label").splitlines()
    assert [line.split("|")[-2].strip() for line in lines[2:]] == ["", "1.0 [1.0, 1.0]"]


def test_the_identity_of_a_job_forgets_places_and_nothing_else():
    here = config_hash(CONFIG)
    assert config_hash(CONFIG | {"paths": {"data_dir": "elsewhere"}, "label": "x"}) == here
    moved = CONFIG["data"] | {"root": "/b", "source": {"_target_": "x", "root": "/b"}}
    assert config_hash(CONFIG | {"data": moved}) == here
    assert config_hash(CONFIG | {"trainer": CONFIG["trainer"] | {"accelerator": "gpu"}}) == here
    for change in (
        {"seed": 1},
        {"trainer": CONFIG["trainer"] | {"max_steps": 6}},
        {"trainer": CONFIG["trainer"] | {"precision": "bf16-mixed"}},
        {"trainer": CONFIG["trainer"] | {"limit_test_batches": 1}},
        {"data": CONFIG["data"] | {"views_per_instance": 15}},
        {"model": CONFIG["model"] | {"networks": {"pose": {"target": "rotation"}}}},
        {"callbacks": {"averaging": {"_target_": "y"}}},
        {"trainer": CONFIG["trainer"] | {"gradient_clip_algorithm": "value"}},
    ):
        assert config_hash(CONFIG | change) != here, change
    for same in (
        {"trainer": CONFIG["trainer"] | {"max_steps": 5.0}},
        {"data": CONFIG["data"] | {"object": ["chair"]}},
        {"callbacks": {"images": {"_target_": "y"}}},
        {"data": CONFIG["data"] | {"a_new_setting": None}},
        {"scale": {"name": "tiny", "a_new_width": 3}},
    ):
        assert config_hash(CONFIG | same) == here, same
    own = CONFIG | {"data": CONFIG["data"] | {"name": "meshes", "root": "/a"}}
    other = CONFIG | {"data": CONFIG["data"] | {"name": "meshes", "root": "/b"}}
    assert config_hash(own) != config_hash(other)


def test_file_names_stay_short_and_plain():
    config = CONFIG | {"data": CONFIG["data"] | {"object": [f"class {i}" for i in range(40)]}}
    name = file_name(config, config_hash(config))
    assert len(name) < 120
    assert not set(name) - set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
