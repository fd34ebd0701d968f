"""A run's folder: which file is where, and small files written all at once or not at all."""

import json
import os
import platform
import sys
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

import i2i
from i2i.errors import CheckpointError

_LIBRARIES = ("torch", "lightning", "escnn", "hydra-core", "numpy", "trimesh", "embreex")


@dataclass(frozen=True)
class RunFolder:
    """Paths inside a run's folder.

    Attributes:
        path: The folder itself.
    """

    path: Path

    @property
    def config(self) -> Path:
        """The resolved configuration, YAML."""
        return self.path / "config.yaml"

    @property
    def status(self) -> Path:
        """State, identity and times of the job, JSON."""
        return self.path / "status.json"

    @property
    def metrics(self) -> Path:
        """Final metrics with their intervals, JSON."""
        return self.path / "metrics.json"

    @property
    def predictions(self) -> Path:
        """Per-image predictions on the test set, npz."""
        return self.path / "predictions.npz"

    @property
    def figures(self) -> Path:
        """Folder of the pictures."""
        return self.path / "figures"

    @property
    def reference_meshes(self) -> Path:
        """Folder of one decimated mesh a class, npz."""
        return self.path / "reference_meshes"

    @property
    def checkpoints(self) -> Path:
        """Folder of last.ckpt and best.ckpt."""
        return self.path / "checkpoints"

    def checkpoint(self, which: str = "last") -> Path:
        """The file of the `last` or the `best` checkpoint.

        Raises:
            CheckpointError: if it is not there.
        """
        path = self.checkpoints / f"{which}.ckpt"
        if not path.is_file():
            there = sorted(p.stem for p in self.checkpoints.glob("*.ckpt"))
            raise CheckpointError(
                f"{path} does not exist; {self.path} has "
                + (f"ckpt={' or ckpt='.join(there)}" if there else "no checkpoint yet")
            )
        return path

    def got_nowhere(self) -> bool:
        """Whether the run ended before it had a checkpoint, so that nothing would be lost."""
        state = read_json(self.status).get("state") if self.status.exists() else "failed"
        return state in ("failed", "interrupted") and not any(self.checkpoints.glob("*.ckpt"))

    def write_status(self, state: str, **more: Any) -> None:  # noqa: ANN401 - JSON values
        """Record the state (`running`, `done`, `interrupted`, `failed`) and what goes with it."""
        status = read_json(self.status) if self.status.exists() else {}
        status.update(state=state, updated=time.strftime("%Y-%m-%dT%H:%M:%S%z"), **more)
        write_json(self.status, status)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file as a dict."""
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file so that a reader sees the old or the new one, never a half."""
    _write(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


def write_yaml(path: Path, content: dict[str, Any]) -> None:
    """Write a YAML file so that a reader sees the old or the new one, never a half."""
    _write(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def versions() -> dict[str, str]:
    """Versions of what makes a result."""
    found = {name: metadata.version(name) for name in _LIBRARIES}
    return {"i2i": i2i.__version__, "python": sys.version.split()[0], **found,
            "machine": platform.machine()}  # fmt: skip


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
