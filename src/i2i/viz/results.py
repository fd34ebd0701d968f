"""The figures of a finished test: errors, and predictions from the best to the worst."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from i2i.data.dataset import RenderedDataset
from i2i.data.info import DataInfo
from i2i.rendering.mesh import RenderMesh
from i2i.viz.classes import confusion_figure
from i2i.viz.errors import error_figure
from i2i.viz.grids import class_grid, prediction_grid
from i2i.viz.inputs import input_pictures
from i2i.viz.rerender import rerender_each
from i2i.viz.style import CYCLE

_SHOWN = 8


class TestedData(Protocol):
    """What is asked of a data module."""

    def dataset(self, split: str) -> RenderedDataset:
        """The images of a split."""
        ...

    def reference_mesh(self, class_name: str) -> RenderMesh | None:
        """A typical mesh of a class."""
        ...


def result_figures(
    arrays: Mapping[str, np.ndarray], info: DataInfo, datamodule: TestedData
) -> dict[str, Figure]:
    """Draw what a test gave.

    Args:
        arrays: What `PredictionRecord` collected: ``instance_id`` and ``view_id`` with, for poses,
            ``rotation_true``, ``rotation_pred``, ``error_deg``, or, for classes, ``logits``.
        info: What the data are.
        datamodule: Where the test images and the reference meshes are.

    Returns:
        Figures by name: ``errors`` and ``predictions`` of poses, ``confusion`` and ``predictions``
        of classes.
    """
    if "rotation_pred" in arrays:
        return {
            "errors": _errors(arrays, info),
            "predictions": _poses(arrays, info, datamodule),
        }
    return _classes(arrays, info, datamodule)


def spread(error_deg: np.ndarray, count: int = _SHOWN) -> np.ndarray:
    """Indices of samples from the 5th to the 95th percentile of the error, evenly spaced.

    Example:
        >>> spread(np.arange(101.0), 3).tolist()
        [5, 50, 95]
    """
    order = np.argsort(error_deg, kind="stable")
    count = min(count, len(order))
    places = np.round(np.linspace(0.05, 0.95, count) * (len(order) - 1)).astype(int)
    return order[np.unique(places)]


def _errors(arrays: Mapping[str, np.ndarray], info: DataInfo) -> Figure:
    errors, classes = arrays["error_deg"], arrays["class_id"]
    heading = f"test, {len(errors):,} images"
    if not 1 < info.num_classes <= len(CYCLE):
        return error_figure(errors, heading=heading)
    named = {
        name: errors[classes == index]
        for index, name in enumerate(info.class_names)
        if np.isfinite(errors[classes == index]).any()
    }
    return error_figure(named, heading=heading)


def _poses(arrays: Mapping[str, np.ndarray], info: DataInfo, datamodule: TestedData) -> Figure:
    chosen = spread(arrays["error_deg"])
    names = [info.class_names[index] for index in arrays["class_id"][chosen]]
    found = {name: datamodule.reference_mesh(name) for name in dict.fromkeys(names)}
    meshes = [found[name] for name in names]
    pictures: list[np.ndarray | None] = [None, None]
    if any(mesh is not None for mesh in meshes):
        pictures = [
            rerender_each(meshes, arrays[key][chosen], info=info)
            for key in ("rotation_pred", "rotation_true")
        ]
    return prediction_grid(
        test_images(arrays, chosen, datamodule),
        predicted=pictures[0],
        true=pictures[1],
        error_deg=arrays["error_deg"][chosen],
        titles=names if info.num_classes > 1 else None,
        heading="test: from the 5th to the 95th percentile of the error; below, the class's "
        "reference mesh re-rendered",
    )


def _classes(
    arrays: Mapping[str, np.ndarray], info: DataInfo, datamodule: TestedData
) -> dict[str, Figure]:
    true, predicted = arrays["class_id"], arrays["logits"].argmax(axis=1)
    chosen = np.unique(np.linspace(0, len(true) - 1, 2 * _SHOWN).round().astype(int))
    return {
        "confusion": confusion_figure(true, predicted=predicted, class_names=info.class_names),
        "predictions": class_grid(
            test_images(arrays, chosen, datamodule),
            predicted=[info.class_names[index] for index in predicted[chosen]],
            true=[info.class_names[index] for index in true[chosen]],
            heading="test: evenly spaced images",
        ),
    }


def test_images(
    arrays: Mapping[str, np.ndarray], chosen: np.ndarray, datamodule: TestedData
) -> np.ndarray:
    """What the network saw for some test predictions, as pictures (N, C, S, S) in [0, 1].

    Args:
        arrays: With the ``instance_id`` and ``view_id`` of each prediction.
        chosen: Which predictions, shape (N,).
        datamodule: Where the images are.

    Raises:
        ValueError: if the test set lacks one of them.
    """
    dataset = datamodule.dataset("test")
    place = {
        key: index
        for index, key in enumerate(
            zip(dataset.instance_id.tolist(), dataset.view_id.tolist(), strict=True)
        )
    }
    keys = list(
        zip(arrays["instance_id"][chosen].tolist(), arrays["view_id"][chosen].tolist(), strict=True)
    )
    missing = [key for key in keys if key not in place]
    if missing:
        raise ValueError(
            f"The test set has no view {missing[0][1]} of object {missing[0][0]}: the data are not "
            "those of the test; use the same data settings and root."
        )
    # Not the stored images: robustness runs shift theirs.
    return input_pictures(dataset.__getitems__([place[key] for key in keys]))
