"""Orientation of an object from one image."""

from typing import Any

from torch import Tensor, nn

from i2i.metrics.rotation import PoseErrors
from i2i.models.prediction import PosePrediction
from i2i.tasks.base import Batch, Task


class PoseTask(Task):
    """Trains and scores a pose network; errors are angles in degrees.

    Logs `val/...` and `test/...` of `PoseErrors`: median and mean error, fractions under 15° and
    30°, flips beyond 150°, accuracy over the 60 elements where the network has them, and each
    per class.

    Args:
        network: Maps a batch to a `PosePrediction`.
        **settings: Of `Task`.
    """

    def __init__(self, network: nn.Module, **settings: Any) -> None:  # noqa: ANN401 - see Task
        super().__init__(network, **settings)
        names, symmetry = self.info.class_names, self.info.symmetry
        self.errors = nn.ModuleDict({s: PoseErrors(names, symmetry) for s in ("val", "test")})

    def _errors(self, stage: str) -> PoseErrors:
        metric = self.errors[stage]
        assert isinstance(metric, PoseErrors)
        return metric

    def update_metrics(
        self, stage: str, prediction: PosePrediction, batch: Batch
    ) -> dict[str, Tensor]:
        """Add the errors of a batch; hands on `group_correct` (B,) where there is a group."""
        correct = None
        group_correct = getattr(self.network, "group_correct", None)
        if prediction.logits is not None and group_correct is not None:
            correct = group_correct(prediction, batch)
        self._errors(stage).update(
            prediction.rotation,
            batch["rotation"],
            class_id=batch["class_id"],
            instance_id=batch["instance_id"],
            group_correct=correct,
        )
        return {} if correct is None else {"group_correct": correct}

    def compute_metrics(self, stage: str) -> dict[str, Tensor]:
        """Scores of a stage; resets them."""
        metric = self._errors(stage)
        values: dict[str, Tensor] = metric.compute()
        metric.reset()
        return {name: value.float() for name, value in values.items()}
