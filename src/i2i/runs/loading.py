"""The one way to load a checkpoint: read it without running code, check, build, load."""

import pickle
from pathlib import Path
from typing import Any

import torch
from torch import nn

from i2i.data.info import DataInfo
from i2i.errors import CheckpointError, ConfigurationError
from i2i.runs.building import build_task
from i2i.runs.folder import RunFolder
from i2i.runs.weights import WEIGHTS, read_weights
from i2i.tasks.base import CHECKPOINT_FORMAT, Task


def move_to(network: nn.Module, device: str | torch.device) -> nn.Module:
    """The network on a device.

    Raises:
        ConfigurationError: if this machine, or this build of torch, does not have it.
    """
    try:
        return network.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigurationError(
            f"device={device} is not to be had here ({error}); use device=cpu"
        ) from error


def locate(run: str | Path, ckpt: str = "last") -> tuple[RunFolder, Path]:
    """The run folder and the checkpoint file that a user means by `run`.

    A folder that `python -m i2i.export` wrote stands for a run folder with one checkpoint.

    Raises:
        CheckpointError: if there is neither.
    """
    path = Path(run)
    if path.is_file():
        beside = path.resolve().parent
        return RunFolder(beside.parent if beside.name == "checkpoints" else beside), path
    if not path.is_dir():
        raise CheckpointError(
            f"run={run}: no such run folder or checkpoint; `ls -t runs` shows the newest runs"
        )
    folder = RunFolder(path)
    exported = path / WEIGHTS
    if not exported.is_file() or folder.checkpoints.is_dir():
        return folder, folder.checkpoint(ckpt)
    if ckpt != "last":
        raise CheckpointError(
            f"ckpt={ckpt}: {run} was exported and has one set of weights; leave ckpt out"
        )
    return folder, exported


def load_task(path: Path) -> Task:
    """Rebuild a task from a checkpoint alone, in evaluation mode, with the checkpoint's weights.

    Raises:
        CheckpointError: if the file is no checkpoint of ours, is damaged, or does not fit.
    """
    checkpoint = read_checkpoint(path)
    ours = checkpoint["i2i"]
    config = ours["config"]
    if config["model"].get("pretrained"):  # all weights are in the checkpoint
        config = {**config, "model": _without_pretrained(config["model"])}
    task = build_task(config, DataInfo.from_dict(ours["data"]))
    task.run_config = ours["config"]
    load_weights(task, checkpoint, path)
    return task.eval()


def _without_pretrained(model: dict[str, Any]) -> dict[str, Any]:
    """A resolved model that starts from scratch."""
    networks = {
        task: network if network is None else {**network, "pretrained": None}
        for task, network in model["networks"].items()
    }
    return {**model, "pretrained": None, "networks": networks}


def load_weights(task: Task, checkpoint: dict[str, Any], path: Path) -> None:
    """Put a checkpoint's weights into a task.

    Raises:
        CheckpointError: if names or shapes differ, for example for another number of classes.
    """
    try:
        task.load_state_dict(checkpoint["state_dict"])
    except RuntimeError as error:
        classes = checkpoint["i2i"]["data"]["class_names"]
        raise CheckpointError(
            f"{path} does not fit this network: it was trained for {len(classes)} class(es) "
            f"({', '.join(classes)}), the network is for {task.info.num_classes} "
            f"({', '.join(task.info.class_names)}). {str(error).splitlines()[-1].strip()}. "
            "Use the configuration of its own run folder: run=<folder>"
        ) from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint without running any code that it might hold.

    Raises:
        CheckpointError: if it is not one of ours, of another format, or damaged.
    """
    checkpoint: dict[str, Any]
    try:
        if path.suffix == ".safetensors":
            checkpoint = read_weights(path)
        else:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path} cannot be read as a checkpoint ({first}). If it was cut short, use another: "
            "ckpt=best or ckpt=last of its run folder"
        ) from error
    if not isinstance(checkpoint, dict) or "i2i" not in checkpoint:
        raise CheckpointError(
            f"{path} is not a checkpoint of i2i: use one that `python -m i2i.train` wrote"
        )
    found = checkpoint["i2i"].get("format")
    if found != CHECKPOINT_FORMAT:
        raise CheckpointError(
            f"{path} has format {found}, this version of i2i reads format {CHECKPOINT_FORMAT}: "
            "train again, or use the version that wrote it"
        )
    return checkpoint
