"""Where the configuration lies, its resolvers, and composing it from Python."""

import hashlib
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from i2i.errors import ConfigurationError

# The published reading of each of the three fields that `label_frame` sets (docs/conventions.md).
LABEL_FRAMES: dict[str, dict[str, str]] = {
    "consistent": {"target": "view", "group_frame": "conjugated", "projector_axes": "raster"},
    "reference": {"target": "rotation", "group_frame": "standard", "projector_axes": "published"},
}

# In the environment, so that the processes that a trainer starts name the same run folder.
_STARTED = os.environ.setdefault("I2I_STARTED", time.strftime("%Y%m%d-%H%M%S"))
_LONGEST_SLUG = 60


def config_dir() -> str:
    """The folder of the YAML files: inside the installed package, else at the top of the clone."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "conf", package.parents[1] / "conf"):
        if (candidate / "train.yaml").is_file():
            return str(candidate)
    raise FileNotFoundError(
        f"no conf/train.yaml beside {package}: install i2i again, or use a clone"
    )


def compose(overrides: Sequence[str] = (), config_name: str = "train") -> DictConfig:
    """The configuration that a door would get for these command-line words.

    Args:
        overrides: What would be typed, such as `["model=i2i", "scale=tiny"]`.
        config_name: The door: train, evaluate, predict, render or download.

    Returns:
        The composed configuration, not yet resolved.
    """
    register_resolvers()
    if GlobalHydra.instance().is_initialized():
        return hydra_compose(config_name, overrides=list(overrides))
    with initialize_config_dir(config_dir(), version_base="1.3"):
        return hydra_compose(config_name, overrides=list(overrides))


def register_resolvers() -> None:
    """Make the resolvers of the YAML files known to OmegaConf; calling it again changes nothing."""
    resolvers: dict[str, Callable[..., Any]] = {
        "i2i.label_frame": _label_frame,
        "i2i.slug": slug,
        "i2i.started": lambda: _STARTED,
        "i2i.image_size": _image_size,
        "i2i.modality": _first_modality,
        "i2i.coverage": _coverage,
        "i2i.run_dir": _run_dir,
    }
    for name, function in resolvers.items():
        OmegaConf.register_new_resolver(name, function, replace=True)


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as dicts, lists, strings and numbers; it can be pickled safely."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def slug(value: object) -> str:
    """A value as part of a file name: letters, digits, `.`, `_` and `-`."""
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value)
    text = "-".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    clean = re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-") or "none"
    if len(clean) <= _LONGEST_SLUG:
        return clean
    return f"{clean[: _LONGEST_SLUG - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _label_frame(frame: str, field: str) -> str:
    if frame not in LABEL_FRAMES:
        raise ConfigurationError(
            f"label_frame={frame}: allowed are {', '.join(LABEL_FRAMES)}; or set model.target, "
            "model.group_frame and model.projector_axes one by one"
        )
    return LABEL_FRAMES[frame][field]


def modalities(seen: Any, task: str) -> list[str]:  # noqa: ANN401 - a YAML value
    """What a model sees, from its `modalities`: a list, or a list for each task."""
    if isinstance(seen, Mapping):
        seen = seen.get(task) or []
    return list(seen)


def _first_modality(seen: Any, task: str) -> str:  # noqa: ANN401 - a YAML value
    # A model without the task is refused later, by name.
    return next(iter(modalities(seen, task)), "gray")


def _image_size(size: int, stem_mode: str | None) -> int:
    """The exact odd stem wants one pixel more: 129 for 128, 65 for 64."""
    return size + 1 if stem_mode == "odd" and size % 2 == 0 else size


def _coverage(stem_mode: str | None) -> float:
    """Keep the mesh at the same pixels: the odd stem makes a map of 9 cells where others make 8."""
    return 0.8 if stem_mode == "odd" else 0.9


def _run_dir(resume: str | None, runs_dir: str, run_name: str) -> str:
    return resume or f"{runs_dir}/{run_name}"
