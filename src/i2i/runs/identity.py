"""The identity of a job: a hash of everything that could change its result, and nothing else."""

import hashlib
import json
from typing import Any

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from i2i.configuration import compose, plain

# Where things lie, how they are shown, and on what they run: not part of what a job computes.
_LEFT_OUT_OF_DATA = (
    "root", "store_root", "num_workers", "render_workers", "eval_batch_size", "strict",
)  # fmt: skip
_ROOT_IS_THE_DATASET = ("meshes", "images")
_KEPT_OF_TRAINER = (
    "max_steps", "max_epochs", "precision", "gradient_clip_val", "accumulate_grad_batches",
    "devices",
)  # fmt: skip


def identity_config(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides a job's result.

    The scale is not in it: what a job takes from it stands resolved in its model, data, task and
    trainer. Settings without a value are not either, so that a new one changes no older identity.
    """
    task, model = config["task"], config["model"]
    data = {k: v for k, v in config["data"].items() if k not in _LEFT_OUT_OF_DATA}
    if data.get("name") in _ROOT_IS_THE_DATASET:
        data["root"] = str(config["data"].get("root"))
    if isinstance(data.get("source"), dict):
        data["source"] = {k: v for k, v in data["source"].items() if k != "root"}
    trainer = {
        key: value
        for key, value in config["trainer"].items()
        if key in _KEPT_OF_TRAINER or key.startswith(("limit_", "overfit_", "fast_"))
    }
    kept = {
        "seed": config["seed"],
        "task": task,
        "model": {"name": model["name"], "network": model["networks"].get(task["name"])},
        "data": data,
        "trainer": trainer,
        "test": config.get("test"),
    }
    without_nulls: dict[str, Any] = _without_nulls(kept)
    return without_nulls


def config_hash(config: dict[str, Any]) -> str:
    """Twelve hexadecimal digits that name a job, from its resolved plain configuration."""
    text = json.dumps(identity_config(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def changes(config: dict[str, Any]) -> dict[str, Any] | None:
    """In what a job differs from the plain `model=… task=… data=… scale=…` of the same names.

    Returns:
        Dotted key -> value of the job, None where the plain one has it and the job does not; or
        None where there is no plain one, such as for a model file of another package.
    """
    groups = ("model", "task", "data", "scale")
    try:
        standard = plain(compose([f"{group}={config[group]['name']}" for group in groups]))
    except (HydraException, OmegaConfBaseException, KeyError):
        return None
    ours, theirs = _flat(identity_config(config)), _flat(identity_config(standard))
    return {
        key: ours.get(key)
        for key in sorted(ours.keys() | theirs.keys())
        if ours.get(key) != theirs.get(key)
    }


def _without_nulls(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    if isinstance(value, dict):
        return {k: _without_nulls(v) for k, v in value.items() if v is not None}
    return value


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
