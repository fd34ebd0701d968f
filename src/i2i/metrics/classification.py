"""Accuracy over all views, over classes and for each class."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric


def confusion_matrix(predicted: Tensor, labels: Tensor, num_classes: int) -> Tensor:
    """Counts (true class, predicted class): (C, C) int64."""
    flat = torch.bincount(labels * num_classes + predicted, minlength=num_classes**2)
    return flat.view(num_classes, num_classes)


class ClassAccuracy(Metric):
    """`accuracy` (every view counts), `macro_accuracy` (every class) and `<class>/accuracy`.

    Classes without a test view are left out of the macro mean.

    Args:
        class_names: Names by class id.
        **options: Of `torchmetrics.Metric`, such as `sync_on_compute=False`.

    Example:
        >>> metric = ClassAccuracy(["bed", "desk"])
        >>> metric.update(torch.eye(2), torch.tensor([0, 0]))
        >>> metric.compute()["accuracy"].item()
        0.5
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    confusion: Tensor

    def __init__(self, class_names: Sequence[str], **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self.class_names = tuple(class_names)
        size = len(self.class_names)
        self.add_state(
            "confusion", default=torch.zeros(size, size, dtype=torch.int64), dist_reduce_fx="sum"
        )

    def update(self, logits: Tensor, labels: Tensor) -> None:
        """Add a batch of logits (B, C) and labels (B,)."""
        self.confusion += confusion_matrix(logits.argmax(dim=1), labels, len(self.class_names))

    def compute(self) -> dict[str, Tensor]:
        """The accuracies."""
        correct, count = self.confusion.diagonal().double(), self.confusion.sum(dim=1)
        per_class = correct / count
        scores = {"accuracy": correct.sum() / count.sum(), "macro_accuracy": per_class.nanmean()}
        for index, name in enumerate(self.class_names):
            if count[index] > 0:
                scores[f"{name}/accuracy"] = per_class[index]
        return scores
