"""Figures of a test: each prediction beside its own image."""

import numpy as np
import torch
import trimesh

from i2i.data.info import DataInfo
from i2i.rendering.mesh import prepare_mesh
from i2i.viz.results import result_figures, spread


class FakeDataset:
    """Six images whose brightness says which one they are, in another order than the records."""

    instance_id = np.array([1, 1, 1, 0, 0, 0])
    view_id = np.array([0, 1, 2, 0, 1, 2])

    def __getitems__(self, indices):
        brightness = [10 * (3 * self.instance_id[i] + self.view_id[i]) for i in indices]
        images = torch.tensor(brightness)[:, None, None, None].expand(-1, 1, 8, 8)
        return {"image": images / 255.0}


class FakeData:
    def __init__(self, mesh):
        self.mesh = mesh

    def dataset(self, split):
        assert split == "test"
        return FakeDataset()

    def reference_mesh(self, class_name):
        return self.mesh


def pose_arrays():
    return {
        "instance_id": np.array([0, 0, 0, 1, 1, 1]),
        "view_id": np.array([0, 1, 2, 0, 1, 2]),
        "class_id": np.array([0, 0, 0, 1, 1, 1]),
        "error_deg": np.array([50.0, 10.0, 30.0, 40.0, 20.0, 60.0]),
        "rotation_true": np.stack([np.eye(3)] * 6),
        "rotation_pred": np.stack([np.eye(3)] * 6),
    }


def test_predictions_go_from_the_best_to_the_worst_with_their_own_images():
    info = DataInfo(("a", "b"), ("none", "z"), channels=1, image_size=8, modality="gray")
    mesh = prepare_mesh(trimesh.creation.box())
    figures = result_figures(pose_arrays(), info, FakeData(mesh))
    axes = [a for a in figures["predictions"].axes if a.images]
    assert len(axes) == 18
    titles = [a.get_title() for a in axes[:6]]
    assert titles == ["a\n10.0°", "b\n20.0°", "a\n30.0°", "b\n40.0°", "a\n50.0°", "b\n60.0°"]
    brightness = [round(255 * float(a.images[0].get_array()[0, 0])) for a in axes[:6]]
    assert brightness == [10, 40, 20, 30, 0, 50]
    labels = [t.get_text() for t in figures["errors"].axes[0].get_legend().get_texts()]
    assert labels[:2] == ["a: median 30.0°", "b: median 40.0°"]


def test_without_meshes_only_the_images_are_drawn():
    info = DataInfo(("a", "b"), ("none", "z"), channels=1, image_size=8, modality="gray")
    figures = result_figures(pose_arrays(), info, FakeData(None))
    assert len([a for a in figures["predictions"].axes if a.images]) == 6


def test_classes_get_a_confusion_matrix():
    info = DataInfo(("a", "b"), ("none", "none"), channels=1, image_size=8, modality="gray")
    arrays = {key: pose_arrays()[key] for key in ("instance_id", "view_id", "class_id")}
    arrays["logits"] = np.eye(2)[[0, 0, 1, 1, 1, 1]]
    figures = result_figures(arrays, info, FakeData(None))
    assert set(figures) == {"confusion", "predictions"}
    assert "83.3" in figures["confusion"].axes[0].get_title()


def test_spread_leaves_out_the_extremes_and_copes_with_few():
    assert spread(np.arange(100.0)[::-1].copy(), 2).tolist() == [94, 5]
    assert spread(np.array([3.0]), 8).tolist() == [0]
