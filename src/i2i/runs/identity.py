"""The identity of a job: a hash of everything that could change its result, and nothing else."""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from i2i.configuration import compose, plain
from i2i.data.info import CLOUDS

# Where things lie, how they are shown, and on what they run: not part of what a job computes.
_LEFT_OUT_OF_DATA = (
    "root", "store_root", "num_workers", "render_workers", "eval_batch_size", "strict",
)  # fmt: skip
_LEFT_OUT_OF_TRAINER = (
    "_target_", "accelerator", "strategy", "log_every_n_steps", "num_sanity_val_steps",
    "use_distributed_sampler", "deterministic", "benchmark", "detect_anomaly", "profiler",
    "default_root_dir", "barebones", "logger", "callbacks",
)  # fmt: skip
_OF_CLOUDS = (
    "num_points", "cloud_image_size", "rotate_points", "point_dropout", "point_scale",
    "point_scale_per_axis", "point_shift", "point_noise",
)  # fmt: skip
_OF_IMAGES = ("image_size", "shift_px", "test_shift_px", "depth_shift", "test_depth_shift")
# These watch a run; any other callback may change it.
_WATCHING = (
    "checkpoint_last", "checkpoint_best", "record", "learning_rate", "guard", "images",
    "distributions", "equivariance", "histogram", "hparams",
)  # fmt: skip
_ROOT_IS_THE_DATASET = ("meshes", "images")
_USUAL_ROOT = {"sweethome": "/usr/share/sweethome3d/furniture"}  # another folder: other furniture


def identity_config(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides a job's result.

    The scale is not in it: what a job takes from it stands resolved in its model, data, task and
    trainer. Settings without a value are not either, so that a new one changes no older identity.
    """
    task, model = config["task"], config["model"]
    trainer = {
        key: value
        for key, value in config["trainer"].items()
        if key not in _LEFT_OUT_OF_TRAINER and not key.startswith("enable_")
    }
    callbacks = {k: v for k, v in (config.get("callbacks") or {}).items() if k not in _WATCHING}
    network = dict(model["networks"].get(task["name"]) or {})
    if network.get("pretrained"):  # the file by its name: where it lies is no matter
        network["pretrained"] = Path(network["pretrained"]).name
    kept = {
        "seed": config["seed"],
        "task": task,
        "model": {"name": model["name"], "network": network or None},
        "data": _identity_of_data(config["data"]),
        "trainer": trainer,
        "callbacks": callbacks or None,
        "test": config.get("test"),
    }
    normal: dict[str, Any] = _normal(kept)
    return normal


def _settings_of_others(modality: str) -> tuple[str, ...]:
    """Settings that say nothing about data of this modality."""
    if modality not in CLOUDS:
        return _OF_CLOUDS
    return (*_OF_IMAGES, *(() if modality == "partial_points" else ("cloud_image_size",)))


def _identity_of_data(data: dict[str, Any]) -> dict[str, Any]:
    out = (*_LEFT_OUT_OF_DATA, *_settings_of_others(str(data.get("modality"))))
    kept = {k: v for k, v in data.items() if k not in out}
    name, root = data.get("name"), str(data.get("root"))
    if name in _ROOT_IS_THE_DATASET or _USUAL_ROOT.get(str(name), root) != root:
        kept["root"] = str(Path(root).resolve())
    if isinstance(kept.get("source"), dict):
        kept["source"] = {k: v for k, v in kept["source"].items() if k != "root"}
    if isinstance(kept.get("object"), list) and len(kept["object"]) == 1:
        kept["object"] = kept["object"][0]
    return kept


def config_hash(config: dict[str, Any]) -> str:
    """Twelve hexadecimal digits that name a job, from its resolved plain configuration."""
    text = json.dumps(identity_config(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def changes(
    identity: dict[str, Any], *, model: str, task: str, data: str, scale: str
) -> dict[str, Any] | None:
    """In what a job differs from the plain `model=… task=… data=… scale=…`, as it is today.

    Args:
        identity: Of `identity_config`.
        model: Name of the job's model.
        task: Name of its task.
        data: Name of its source.
        scale: Name of its scale.

    Returns:
        Dotted key -> value of the job, None where the plain one has it and the job does not; or
        None where there is no plain one, such as for a model file of another package.
    """
    standard = _standard(model, task, data, scale)
    if standard is None:
        return None
    ours, theirs = _flat(identity), _flat(standard)
    return {
        key: ours.get(key)
        for key in sorted(ours.keys() | theirs.keys())
        if ours.get(key) != theirs.get(key)
    }


@cache
def _standard(model: str, task: str, data: str, scale: str) -> dict[str, Any] | None:
    words = [f"model={model}", f"task={task}", f"data={data}", f"scale={scale}"]
    try:
        return identity_config(plain(compose(words)))
    except (HydraException, OmegaConfBaseException, KeyError):
        return None


def _normal(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    """Without settings that have no value, and 5.0 as 5: how a number was typed is no matter."""
    if isinstance(value, dict):
        return {k: _normal(v) for k, v in value.items() if v is not None}
    if isinstance(value, list):
        return [_normal(v) for v in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
