"""What the train door does: a run from its configuration to its result, alone or in a sweep."""

import gc
import logging
import os
import shlex
import sys
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from i2i.callbacks.record import PredictionRecord
from i2i.callbacks.steps import StopAfterSteps
from i2i.cli import given_overrides, refuse
from i2i.configuration import plain, register_resolvers
from i2i.data.loaders import ImageDataModule
from i2i.errors import ConfigurationError, NonFiniteLossError
from i2i.finishing import finish
from i2i.nn.c4_dispatch import convolution_mode
from i2i.runs.building import build_datamodule, build_task, follow_root
from i2i.runs.folder import RunFolder, versions, write_json, write_yaml
from i2i.runs.identity import config_hash
from i2i.runs.loading import load_weights, read_checkpoint
from i2i.runs.locks import holder, job_lock
from i2i.runs.progress import find_broken, find_done
from i2i.runs.saving import AtomicCheckpointIO
from i2i.sweeping import run_job
from i2i.tasks.base import Task

log = logging.getLogger(__name__)

# What may be typed beside resume=...: where things lie and on what they run, not what is computed.
_WITH_RESUME = (
    "resume", "run=", "trainer.accelerator", "trainer.devices", "trainer.strategy",
    "trainer.enable_", "data.root", "data.store_root", "data.num_workers",
    "convolution",
)  # fmt: skip
LOCKS = ".locks"
"""Folder of the jobs' locks, below the folder of the runs."""


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
    folder = RunFolder(Path(cfg.run_dir))
    if cfg.resume:
        cfg = _resumed(cfg, folder)
    identity = config_hash(plain(cfg))
    runs_dir = Path(cfg.paths.runs_dir)
    with ExitStack() as stack:
        if folder.path.resolve().parent == runs_dir.resolve():
            ours = stack.enter_context(job_lock(runs_dir / LOCKS, identity))
            if cfg.resume and not (ours or _is_one_of_several()):
                raise ConfigurationError(
                    f"resume={cfg.resume}: this job is running "
                    f"({holder(runs_dir / LOCKS, identity)}); wait for it or stop it"
                )
        return _train(cfg, folder, identity)


def _is_one_of_several() -> bool:
    """Whether this process is one of those of a run on several devices, which share its lock."""
    return any(name in os.environ for name in ("LOCAL_RANK", "RANK", "SLURM_PROCID"))


def train_in_sweep(cfg: DictConfig) -> RunResult | None:
    """One job of a sweep: begin it, go on with a broken run of it, or leave it to who runs it.

    Args:
        cfg: The composed configuration of the job.

    Returns:
        What the run gave; None where there was nothing to do.
    """
    register_resolvers()
    if cfg.resume:
        return train(cfg)
    config = plain(cfg)
    identity = config_hash(config)
    locks = Path(cfg.paths.runs_dir) / LOCKS
    with job_lock(locks, identity) as ours:
        if not ours:
            print(f"skipped: {holder(locks, identity)} is running this job", flush=True)
            return None
        if done := find_done(config, identity):  # since the sweep was planned
            print(f"skipped: done already ({done})", flush=True)
            return None
        broken = find_broken(config, identity)
        cfg.resume = str(broken) if broken else None
        cfg.run_dir = str(broken or f"{config['run_dir']}-{identity[:8]}")
        return _train(cfg, RunFolder(Path(cfg.run_dir)), identity)


def _train(cfg: DictConfig, folder: RunFolder, identity: str) -> RunResult:
    config = plain(cfg)
    seed_everything(cfg.seed, workers=True, verbose=False)
    datamodule = build_datamodule(cfg)
    trainer = _trainer(cfg, folder)
    task = build_task(cfg, datamodule.info)  # what does not fit is told before anything is made
    if trainer.is_global_zero:
        _open(folder, config, identity, resumed=bool(cfg.resume))
    try:
        datamodule.prepare_data()
        with convolution_mode(cfg.get("convolution", "auto")):  # older runs do not have it
            _run_stages(cfg, folder, trainer, task, datamodule)
            metrics = finish(folder, trainer, task, datamodule, config=config, identity=identity)
    except BaseException as error:
        _close_broken(folder, trainer, error)
        raise
    return RunResult(metrics, folder.path, task, datamodule)


def _in_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


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
    words = [word.lstrip("+") for word in given_overrides()]
    typed = OmegaConf.from_dotlist(
        [w for w in words if w.startswith(("trainer.", "data.", "convolution="))]
    )
    merged = OmegaConf.merge(saved, typed, {"resume": cfg.resume, "run": cfg.run})
    assert isinstance(merged, DictConfig)
    merged.run_dir = str(folder.path)
    follow_root(merged)
    return merged


def _check_processes(cfg: DictConfig, trainer: Trainer) -> None:
    """Refuse ways of starting processes that would lose results or repeat a sweep.

    Raises:
        ConfigurationError: naming the reason and what to use instead.
    """
    if cfg.trainer.get("sync_batchnorm"):
        raise ConfigurationError(
            "trainer.sync_batchnorm=true would replace batch norms that know C4 fields; those of "
            "i2i share their statistics over processes already. Leave it out; parts of your own "
            "take i2i.nn.batch_norm.JointBatchNorm2d"
        )
    if trainer.world_size > 1 and _in_sweep():
        raise ConfigurationError(
            f"a sweep (-m) with {trainer.world_size} processes a job: every extra process would "
            "start the whole sweep again. Use trainer.devices=1"
        )
    # By name: the class is Lightning's own business.
    if "_MultiProcessingLauncher" in [c.__name__ for c in type(trainer.strategy.launcher).__mro__]:
        raise ConfigurationError(
            "trainer.strategy with spawn or fork: its processes end with the test and take the "
            "predictions with them. Use trainer.strategy=ddp"
        )


def _trainer(cfg: DictConfig, folder: RunFolder) -> Trainer:
    callbacks: list[Callback] = [instantiate(c) for c in cfg.callbacks.values() if c is not None]
    for callback in callbacks:  # they write into the run's folder, which the YAML files do not know
        if isinstance(callback, ModelCheckpoint):
            callback.dirpath = str(folder.checkpoints.absolute())
        elif isinstance(callback, PredictionRecord):
            callback.path = folder.predictions
    length = {}
    if cfg.trainer.max_steps > 0:
        callbacks.append(StopAfterSteps(cfg.trainer.max_steps))
        epoch = cfg.data.get("batches_per_epoch")  # the progress bar counts epochs of this length
        epochs = -(-cfg.trainer.max_steps // epoch) if epoch else -1
        length = {"max_steps": -1, "max_epochs": epochs}
    logger = instantiate(cfg.logger, save_dir=str(folder.path)) if cfg.logger else False
    plugins = [instantiate(plugin) for plugin in cfg.trainer.get("plugins") or ()]
    trainer: Trainer = instantiate(
        cfg.trainer,
        **length,
        callbacks=callbacks,
        plugins=[AtomicCheckpointIO(), *plugins],
        logger=logger,
        default_root_dir=str(folder.path),
        _convert_="all",
    )
    if isinstance(trainer.strategy, DDPStrategy):
        # Gradients are added up where they lie: torch would copy them to its buckets and back.
        trainer.strategy._ddp_kwargs.setdefault("gradient_as_bucket_view", True)
    _check_processes(cfg, trainer)
    return trainer


def _open(folder: RunFolder, config: dict[str, Any], identity: str, *, resumed: bool) -> None:
    if not resumed:
        if folder.config.exists() and not _in_sweep() and not folder.got_nowhere():
            raise ConfigurationError(
                f"{folder.path} holds a run already: go on with it by resume={folder.path}, or "
                "choose another run_name"
            )
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
    """Tell how to go on, and leave a status behind."""
    if not trainer.is_global_zero or not folder.status.exists():
        return
    interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
    if isinstance(error, NonFiniteLossError):
        pass  # going on would come to the same; the error itself says what to change
    elif (folder.checkpoints / "last.ckpt").is_file():
        print(
            f"stopped; the last checkpoint is kept. Go on with:  "
            f"python -m i2i.train resume={folder.path}",
            file=sys.stderr,
        )
    elif interrupted:
        print(
            "stopped before the first checkpoint: there is nothing to go on from; type the same "
            "command again",
            file=sys.stderr,
        )
    with suppress(OSError):  # the disk may be what is full
        folder.write_status("interrupted" if interrupted else "failed", error=str(error)[:500])


@rank_zero_only
def _print_metrics(metrics: dict[str, float], run_dir: Path) -> None:
    for name, value in metrics.items():
        print(f"{name} {value:.4g}")
    print(f"run {run_dir}")
    for figure in sorted((run_dir / "figures").glob("*.png")):
        print(f"figure {figure}")


def _train_one(cfg: DictConfig) -> None:
    result = train_in_sweep(cfg)
    if result is not None:
        _print_metrics(result.metrics, result.run_dir)


def _clean() -> None:
    """Free what the figures and the device of a job hold."""
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    gc.collect()
    torch.cuda.empty_cache()


def refuse_table() -> None:
    """Refuse a table without -m: it would be a single run with the settings of none of its jobs.

    Raises:
        ConfigurationError: with the command that runs the table.
    """
    if HydraConfig.initialized() and HydraConfig.get().sweeper.get("grids"):
        words = shlex.join(given_overrides())
        raise ConfigurationError(
            f"this experiment is a sweep of many jobs: python -m i2i.train -m {words}"
        )


def run(cfg: DictConfig) -> None:
    """What the train door does: one network, or a job of a sweep."""
    register_resolvers()  # a launcher may have started this process
    if cfg.print_config:
        print(OmegaConf.to_yaml(cfg, resolve=True))
    if _in_sweep():
        run_job(lambda: _train_one(cfg), clean=_clean)
        return
    refuse_table()
    result = train(cfg)
    _print_metrics(result.metrics, result.run_dir)
