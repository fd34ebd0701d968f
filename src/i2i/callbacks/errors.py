"""Histogram of rotation errors in TensorBoard."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from i2i.callbacks.events import log_figure, log_histogram
from i2i.geometry.rotations import geodesic_angle_rad
from i2i.models.prediction import PosePrediction
from i2i.viz.errors import error_figure

log = logging.getLogger(__name__)


class ErrorHistogram(Callback):
    """Logs the rotation errors of a whole validation or test set, in degrees.

    ``val/error_deg`` and ``test/error_deg`` as histograms, ``…/errors`` as a figure with the recall
    curve. Networks that predict classes are left alone. With several processes it shows the first
    one's share of the images.
    """

    def __init__(self) -> None:
        self._errors_deg: list[Tensor] = []
        self._warned = False

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._errors_deg = []

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last test."""
        self._errors_deg = []

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: Any, batch_idx: int, dataloader_idx: int = 0,  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Keep a batch's errors."""
        self._keep(outputs, batch)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: Any, batch_idx: int, dataloader_idx: int = 0,  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Keep a batch's errors."""
        self._keep(outputs, batch)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the validation's errors."""
        if not trainer.sanity_checking:
            self._log(trainer, "val")

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the test's errors."""
        self._log(trainer, "test")

    def _keep(self, outputs: Any, batch: Any) -> None:  # noqa: ANN401 - whatever a step returns
        if not isinstance(outputs, Mapping) or "prediction" not in outputs:
            self._warn("the step returned no 'prediction'")
            return
        prediction = outputs["prediction"]
        if isinstance(prediction, PosePrediction):
            angle = geodesic_angle_rad(prediction.rotation.detach().float(), batch["rotation"])
            self._errors_deg.append(torch.rad2deg(angle).cpu())

    def _log(self, trainer: Trainer, stage: str) -> None:
        if not self._errors_deg or not trainer.is_global_zero:
            return
        error_deg = torch.cat(self._errors_deg)
        self._errors_deg = []
        finite = error_deg[torch.isfinite(error_deg)]
        if finite.numel() < error_deg.numel():
            self._warn(
                f"{error_deg.numel() - finite.numel()} of {error_deg.numel()} {stage} errors are "
                "not finite and are left out"
            )
        if finite.numel() == 0:
            return
        log_histogram(trainer, f"{stage}/error_deg", finite)
        heading = f"{stage}, step {trainer.global_step:,}, {finite.numel():,} images"
        log_figure(trainer, f"{stage}/errors", error_figure(finite, heading=heading))

    def _warn(self, reason: str) -> None:
        """Say once what is missing; training goes on."""
        if not self._warned:
            self._warned = True
            log.warning("ErrorHistogram: %s.", reason)
