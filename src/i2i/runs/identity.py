"""The identity of a job: a hash of everything that could change its result, and nothing else."""

import hashlib
import json
from typing import Any

# Where things lie, how they are shown, and on what they run: not part of what a job computes.
_LEFT_OUT = (
    "paths", "hydra", "logger", "callbacks", "run_name", "run_dir", "label", "resume",
    "print_config", "run",
)  # fmt: skip
_LEFT_OUT_OF_DATA = (
    "root", "store_root", "num_workers", "render_workers", "eval_batch_size", "strict",
)  # fmt: skip
_ROOT_IS_THE_DATASET = ("meshes", "images")
_KEPT_OF_TRAINER = (
    "max_steps", "max_epochs", "precision", "gradient_clip_val", "accumulate_grad_batches",
    "devices",
)  # fmt: skip


def identity_config(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides a job's result."""
    kept = {key: value for key, value in config.items() if key not in _LEFT_OUT}
    data = {k: v for k, v in config.get("data", {}).items() if k not in _LEFT_OUT_OF_DATA}
    if data.get("name") in _ROOT_IS_THE_DATASET:
        data["root"] = str(config["data"].get("root"))
    if isinstance(data.get("source"), dict):
        data["source"] = {k: v for k, v in data["source"].items() if k != "root"}
    kept["data"] = data
    trainer = config.get("trainer", {})
    kept["trainer"] = {
        key: value
        for key, value in trainer.items()
        if key in _KEPT_OF_TRAINER or key.startswith(("limit_", "overfit_", "fast_"))
    }
    return kept


def config_hash(config: dict[str, Any]) -> str:
    """Twelve hexadecimal digits that name a job, from its resolved plain configuration."""
    text = json.dumps(identity_config(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
