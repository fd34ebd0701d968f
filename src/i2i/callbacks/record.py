"""Writes what the network said about every test image to the run folder."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from i2i.metrics.rotation import error_deg
from i2i.models.prediction import PosePrediction


class PredictionRecord(Callback):
    """Collects per-image test predictions and writes one npz, in the order of the test set.

    The arrays of a pose run: `rotation_true`, `rotation_pred` (N, 3, 3), `error_deg`,
    `element_probability`, `class_id`, `instance_id`, `view_id` (N,), and what the task hands on for
    each image, such as `group_correct` and `log_likelihood` (N,); of a classification run `logits`
    (N, C) and `descriptor` (N, D) instead of the rotations.

    Args:
        path: The file to write; None keeps the arrays in `.arrays` only.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self.arrays: dict[str, np.ndarray] = {}
        self._batches: list[dict[str, Tensor]] = []

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget an earlier test."""
        self._batches = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: dict[str, Tensor], batch_idx: int, dataloader_idx: int = 0,
    ) -> None:  # fmt: skip
        """Keep a batch's predictions on the CPU."""
        prediction = outputs["prediction"]
        kept: dict[str, Tensor] = {}
        for name in ("class_id", "instance_id", "view_id"):
            kept[name] = batch[name]
        if isinstance(prediction, PosePrediction):
            kept["rotation_true"] = batch["rotation"]
            kept["rotation_pred"] = prediction.rotation
            kept["error_deg"] = error_deg(prediction.rotation, batch["rotation"])
            if prediction.log_prob is not None:
                kept["element_probability"] = prediction.log_prob.max(dim=-1).values.exp()
            kept |= {k: v for k, v in outputs.items() if k not in ("prediction", "batch")}
        else:
            kept["logits"] = prediction.logits
            kept["descriptor"] = prediction.descriptor
        self._batches.append({k: v.detach().float().cpu() if v.is_floating_point() else v.cpu()
                              for k, v in kept.items()})  # fmt: skip

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the processes' parts, put them in order, write them from the first process."""
        parts = self._batches
        if trainer.world_size > 1:
            gathered: list[Any] = [None] * trainer.world_size
            torch.distributed.all_gather_object(gathered, parts)
            parts = [batch for rank in gathered for batch in rank]
        if not trainer.is_global_zero or not parts:
            return
        arrays = {k: torch.cat([p[k] for p in parts]).numpy() for k in parts[0]}
        order = np.lexsort((arrays["view_id"], arrays["instance_id"]))
        self.arrays = {k: v[order] for k, v in arrays.items()}
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("wb") as file:
                np.savez_compressed(file, **self.arrays)
