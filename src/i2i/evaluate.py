"""Every metric of a trained run on its test set: `python -m i2i.evaluate run=runs/<name>`."""

from pathlib import Path
from typing import Any

from lightning import Trainer
from omegaconf import DictConfig, OmegaConf

from i2i.callbacks.record import PredictionRecord
from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.runs.building import build_datamodule
from i2i.runs.folder import RunFolder, write_json
from i2i.runs.loading import load_task, locate
from i2i.runs.results import draw, summarise


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Test a checkpoint again, with other data settings if wanted.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        Metrics by name, intervals and per-instance errors; also written to `metrics.json`.
    """
    register_resolvers()
    folder, checkpoint = locate(cfg.run, cfg.ckpt)
    task = load_task(checkpoint)
    config = OmegaConf.merge(task.run_config, {"data": cfg.data})
    assert isinstance(config, DictConfig)
    if config.data.get("root") != task.run_config["data"].get("root"):
        config.data.source.root = config.data.root
    datamodule = build_datamodule(config)
    datamodule.prepare_data()
    output = RunFolder(Path(cfg.output) if cfg.output else folder.path / "evaluation")
    record = PredictionRecord(output.predictions)
    trainer = Trainer(
        accelerator=cfg.trainer.accelerator,
        devices=cfg.trainer.devices,
        precision=cfg.trainer.precision or config.trainer.precision,
        logger=False,
        callbacks=[record],
        use_distributed_sampler=False,
        enable_model_summary=False,
        default_root_dir=str(output.path),
    )
    trainer.test(task, datamodule=datamodule, verbose=False)
    summary = summarise(record.arrays, task.info, retrieval_samples=cfg.retrieval_samples)
    if trainer.is_global_zero:
        write_json(output.metrics, summary)
        draw(output, record.arrays, task, datamodule)
    return summary | {"output": str(output.path)}


@door("evaluate")
def main(cfg: DictConfig) -> None:
    """Print every metric of a run with its interval."""
    summary = evaluate(cfg)
    for name, value in summary["metrics"].items():
        interval = summary["intervals"].get(name)
        tail = f"  [{interval[0]:.4g}, {interval[1]:.4g}]" if interval else ""
        print(f"test/{name} {value:.4g}{tail}")
    print(f"written to {summary['output']}")


if __name__ == "__main__":
    main()
