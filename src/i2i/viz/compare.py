"""Finished runs side by side: the same test images as each network saw them, and its errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf

from i2i.errors import ConfigurationError
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.reference import load_mesh
from i2i.runs.folder import RunFolder, read_json
from i2i.viz.errors import error_figure
from i2i.viz.qualitative import qualitative_grid
from i2i.viz.results import test_images

if TYPE_CHECKING:
    from i2i.data.loaders import ImageDataModule

Runs = Sequence[str | Path] | Mapping[str, str | Path]
_SAME = ("instance_id", "view_id", "class_id")


@dataclass(frozen=True)
class RunPredictions:
    """What a run said about its test images.

    Attributes:
        folder: The run's folder.
        arrays: Of its ``predictions.npz``.
        config: Its resolved configuration.
        instance_names: Name of each test instance; empty if the run has no ``result.json``.
    """

    folder: RunFolder
    arrays: dict[str, np.ndarray]
    config: DictConfig
    instance_names: tuple[str, ...]


def compare_runs(
    runs: Runs, *, count: int = 6, data_root: str | Path | None = None, heading: str | None = None
) -> Figure:
    """Test images with each run's prediction re-rendered; see `qualitative_grid`.

    The images are spread evenly from the 5th to the 95th percentile of the error, averaged over the
    runs, so that the choice favours none of them and is the same each time.

    Args:
        runs: Folders of finished pose runs on the same test images; names from their models (and
            seeds, where those do not tell them apart), or those of a mapping.
        count: How many images.
        data_root: Where the data lie now; where the first run found them if None.
        heading: Text above the figure; which images these are if None.

    Returns:
        The figure.

    Raises:
        ConfigurationError: if a run has no pose predictions, or the test images differ.
    """
    loaded = load_runs(runs)
    first = next(iter(loaded.values()))
    datamodule = _datamodule(first.config, data_root)
    errors = np.stack([run.arrays["error_deg"] for run in loaded.values()])
    chosen = spread_over_runs(errors, count)
    info = datamodule.info
    names = [info.class_names[index] for index in first.arrays["class_id"][chosen]]
    found = {name: _mesh(name, loaded, datamodule) for name in dict.fromkeys(names)}
    if heading is None:
        heading = f"{len(chosen)} of {errors.shape[1]:,} test images, from easy to hard"
    return qualitative_grid(
        test_images(first.arrays, chosen, datamodule),
        {name: run.arrays["rotation_pred"][chosen] for name, run in loaded.items()},
        first.arrays["rotation_true"][chosen],
        info=info,
        meshes=[found[name] for name in names],
        error_deg={name: run.arrays["error_deg"][chosen] for name, run in loaded.items()},
        titles=names if info.num_classes > 1 else None,
        heading=heading,
    )


def compare_errors(runs: Runs, *, heading: str = "") -> Figure:
    """Histogram and recall curve of several runs' errors on the same test images.

    Args:
        runs: See `compare_runs`.
        heading: Text above the figure.
    """
    named = {name: run.arrays["error_deg"] for name, run in load_runs(runs).items()}
    return error_figure(named, heading=heading)


def load_runs(runs: Runs) -> dict[str, RunPredictions]:
    """Predictions of runs by name, all of the same test images.

    Raises:
        ConfigurationError: naming the run and what is missing or differs.
    """
    folders = list(runs.values()) if isinstance(runs, Mapping) else list(runs)
    if not folders:
        raise ConfigurationError("no runs were given: give at least one run folder")
    loaded = [_read(RunFolder(Path(folder))) for folder in folders]
    for other in loaded[1:]:
        _check_same_images(loaded[0], other)
    names = list(runs) if isinstance(runs, Mapping) else _names(loaded)
    return dict(zip(names, loaded, strict=True))


def spread_over_runs(error_deg: np.ndarray, count: int) -> np.ndarray:
    """Indices of images from the 5th to the 95th percentile of the error averaged over runs (R, N).

    Infinite and missing errors count as 180°.
    """
    mean = np.where(np.isfinite(error_deg), error_deg, 180.0).mean(axis=0)
    order = np.argsort(mean, kind="stable")
    places = np.linspace(0.05, 0.95, min(count, len(order))) * (len(order) - 1)
    return order[np.unique(np.round(places).astype(int))]


def _read(folder: RunFolder) -> RunPredictions:
    for path in (folder.predictions, folder.config):
        if not path.is_file():
            raise ConfigurationError(
                f"{path} does not exist: {folder.path} is not the folder of a tested run; finish "
                f"it with `python -m i2i.train resume={folder.path}`"
            )
    with np.load(folder.predictions, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    if "rotation_pred" not in arrays:
        raise ConfigurationError(
            f"{folder.path} predicted classes, not rotations: give runs of task=pose"
        )
    config = OmegaConf.load(folder.config)
    assert isinstance(config, DictConfig)
    small = folder.path / "result.json"
    names = read_json(small)["instance_names"] if small.is_file() else []
    return RunPredictions(folder, arrays, config, tuple(names))


def _check_same_images(first: RunPredictions, other: RunPredictions) -> None:
    """Refuse runs whose test images differ."""
    differs = ""
    if len(first.arrays["instance_id"]) != len(other.arrays["instance_id"]):
        counts = [len(run.arrays["instance_id"]) for run in (first, other)]
        differs = f"{counts[0]:,} and {counts[1]:,} images"
    elif any(not np.array_equal(first.arrays[key], other.arrays[key]) for key in _SAME):
        differs = "other objects or views"
    elif (
        first.instance_names and other.instance_names
        and first.instance_names != other.instance_names
    ):  # fmt: skip
        differs = "objects of other names"
    elif not np.allclose(first.arrays["rotation_true"], other.arrays["rotation_true"], atol=1e-4):
        differs = "other true rotations"
    else:
        for key in ("modality", "image_size"):
            pair = [run.config.data.get(key) for run in (first, other)]
            if pair[0] != pair[1]:
                differs = f"data.{key} {pair[0]} and {pair[1]}"
    if differs:
        raise ConfigurationError(
            f"{first.folder.path} and {other.folder.path} were not tested on the same images "
            f"({differs}): compare runs with the same data settings"
        )


def _names(loaded: Sequence[RunPredictions]) -> list[str]:
    """The models' names; with the seed or the folder where that does not tell the runs apart."""
    model = [str(run.config.model.name) for run in loaded]
    seeded = [f"{name}, seed {run.config.seed}" for name, run in zip(model, loaded, strict=True)]
    for names in (model, seeded, [run.folder.path.name for run in loaded]):
        if len(set(names)) == len(names):
            return names
    return [str(run.folder.path) for run in loaded]


def _datamodule(config: DictConfig, data_root: str | Path | None) -> ImageDataModule:
    # They import Lightning, which imports pyplot; who draws a figure should not need either.
    from i2i.configuration import register_resolvers
    from i2i.runs.building import build_datamodule, follow_root

    register_resolvers()
    config = config.copy()
    if data_root is not None:
        config.data.root = str(data_root)
        follow_root(config)
    return build_datamodule(config)


def _mesh(
    name: str, loaded: Mapping[str, RunPredictions], datamodule: ImageDataModule
) -> RenderMesh | None:
    """The mesh that one of the runs kept of a class, else the data's own."""
    for run in loaded.values():
        path = run.folder.reference_meshes / f"{name}.npz"
        if path.is_file():
            return load_mesh(path)
    return datamodule.reference_mesh(name)
