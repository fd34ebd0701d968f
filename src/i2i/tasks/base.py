"""What the tasks share: one step for all stages, the optimiser, and where the metrics go."""

from collections.abc import Callable
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from i2i.data.info import DataInfo
from i2i.nn.data_parallel import share_batch
from i2i.nn.processes import num_processes, sum_over_processes

Batch = dict[str, Tensor]

CHECKPOINT_FORMAT = 2
"""Of what i2i adds to a checkpoint; raised whenever an older version could not read it."""


class Task(LightningModule):
    """Runs a network, its loss, its metrics and its optimiser; nothing else.

    The network maps a batch to a prediction and `network.loss(prediction, batch)` to a dict of
    named terms that are already weighted; the task adds them up. Validation and test steps return
    `{"prediction": ..., "batch": ..., ...}`, which is what callbacks draw and write.

    Args:
        network: The network, called with a batch.
        optimizer: Makes an optimiser from the network's parameters.
        scheduler: Makes a learning-rate scheduler from the optimiser; None keeps the rate.
        scheduler_interval: `"step"` or `"epoch"`: when the scheduler moves.
        info: What the data are.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        scheduler_interval: str,
        info: DataInfo,
    ) -> None:
        super().__init__()
        self.network = network
        self.info = info
        self.make_optimizer = optimizer
        self.make_scheduler = scheduler
        self.scheduler_interval = scheduler_interval
        self.run_config: dict[str, Any] = {}

    def forward(self, batch: Batch) -> Any:  # noqa: ANN401 - the prediction type is the task's
        """The network's prediction for a batch."""
        return self.network(batch)

    def on_train_start(self) -> None:
        """Spare processes that share a batch what they need not tell each other slowly."""
        model = self.trainer.strategy.model
        if isinstance(model, DistributedDataParallel):
            share_batch(model)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Loss of one batch, logged with its terms."""
        terms = self.network.loss(self.network(batch), batch)  # type: ignore[operator]
        parts = torch.stack(list(terms.values()))
        loss, size = parts.sum(), len(batch["class_id"])
        # Of the joint batch, in one exchange: Lightning's own would wait for every process.
        joint = sum_over_processes(parts)[0] / num_processes()
        self.log("train/loss", joint.sum(), prog_bar=True, batch_size=size)
        names = [f"train/loss_{name}" for name in terms]
        self.log_dict(dict(zip(names, joint, strict=True)), batch_size=size)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Predict, log the loss, feed the metrics."""
        return self._evaluation_step(batch, "val")

    def test_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Predict, log the loss, feed the metrics."""
        return self._evaluation_step(batch, "test")

    def _evaluation_step(self, batch: Batch, stage: str) -> dict[str, Any]:
        prediction = self.network(batch)
        terms = self.network.loss(prediction, batch)  # type: ignore[operator]
        loss = torch.stack(list(terms.values())).sum()
        self.log(
            f"{stage}/loss",
            loss,
            on_step=False,
            on_epoch=True,
            sync_dist=True,
            batch_size=len(batch["class_id"]),
        )
        more = self.update_metrics(stage, prediction, batch)
        return {"prediction": prediction, "batch": batch, **more}

    def on_validation_epoch_end(self) -> None:
        """Log what the validation images gave."""
        self._log_metrics("val")

    def on_test_epoch_end(self) -> None:
        """Log what the test images gave."""
        self._log_metrics("test")

    def _log_metrics(self, stage: str) -> None:
        values = self.compute_metrics(stage)
        # The metrics are reduced already: the mean over processes that Lightning asks for is idle.
        self.log_dict({f"{stage}/{name}": value for name, value in values.items()}, sync_dist=True)

    def update_metrics(
        self,
        stage: str,
        prediction: Any,  # noqa: ANN401 - the task's own type
        batch: Batch,
    ) -> dict[str, Tensor]:
        """Add a batch to the metrics of a stage (`"val"` or `"test"`).

        Returns:
            What the step hands on to callbacks beside prediction and batch, by name.
        """
        raise NotImplementedError

    def compute_metrics(self, stage: str) -> dict[str, Tensor]:
        """Values of a stage's metrics by name, reduced over processes; resets them."""
        raise NotImplementedError

    def configure_optimizers(self) -> Any:  # noqa: ANN401 - one of Lightning's many forms
        """The optimiser, and its scheduler if there is one."""
        optimizer = self.make_optimizer(self.network.parameters())
        if self.make_scheduler is None:
            return optimizer
        scheduler = self.make_scheduler(optimizer)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": self.scheduler_interval},
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Put plain data into the checkpoint, enough to rebuild the task from it alone."""
        checkpoint["i2i"] = {
            "format": CHECKPOINT_FORMAT,
            "config": self.run_config,
            "data": self.info.to_dict(),
        }
