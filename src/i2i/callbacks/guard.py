"""Stops training at the first number that is not finite, before it reaches the weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim import Optimizer

from i2i.errors import NonFiniteLossError

_SHOWN = 16


class NonFiniteLossGuard(Callback):
    """Raises `NonFiniteLossError` when the loss or a gradient is NaN or infinite.

    The loss is looked at before the backward pass and the gradients before the optimiser's step,
    so the weights, and any checkpoint written afterwards, are those of the last good step.

    Args:
        check_gradients: Look at the gradients too. Left out by itself under 16-mixed precision,
            whose scaler meets infinite gradients on purpose and skips those steps.
    """

    def __init__(self, *, check_gradients: bool = True) -> None:
        self.check_gradients = check_gradients
        self._batch: Any = None
        self._batch_idx = 0

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Remember which batch is being looked at."""
        self._batch, self._batch_idx = batch, batch_idx

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,  # noqa: ANN401 - Lightning's signature
        batch: Any,  # noqa: ANN401
        batch_idx: int,
    ) -> None:
        """Let the batch go."""
        self._batch = None

    def on_before_backward(
        self, trainer: Trainer, pl_module: LightningModule, loss: Tensor
    ) -> None:
        """Check the loss.

        Raises:
            NonFiniteLossError: if it is not finite.
        """
        if not bool(torch.isfinite(loss.detach()).all()):
            raise NonFiniteLossError(self._message(trainer, f"The loss is {loss.item()}"))

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Check the gradients.

        Raises:
            NonFiniteLossError: if one is not finite.
        """
        if not self.check_gradients or trainer.precision == "16-mixed":
            return
        gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
        if gradients and not bool(torch.isfinite(torch.stack(_sums(gradients)).sum())):
            broken = [
                name
                for name, parameter in pl_module.named_parameters()
                if parameter.grad is not None and not torch.isfinite(parameter.grad).all()
            ]
            if broken:  # large finite values may overflow in the sum alone
                what = f"The gradient of {', '.join(broken[:3])} is not finite"
                raise NonFiniteLossError(self._message(trainer, what))

    def _message(self, trainer: Trainer, what: str) -> str:
        return (
            f"{what} at optimiser step {trainer.global_step} (epoch {trainer.current_epoch}, "
            f"batch {self._batch_idx}{_describe(self._batch)}). Training stopped before this "
            f"reached the weights. {_last_checkpoint(trainer)} If the batch's images are fine, "
            f"lower the learning rate ({_rate_of(trainer.lightning_module)}=), clip gradients "
            "(trainer.gradient_clip_val=10) or use trainer.precision=32, and train again."
        )


def _rate_of(task: LightningModule | None) -> str:
    """The setting of the learning rate: a network with a recipe of its own has it there."""
    config = getattr(task, "run_config", None) or {}
    recipe = (config.get("scale") or {}).get("recipe")
    own = ((config.get("model") or {}).get("recipes") or {}).get(recipe) or {}
    return f"model.recipes.{recipe}.optimizer.lr" if "optimizer" in own else "scale.optimizer.lr"


def _sums(gradients: list[Tensor]) -> list[Tensor]:
    """One number per gradient that is finite if all its entries are (barring overflow)."""
    return [torch.linalg.vector_norm(gradient).float() for gradient in gradients]


def _describe(batch: Any) -> str:  # noqa: ANN401 - whatever a loader gives
    """Which instances and views are in the batch, and whether its own numbers are finite."""
    if not isinstance(batch, dict):
        return ""
    text = ""
    for key, name in (("instance_id", "instances"), ("view_id", "views")):
        if key in batch:
            ids = batch[key].tolist()
            more = f", … {len(ids)} in all" if len(ids) > _SHOWN else ""
            text += f"; {name} {', '.join(map(str, ids[:_SHOWN]))}{more}"
    bad = [
        key
        for key, value in batch.items()
        if isinstance(value, Tensor) and value.is_floating_point() and not value.isfinite().all()
    ]
    return text + (f"; not finite in the data themselves: {', '.join(bad)}" if bad else "")


def _last_checkpoint(trainer: Trainer) -> str:
    """A sentence on the newest checkpoint that was written."""
    paths = [
        Path(path)
        for callback in trainer.checkpoint_callbacks
        for path in (getattr(callback, "last_model_path", ""),
                     getattr(callback, "best_model_path", ""))
        if path
    ]  # fmt: skip
    there = [path for path in paths if path.is_file()]
    if not there:
        return "No checkpoint had been written yet."
    newest = max(there, key=lambda path: path.stat().st_mtime_ns)
    return f"The last good checkpoint is kept: {newest}."
