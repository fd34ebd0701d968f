"""A checkpoint as two files that any program can read: safetensors, and a JSON beside it."""

import json
import os
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from i2i.errors import CheckpointError
from i2i.runs.folder import read_json, versions, write_json

WEIGHTS = "model.safetensors"
CONFIG = "config.json"


def write_weights(checkpoint: dict[str, Any], folder: Path, *, made_from: str) -> Path:
    """Write the weights of a checkpoint and what is needed to rebuild the network from them.

    The optimiser's state and the progress of the training are left out.

    Args:
        checkpoint: As `i2i.runs.loading.read_checkpoint` gives it.
        folder: Where to; made where it is missing.
        made_from: Name of the checkpoint, for the record.

    Returns:
        The file of the weights.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / WEIGHTS
    temporary = folder / f".{WEIGHTS}.{os.getpid()}"
    # Copies: tensors that share memory are refused.
    tensors = {name: value.clone().contiguous() for name, value in checkpoint["state_dict"].items()}
    try:
        save_file(tensors, temporary, metadata={"format": "pt"})
        write_json(
            folder / CONFIG,
            {"i2i": checkpoint["i2i"], "checkpoint": made_from, "versions": versions()},
        )
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def read_weights(path: Path) -> dict[str, Any]:
    """The checkpoint that `write_weights` wrote: `state_dict` and `i2i`.

    Raises:
        CheckpointError: if one of the two files is missing or damaged.
    """
    try:
        told = read_json(path.with_name(CONFIG))
        return {"state_dict": load_file(path), "i2i": told["i2i"]}
    except (OSError, json.JSONDecodeError, KeyError, SafetensorError) as error:
        raise CheckpointError(
            f"{path} and {CONFIG} beside it cannot be read as an exported network ({error}): "
            "write them again, python -m i2i.export run=... output=<folder>"
        ) from error
