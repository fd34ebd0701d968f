"""Train and test one network: `python -m i2i.train model=i2i task=pose data=shapenet_bed`."""

import logging
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from i2i.cli import door, given_overrides, refuse
from i2i.configuration import plain, register_resolvers
from i2i.data.loaders import ImageDataModule
from i2i.errors import ConfigurationError
from i2i.runs.building import build_datamodule, build_task
from i2i.runs.folder import RunFolder, versions, write_json, write_yaml
from i2i.runs.identity import config_hash
from i2i.runs.loading import load_weights, read_checkpoint
from i2i.runs.results import finish
from i2i.tasks.base import Task

log = logging.getLogger(__name__)

# What may be typed beside resume=...: where things lie and on what they run, not what is computed.
_WITH_RESUME = ("resume", "run=", "paths.", "trainer.", "data.root", "data.num_workers", "hydra.")


@dataclass(frozen=True)
class RunResult:
    """What a run gave.

    Attributes:
        metrics: Final metrics by name, `test/...`.
        run_dir: The run's folder.
        task: The trained task.
        datamodule: Its data.
    """

    metrics: dict[str, float]
    run_dir: Path
    task: Task
    datamodule: ImageDataModule


def train(cfg: DictConfig) -> RunResult:
    """Run the stages of `cfg.run`: fit, then test, then the figures and the small result file.

    Args:
        cfg: The composed configuration of this door (`i2i.configuration.compose`).

    Raises:
        ConfigurationError: if parts of the configuration do not fit together.
    """
    register_resolvers()
    folder = RunFolder(_run_dir(cfg))
    if cfg.resume:
        cfg = _resumed(cfg, folder)
    config = plain(cfg)
    _refuse_ddp_in_multirun(config)
    identity = config_hash(config)
    seed_everything(cfg.seed, workers=True, verbose=False)

    datamodule = build_datamodule(cfg)
    datamodule.prepare_data()
    task = build_task(cfg, datamodule.info)
    trainer = _trainer(cfg, folder)
    if trainer.is_global_zero:
        _open(folder, config, identity, resumed=bool(cfg.resume))
    try:
        _run_stages(cfg, folder, trainer, task, datamodule)
    except BaseException as error:
        _close_broken(folder, trainer, error)
        raise
    metrics = finish(folder, trainer, task, config=config, identity=identity)
    return RunResult(metrics, folder.path, task, datamodule)


def _run_dir(cfg: DictConfig) -> Path:
    """Hydra's folder when Hydra runs the job, else the one that the configuration names."""
    if HydraConfig.initialized() and not cfg.resume:
        return Path(HydraConfig.get().runtime.output_dir)
    return Path(cfg.run_dir)


def _resumed(cfg: DictConfig, folder: RunFolder) -> DictConfig:
    """The saved configuration of the run to go on with, and of the new one what may change."""
    refuse(
        given_overrides(),
        allowed=_WITH_RESUME,
        reason=f"resume={cfg.resume} goes on with that run's own configuration",
    )
    if not folder.config.is_file():
        raise ConfigurationError(
            f"resume={cfg.resume}: no config.yaml there; give the folder of a run, such as "
            "resume=runs/<name>"
        )
    saved = OmegaConf.create(yaml.safe_load(folder.config.read_text()))
    assert isinstance(saved, DictConfig)
    typed = OmegaConf.from_dotlist(
        [o.lstrip("+") for o in given_overrides() if o.startswith(("trainer.", "data.", "paths."))]
    )
    merged = OmegaConf.merge(saved, typed, {"resume": cfg.resume, "run": cfg.run})
    assert isinstance(merged, DictConfig)
    merged.run_dir = str(folder.path)
    return merged


def _refuse_ddp_in_multirun(config: dict[str, Any]) -> None:
    """Lightning's extra processes repeat the whole command line, which would repeat the sweep.

    Raises:
        ConfigurationError: for a sweep with more than one device a job.
    """
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return
    devices, strategy = config["trainer"]["devices"], str(config["trainer"].get("strategy"))
    if devices not in (1, "1", "auto") and "spawn" not in strategy and "fork" not in strategy:
        raise ConfigurationError(
            f"a sweep (-m) with trainer.devices={devices}: every extra process would start the "
            "whole sweep again. Use trainer.devices=1, or trainer.strategy=ddp_spawn"
        )


def _trainer(cfg: DictConfig, folder: RunFolder) -> Trainer:
    callbacks: list[Callback] = [
        instantiate(
            c, **({"dirpath": str(folder.checkpoints)} if "ModelCheckpoint" in c._target_ else {})
        )
        for c in cfg.callbacks.values()
        if c is not None
    ]
    logger = instantiate(cfg.logger, save_dir=str(folder.path)) if cfg.logger else False
    return instantiate(
        cfg.trainer, callbacks=callbacks, logger=logger, default_root_dir=str(folder.path),
        _convert_="all",
    )  # fmt: skip


def _open(folder: RunFolder, config: dict[str, Any], identity: str, *, resumed: bool) -> None:
    if not resumed:
        write_yaml(folder.config, config)
    write_json(folder.path / "versions.json", versions())
    folder.write_status("running", config_hash=identity, command=shlex.join(sys.argv))


def _run_stages(
    cfg: DictConfig, folder: RunFolder, trainer: Trainer, task: Task, data: ImageDataModule
) -> None:
    last = folder.checkpoints / "last.ckpt"
    if "fit" in cfg.run:
        resume_from = str(last) if cfg.resume and last.is_file() else None
        if resume_from:
            load_weights(task, read_checkpoint(last), last)  # a clear error before Lightning's
            log.info("going on from %s", last)
        trainer.fit(task, datamodule=data, ckpt_path=resume_from)
    elif cfg.resume:
        load_weights(task, read_checkpoint(folder.checkpoint()), folder.checkpoint())
    else:
        raise ConfigurationError(f"run={list(cfg.run)} without fit needs resume=<run folder>")
    if "test" in cfg.run:
        if cfg.test.ckpt == "best":
            best = folder.checkpoint("best")
            load_weights(task, read_checkpoint(best), best)
        trainer.test(task, datamodule=data, verbose=False)


def _close_broken(folder: RunFolder, trainer: Trainer, error: BaseException) -> None:
    """Leave a status behind, and tell how to go on."""
    if not trainer.is_global_zero:
        return
    interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
    folder.write_status("interrupted" if interrupted else "failed", error=str(error)[:500])
    if (folder.checkpoints / "last.ckpt").is_file():
        print(
            f"stopped; the last checkpoint is kept. Go on with:  "
            f"python -m i2i.train resume={folder.path}",
            file=sys.stderr,
        )


@rank_zero_only
def _print_metrics(metrics: dict[str, float], run_dir: Path) -> None:
    for name, value in metrics.items():
        print(f"{name} {value:.4g}")
    print(f"run {run_dir}")
    for figure in sorted((run_dir / "figures").glob("*.png")):
        print(f"figure {figure}")


@door("train")
def main(cfg: DictConfig) -> None:
    """Train and test one network, or every job of a sweep."""
    if cfg.print_config:
        print(OmegaConf.to_yaml(cfg, resolve=True))
    torch.set_float32_matmul_precision("high")
    result = train(cfg)
    _print_metrics(result.metrics, result.run_dir)


if __name__ == "__main__":
    main()
