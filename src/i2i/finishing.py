"""What a run that went through leaves behind: metrics, the small result, meshes and figures."""

import logging
from pathlib import Path
from typing import Any

from lightning import Callback, Trainer

from i2i.callbacks.record import PredictionRecord
from i2i.data.info import DataInfo
from i2i.data.loaders import ImageDataModule
from i2i.errors import I2IError
from i2i.rendering.reference import decimate_mesh, save_mesh
from i2i.runs.folder import RunFolder, write_json
from i2i.runs.results import Arrays, file_name, result, summarise
from i2i.tasks.base import Task
from i2i.viz.results import result_figures
from i2i.viz.style import save_figure

log = logging.getLogger(__name__)


def finish(
    folder: RunFolder,
    trainer: Trainer,
    task: Task,
    datamodule: ImageDataModule,
    *,
    config: dict[str, Any],
    identity: str,
) -> dict[str, float]:
    """Write metrics and the small result, then meshes and figures.

    Args:
        folder: The run's folder.
        trainer: The trainer that ran the stages.
        task: The trained task.
        datamodule: Its data.
        config: The resolved configuration.
        identity: Its hash.

    Returns:
        Final metrics by name, `test/...`; empty where no test was run, and on all processes but
        the first.
    """
    if not trainer.is_global_zero:
        return {}
    arrays = _recorded(trainer)
    summary: dict[str, Any] = {"metrics": {}}
    if arrays:
        summary = summarise(arrays, task.info)
        write_json(folder.metrics, summary)
        content = result(
            summary,
            config,
            identity=identity,
            instance_names=datamodule.instance_names("test"),
            parameters=sum(p.numel() for p in task.network.parameters() if p.requires_grad),
            steps=trainer.global_step,
        )
        write_json(folder.path / "result.json", content)
        if config["paths"]["results_dir"]:
            write_json(Path(config["paths"]["results_dir"]) / file_name(config, identity), content)
    save_reference_meshes(folder, task.info, datamodule)
    if arrays:
        draw(folder, arrays, task.info, datamodule)
    folder.write_status("done")
    return {f"test/{name}": value for name, value in summary["metrics"].items()}


def save_reference_meshes(folder: RunFolder, info: DataInfo, datamodule: ImageDataModule) -> None:
    """Keep one decimated mesh of each class, so that predictions can be drawn without the data."""
    for name in info.class_names:
        path = folder.reference_meshes / f"{name}.npz"
        mesh = None if path.exists() else datamodule.reference_mesh(name)
        if mesh is not None:
            folder.reference_meshes.mkdir(parents=True, exist_ok=True)
            save_mesh(decimate_mesh(mesh), path)


def draw(folder: RunFolder, arrays: Arrays, info: DataInfo, datamodule: ImageDataModule) -> None:
    """Write the figures of a test; the metrics are safe already, so a failure is only told."""
    folder.figures.mkdir(parents=True, exist_ok=True)
    try:
        for name, figure in result_figures(arrays, info, datamodule).items():
            save_figure(figure, folder.figures / f"{name}.png")
    except (I2IError, ValueError, OSError) as error:
        log.warning("the figures of %s could not be drawn: %s", folder.path, error)


def _recorded(trainer: Trainer) -> Arrays:
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    return next((c.arrays for c in callbacks if isinstance(c, PredictionRecord)), {})
