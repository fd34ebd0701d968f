"""Runs side by side: the same images, each run's own predictions, clear refusals."""

import json

import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from i2i.data.info import DataInfo
from i2i.errors import ConfigurationError
from i2i.rendering.mesh import prepare_mesh
from i2i.rendering.reference import save_mesh
from i2i.viz import compare
from i2i.viz.compare import compare_errors, compare_runs, load_runs, spread_over_runs

INFO = DataInfo(("chair",), ("none",), channels=1, image_size=16, modality="gray")
TRUE = Rotation.random(10, random_state=0).as_matrix()
ERRORS = {"i2i": np.linspace(2.0, 92.0, 10), "cnn_gs": np.linspace(20.0, 110.0, 10)}


class FakeDataset:
    instance_id = np.arange(10)
    view_id = np.zeros(10, dtype=int)

    def __getitems__(self, indices):
        return {"image": torch.tensor(indices)[:, None, None, None].expand(-1, 1, 16, 16) / 10}


class FakeData:
    info = INFO

    def dataset(self, split):
        assert split == "test"
        return FakeDataset()

    def reference_mesh(self, class_name):
        return None


def write_run(path, model, *, seed=0, **changes):
    """A run folder as training leaves it, with errors about the camera's x axis."""
    errors = ERRORS[model]
    off = Rotation.from_rotvec(np.radians(errors)[:, None] * [[1.0, 0, 0]]).as_matrix()
    arrays = {
        "instance_id": np.arange(10), "view_id": np.zeros(10, int), "class_id": np.zeros(10, int),
        "rotation_true": TRUE, "rotation_pred": off @ TRUE, "error_deg": errors,
    }  # fmt: skip
    arrays |= {key: value for key, value in changes.items() if key in arrays}
    path.mkdir(parents=True)
    np.savez(path / "predictions.npz", **{k: v for k, v in arrays.items() if v is not None})
    data = {"modality": "gray", "image_size": changes.get("image_size", 16)}
    config = {"model": {"name": model}, "seed": seed, "data": data}
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    names = changes.get("names", [f"chair/{index}" for index in range(10)])
    (path / "result.json").write_text(json.dumps({"instance_names": names}))
    return path


@pytest.fixture
def data(monkeypatch):
    monkeypatch.setattr(compare, "_datamodule", lambda config, root: FakeData())


def test_each_run_has_a_column_and_images_go_from_easy_to_hard(tmp_path, data):
    runs = [write_run(tmp_path / "a", "i2i"), write_run(tmp_path / "b", "cnn_gs")]
    save_mesh(prepare_mesh(trimesh.creation.box()), runs[1] / "reference_meshes" / "chair.npz")
    figure = compare_runs(runs, count=3)
    grid = np.array(figure.axes).reshape(3, 4)
    assert [axes.get_title() for axes in grid[0, 2:]] == ["i2i", "cnn_gs"]
    rows = [round(float(axes.images[0].get_array()[0, 0]) * 10) for axes in grid[:, 0]]
    assert rows == [0, 4, 9]
    for column, name in ((2, "i2i"), (3, "cnn_gs")):
        titles = [axes.get_xlabel() for axes in grid[:, column]]
        assert titles == [f"{ERRORS[name][row]:.1f}°" for row in rows]
    assert np.asarray(grid[0, 1].images[0].get_array()).min() < 0.9  # the kept mesh is drawn


def test_errors_of_several_runs_are_drawn_together(tmp_path):
    runs = {"ours": write_run(tmp_path / "a", "i2i"), "theirs": write_run(tmp_path / "b", "cnn_gs")}
    labels = [text.get_text() for text in compare_errors(runs).axes[0].get_legend().get_texts()]
    assert labels[:2] == ["ours: median 47.0°", "theirs: median 65.0°"]


def test_runs_of_one_model_are_told_apart(tmp_path):
    seeds = [write_run(tmp_path / name, "i2i", seed=seed) for name, seed in (("a", 0), ("b", 1))]
    assert list(load_runs(seeds)) == ["i2i, seed 0", "i2i, seed 1"]
    same = [seeds[0], write_run(tmp_path / "c", "i2i")]
    assert list(load_runs(same)) == ["a", "c"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"view_id": np.ones(10, int)}, "other objects or views"),
        ({"instance_id": np.arange(9)}, "10 and 9 images"),
        ({"rotation_true": TRUE[::-1]}, "other true rotations"),
        ({"names": ["bed/0"] * 10}, "other names"),
        ({"image_size": 32}, "image_size 16 and 32"),
        ({"rotation_pred": None}, "task=pose"),
    ],
)
def test_runs_on_other_images_are_refused(tmp_path, changes, words):
    runs = [write_run(tmp_path / "a", "i2i"), write_run(tmp_path / "b", "cnn_gs", **changes)]
    with pytest.raises(ConfigurationError, match=words):
        load_runs(runs)


def test_folders_without_a_finished_run_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="resume="):
        compare_runs([tmp_path])
    with pytest.raises(ConfigurationError, match="no runs"):
        compare_runs([])


def test_spread_goes_by_the_mean_and_counts_failures_as_the_worst():
    errors = np.array([[10.0, np.nan, 30.0], [10.0, 0.0, 50.0]])
    assert spread_over_runs(errors, 3).tolist() == [0, 2, 1]
