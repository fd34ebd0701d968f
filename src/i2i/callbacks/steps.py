"""Ends training after a number of optimiser steps."""

from typing import Any

from lightning import Callback, LightningModule, Trainer


class StopAfterSteps(Callback):
    """Does what `Trainer(max_steps=...)` does, in a way that a resumed run repeats exactly.

    With its own `max_steps` Lightning 2.6 takes a checkpoint from the end of an epoch for one from
    the middle: it passes over a whole epoch's batches before it goes on.

    Args:
        max_steps: Optimiser steps of the whole training.
    """

    def __init__(self, max_steps: int) -> None:
        self.max_steps = max_steps

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A run that is over already stays over."""
        trainer.should_stop = trainer.should_stop or trainer.global_step >= self.max_steps

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: Any, batch_idx: int,  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Stop after the last step."""
        if trainer.global_step >= self.max_steps:
            trainer.should_stop = True
