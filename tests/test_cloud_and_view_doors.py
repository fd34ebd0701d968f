"""Clouds and sets of views from the command line, on tiny data."""

import json
import shutil

import numpy as np
import pytest
import torch
import trimesh

from i2i.data.info import DataInfo
from i2i.errors import ConfigurationError
from i2i.models.prediction import PosePrediction
from i2i.predictor import Predictor

TINY = (
    "scale=tiny", "data.source.instances_per_class=4", "data.source.test_instances_per_class=2",
    "data.views_per_instance=4", "data.test_views_per_instance=4", "trainer.accelerator=cpu",
    "trainer.max_steps=3",
)  # fmt: skip


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    return tmp_path_factory.mktemp("workplace")


@pytest.fixture(scope="module")
def pose_run(door, workplace):
    door("train", *TINY, "model=epn", "run_name=clouds", cwd=workplace)
    return workplace / "runs" / "clouds"


def test_a_cloud_network_trains_and_draws_what_it_saw(pose_run):
    metrics = json.loads((pose_run / "metrics.json").read_text())["metrics"]
    assert 0 < metrics["median_error_deg"] < 180
    assert np.isfinite(metrics["log_likelihood"])
    assert {path.name for path in (pose_run / "figures").glob("*.png")} >= {
        "predictions.png", "errors.png", "distributions.png"
    }  # fmt: skip


def test_a_cloud_network_is_tested_on_the_rotations_of_the_images(pose_run, door, workplace):
    door("train", *TINY, "model=cnn_gs", "callbacks=no_pictures", "run_name=images", cwd=workplace)
    arrays = [
        np.load(workplace / "runs" / name / "predictions.npz") for name in ("clouds", "images")
    ]
    np.testing.assert_allclose(arrays[0]["rotation_true"], arrays[1]["rotation_true"], atol=1e-6)


def test_evaluation_again_gives_the_same_numbers(pose_run, door, workplace):
    done = door("evaluate", f"run={pose_run}", cwd=workplace)
    told = dict(
        line.split("  [")[0].split(" ") for line in done.stdout.splitlines() if line[:5] == "test/"
    )
    metrics = json.loads((pose_run / "metrics.json").read_text())["metrics"]
    assert float(told["test/median_error_deg"]) == pytest.approx(
        metrics["median_error_deg"], rel=1e-3
    )


def test_predict_takes_a_cloud(pose_run, door, workplace):
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(300, 3))).export(
        workplace / "part.ply"
    )
    done = door("predict", f"run={pose_run}", "input=part.ply", "axes=opencv", cwd=workplace)
    assert "confidence" in done.stdout
    answer = json.loads((pose_run / "predictions" / "part_pose.json").read_text())
    rotation = np.array(answer["rotation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert answer["crop_box"] is None
    assert (pose_run / "predictions" / "part_pose.png").is_file()


def test_what_is_made_for_images_refuses_clouds_with_what_to_give(pose_run, door, workplace):
    refused = door("check", f"run={pose_run}", cwd=workplace, check=False)
    assert "partial_points" in refused.stderr
    assert "data.modality=gray" in refused.stderr
    masked = door("predict", f"run={pose_run}", "input=part.ply", "mask=part.ply",
                  cwd=workplace, check=False)  # fmt: skip
    assert "mask= is for pictures" in masked.stderr
    wider = door("predict", f"run={pose_run}", "input=part.ply", "margin=1.2", cwd=workplace,
                 check=False)  # fmt: skip
    assert "margin= is for pictures" in wider.stderr


def test_a_multi_view_network_trains_and_cannot_answer_for_one_picture(door, workplace):
    door("train", *TINY, "model=emvn_12", "task=classification", "data.object=[chair,car]",
         "data.views_per_instance=2", "run_name=views", cwd=workplace)  # fmt: skip
    run = workplace / "runs" / "views"
    metrics = json.loads((run / "metrics.json").read_text())["metrics"]
    assert 0 <= metrics["accuracy"] <= 1
    picture = next((run / "figures").glob("*.png"))
    shutil.copy(picture, workplace / "photo.png")
    refused = door("predict", f"run={run}", "input=photo.png", cwd=workplace, check=False)
    assert "12 views" in refused.stderr


class Remembering(torch.nn.Module):
    """Remembers what it was given."""

    def forward(self, batch):
        self.seen = batch["points"]
        return PosePrediction(rotation=torch.eye(3)[None])


def test_the_network_gets_the_points_in_our_axes_and_the_class():
    info = DataInfo(("chair",), ("none",), channels=3, image_size=128, modality="partial_points",
                    num_points=64)  # fmt: skip
    network = Remembering()
    points = np.random.default_rng(0).normal(size=(64, 3))
    predictor = Predictor(network, info)
    assert "64 points" in repr(predictor)
    result = predictor.predict(points * [1, -1, -1], axes="opencv")
    seen = network.seen[0].numpy()
    assert seen.shape == (64, 3)
    centred = points - points.mean(axis=0)
    centred /= np.linalg.norm(centred, axis=1).max()
    np.testing.assert_allclose(seen[np.argsort(seen[:, 0])], centred[np.argsort(centred[:, 0])],
                               atol=1e-6)  # fmt: skip
    np.testing.assert_allclose(result.rotation, np.eye(3))
    assert result.crop_box is None
    with pytest.raises(ConfigurationError, match="box= is for pictures"):
        predictor.predict(points, box=(0, 0, 1, 1))
