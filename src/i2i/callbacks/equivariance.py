"""Measured equivariance during training, as curves."""

from __future__ import annotations

import logging
import math
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from i2i.testing.measured import END_TO_END, Measurement, measure

log = logging.getLogger(__name__)


class EquivarianceCurve(Callback):
    """Logs ``equivariance/<layer>``: the largest relative error when the image is turned.

    For a layer that no turn of the image speaks to, such as the feature sphere of the group
    convolution, it is the error of the layer alone; a second group of the same layer has its name
    behind it. ``equivariance/end_to_end_deg`` is the median error of the predicted rotation under
    quarter turns. The images are the first of the validation set, the same ones each time, and
    training is the same with and without this callback.

    Args:
        every_n_validations: Measure at the first validation and then at each n-th.
        max_images: How many images.

    Raises:
        ValueError: If a number is below 1.
    """

    def __init__(self, *, every_n_validations: int = 5, max_images: int = 4) -> None:
        if every_n_validations < 1 or max_images < 1:
            raise ValueError(
                f"every_n_validations={every_n_validations} and max_images={max_images} must be "
                "at least 1; callbacks.equivariance=null turns the curves off."
            )
        self.every_n_validations = every_n_validations
        self.max_images = max_images
        self._validations = 0
        self._warned = False
        self._batch: dict[str, Tensor] | None = None

    def state_dict(self) -> dict[str, Any]:
        """The count of validations, so that a resumed run measures at the same ones."""
        return {"validations": self._validations}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Invert `state_dict`."""
        self._validations = int(state_dict["validations"])

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,  # noqa: ANN401 - Lightning's signature
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the first images; a batch that is smaller than `max_images` is enough."""
        if batch_idx == 0 and dataloader_idx == 0 and trainer.is_global_zero and "image" in batch:
            self._batch = {name: value[: self.max_images] for name, value in batch.items()}

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measure and log, from the first process only."""
        if trainer.sanity_checking:
            return
        due = self._validations % self.every_n_validations == 0
        self._validations += 1
        batch, self._batch = self._batch, None
        if not due or batch is None or not trainer.loggers:
            return
        try:
            # A network may draw random numbers; training must not notice.
            with isolate_rng(include_cuda=pl_module.device.type == "cuda"):
                rows = measure(
                    pl_module.network,  # type: ignore[arg-type]
                    batch,
                    symmetry=getattr(getattr(pl_module, "info", None), "symmetry", ()),
                )
        except Exception as error:  # a curve is never worth a training run
            self._warn(f"{type(error).__name__}: {error}")
            return
        values = scalars(rows)
        for logger in trainer.loggers:
            logger.log_metrics(values, step=trainer.global_step)

    def _warn(self, reason: str) -> None:
        if not self._warned:
            log.warning("equivariance is not measured: %s", reason)
        self._warned = True


def scalars(rows: list[Measurement]) -> dict[str, float]:
    """One finite number for each layer and group, by the name of its curve."""
    values: dict[str, float] = {}
    for row in rows:
        layer = row.layer.replace(" ", "_")
        name = f"equivariance/{layer}"
        if name in values or (row.layer == END_TO_END and row.group != "C4"):
            name = f"{name}_{row.group}"
        value = row.max_error if row.max_from_image is None else row.max_from_image
        values[name] = value
        if row.angles is not None:
            suffix = name.removeprefix(f"equivariance/{layer}")
            degrees = torch.tensor(row.angles.median).max().item()
            values[f"equivariance/{layer}_deg{suffix}"] = degrees
    return {name: value for name, value in values.items() if math.isfinite(value)}
