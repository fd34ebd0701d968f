"""Accuracies by hand and against torchmetrics."""

import pytest
import torch
from torchmetrics.functional.classification import multiclass_accuracy

from i2i.metrics.classification import ClassAccuracy, confusion_matrix


def test_accuracies():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(200, 3, generator=generator)
    labels = torch.randint(3, (200,), generator=generator)
    metric = ClassAccuracy(["a", "b", "c"])
    metric.update(logits[:50], labels[:50])
    metric.update(logits[50:], labels[50:])
    scores = metric.compute()
    each = multiclass_accuracy(logits, labels, 3, average=None)
    assert scores["accuracy"].item() == pytest.approx(
        multiclass_accuracy(logits, labels, 3, average="micro").item()
    )
    assert scores["macro_accuracy"].item() == pytest.approx(each.mean().item())
    for name, value in zip("abc", each, strict=True):
        assert scores[f"{name}/accuracy"].item() == pytest.approx(value.item())


def test_absent_classes_are_left_out():
    metric = ClassAccuracy(["a", "b", "c"])
    metric.update(torch.eye(3)[[0, 1, 1, 2]], torch.tensor([0, 0, 1, 1]))
    scores = metric.compute()
    assert scores["macro_accuracy"] == 0.5
    assert "c/accuracy" not in scores


def test_confusion_matrix_rows_are_true_classes():
    counts = confusion_matrix(torch.tensor([1, 1, 0]), torch.tensor([0, 0, 1]), 2)
    assert counts.tolist() == [[0, 2], [1, 0]]
