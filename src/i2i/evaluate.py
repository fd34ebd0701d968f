"""Every metric of a trained run on its test set: `python -m i2i.evaluate run=runs/<name>`."""

from pathlib import Path
from typing import Any

from lightning import Trainer
from omegaconf import DictConfig, OmegaConf

from i2i.callbacks.distributions import DistributionImages
from i2i.callbacks.record import PredictionRecord
from i2i.cli import door
from i2i.configuration import register_resolvers, slug
from i2i.data.info import DataInfo
from i2i.errors import ConfigurationError
from i2i.finishing import draw
from i2i.runs.building import build_datamodule, follow_root
from i2i.runs.folder import RunFolder, write_json
from i2i.runs.loading import load_task, locate
from i2i.runs.results import summarise
from i2i.viz.compare import compare_errors, compare_runs
from i2i.viz.style import save_figure


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Test a checkpoint again, with other data settings if wanted.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        Metrics by name, intervals and per-instance errors; also written to `metrics.json`.
    """
    register_resolvers()
    folder, checkpoint = locate(cfg.run, cfg.ckpt)
    compared = [folder.path, *(locate(run)[0].path for run in cfg.compare)]
    task = load_task(checkpoint)
    changes = {key: value for key, value in cfg.data.items() if value is not None}
    config = OmegaConf.merge(task.run_config, {"data": changes})
    assert isinstance(config, DictConfig)
    follow_root(config)
    datamodule = build_datamodule(config)
    _check_same_data(task.info, datamodule.info)
    datamodule.prepare_data()
    output = RunFolder(Path(cfg.output) if cfg.output else folder.path / _folder_name(changes))
    record = PredictionRecord(output.predictions)
    trainer = Trainer(
        accelerator=cfg.trainer.accelerator,
        devices=cfg.trainer.devices,
        precision=cfg.trainer.precision or config.trainer.precision,
        logger=False,
        callbacks=[record, DistributionImages()],
        use_distributed_sampler=False,
        enable_model_summary=False,
        default_root_dir=str(output.path),
    )
    trainer.test(task, datamodule=datamodule, verbose=False)
    if not trainer.is_global_zero:
        return {"metrics": {}, "intervals": {}, "output": str(output.path)}
    summary = summarise(record.arrays, task.info, retrieval_samples=cfg.retrieval_samples)
    write_json(output.metrics, summary)
    draw(output, record.arrays, task.info, datamodule)
    if cfg.compare:
        _compare(compared, output, cfg.data.root)
    return summary | {"output": str(output.path)}


def _compare(runs: list[Path], output: RunFolder, data_root: str | None) -> None:
    """Draw this run's predictions beside those of others (the qualitative figure of the paper)."""
    figures = {
        "comparison": compare_runs(runs, data_root=data_root),
        "comparison_errors": compare_errors(runs),
    }
    for name, figure in figures.items():
        path = save_figure(figure, output.figures / f"{name}.png")
        print(f"figure {path}")


def _folder_name(changes: dict[str, Any]) -> str:
    """`evaluation`, or with what was changed, so that no evaluation overwrites another."""
    kept = {k: v for k, v in changes.items() if k not in ("root", "store_root")}
    return "-".join(["evaluation", *(slug(f"{key}-{value}") for key, value in kept.items())])


def _check_same_data(trained: DataInfo, given: DataInfo) -> None:
    """Refuse data that mean something else than those of the training.

    Raises:
        ConfigurationError: naming the field and both values.
    """
    for field in ("class_names", "channels", "image_size", "modality", "num_points", "camera_set"):
        asked, known = getattr(given, field), getattr(trained, field)
        if asked != known:
            raise ConfigurationError(
                f"the run was trained with {field} {known}, these data have {asked}: leave the "
                "data's object, modality and sizes as they were"
            )


@door("evaluate")
def main(cfg: DictConfig) -> None:
    """Print every metric of a run with its interval."""
    summary = evaluate(cfg)
    if not summary["metrics"]:
        return
    for name, value in summary["metrics"].items():
        interval = summary["intervals"].get(name)
        tail = f"  [{interval[0]:.4g}, {interval[1]:.4g}]" if interval else ""
        print(f"test/{name} {value:.4g}{tail}")
    print(f"written to {summary['output']}")


if __name__ == "__main__":
    main()
