"""The HPARAMS tab of TensorBoard, with final metrics."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

from lightning import Callback, LightningModule, Trainer

from i2i.callbacks.events import tensorboard_loggers

log = logging.getLogger(__name__)

Scalar = bool | int | float | str


class HyperparameterMetrics(Callback):
    """Writes hyper-parameters and final metrics together, once, at the end.

    TensorBoard shows a run in its HPARAMS tab only if both come in one call with flat scalars.
    Use it with ``TensorBoardLogger(default_hp_metric=False)``. Parameters are the resolved
    configuration of the run, ``pl_module.run_config``; metrics are what was logged last.

    Args:
        stage: After which stage: ``"test"``, or ``"fit"`` for runs without a test.
        prefixes: Which logged metrics count, by the start of their names; metrics of the given
            stage if None.
        exclude: Top-level keys of the configuration that say where things lie, not what they are.
    """

    def __init__(
        self,
        *,
        stage: str = "test",
        prefixes: Sequence[str] | None = None,
        exclude: Sequence[str] = ("paths", "hydra", "logger", "callbacks"),
    ) -> None:
        if stage not in ("fit", "test"):
            raise ValueError(f"stage={stage!r} is unknown. Allowed: fit, test.")
        self.stage = stage
        default = ("test/",) if stage == "test" else ("train/", "val/")
        self.prefixes = default if prefixes is None else tuple(prefixes)
        self.exclude = frozenset(exclude)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write after training."""
        if self.stage == "fit":
            self._write(trainer, pl_module)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write after testing."""
        if self.stage == "test":
            self._write(trainer, pl_module)

    def _write(self, trainer: Trainer, pl_module: LightningModule) -> None:
        loggers = tensorboard_loggers(trainer)
        if not loggers or not trainer.is_global_zero:
            return
        metrics = {
            name: float(value)
            for name, value in trainer.callback_metrics.items()
            if name.startswith(self.prefixes) and math.isfinite(float(value))
        }
        if not metrics:
            log.warning(
                "HyperparameterMetrics: no finite metric starts with %s; the HPARAMS tab stays "
                "empty.", " or ".join(self.prefixes),
            )  # fmt: skip
            return
        config = {
            key: value
            for key, value in dict(getattr(pl_module, "run_config", {})).items()
            if key not in self.exclude
        }
        for logger in loggers:
            logger.log_hyperparams(flatten(config), metrics=metrics)


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Scalar]:
    """Nested settings as flat scalars, names joined by dots, lists and None as text.

    Example:
        >>> flatten({"model": {"width": 8, "strides": [2, 1]}, "resume": None})
        {'model.width': 8, 'model.strides': '[2, 1]', 'resume': 'None'}
    """
    flat: dict[str, Scalar] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten(value, prefix=f"{name}.")
        else:
            flat[name] = value if isinstance(value, bool | int | float | str) else str(value)
    return flat
