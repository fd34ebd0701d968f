"""Class of an object in any orientation from one image."""

from typing import Any

from torch import Tensor, nn

from i2i.metrics.classification import ClassAccuracy
from i2i.metrics.retrieval import RetrievalMAP
from i2i.models.prediction import ClassPrediction
from i2i.tasks.base import Batch, Task


class ClassificationTask(Task):
    """Trains and scores a classifier.

    Logs `val/...` and `test/...`: accuracy over views and over classes, and at the test the mean
    average precision in its three readings (`metrics/retrieval.py` tells them apart).

    Args:
        network: Maps a batch to a `ClassPrediction`.
        **settings: Of `Task`.
    """

    def __init__(self, network: nn.Module, **settings: Any) -> None:  # noqa: ANN401 - see Task
        super().__init__(network, **settings)
        self.accuracy = nn.ModuleDict(
            {stage: ClassAccuracy(self.info.class_names) for stage in ("val", "test")}
        )
        self.retrieval = RetrievalMAP()

    def _accuracy(self, stage: str) -> ClassAccuracy:
        metric = self.accuracy[stage]
        assert isinstance(metric, ClassAccuracy)
        return metric

    def update_metrics(
        self, stage: str, prediction: ClassPrediction, batch: Batch
    ) -> dict[str, Tensor]:
        """Add the scores of a batch."""
        self._accuracy(stage).update(prediction.logits, batch["class_id"])
        if stage == "test":
            self.retrieval.update(
                prediction.logits, prediction.descriptor, batch["class_id"], batch["instance_id"]
            )
        return {}

    def compute_metrics(self, stage: str) -> dict[str, Tensor]:
        """Scores of a stage; resets them."""
        values: dict[str, Tensor] = self._accuracy(stage).compute()
        self._accuracy(stage).reset()
        if stage == "test":
            values |= self.retrieval.compute()
            self.retrieval.reset()
        return {name: value.float() for name, value in values.items()}
