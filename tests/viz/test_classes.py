"""Confusion matrix against torchmetrics."""

import numpy as np
import torch
from torchmetrics.functional.classification import multiclass_confusion_matrix

from i2i.viz.classes import confusion_figure, confusion_matrix


def test_counts_agree_with_torchmetrics_and_are_drawn_as_shares():
    rng = np.random.default_rng(0)
    true, predicted = rng.integers(0, 4, 50), rng.integers(0, 4, 50)
    counts = confusion_matrix(true, predicted=predicted, num_classes=4)
    reference = multiclass_confusion_matrix(
        torch.from_numpy(predicted), torch.from_numpy(true), num_classes=4
    )
    np.testing.assert_array_equal(counts, reference.numpy())
    axes = confusion_figure(true, predicted=predicted, class_names=["a", "b", "c", "d"]).axes[0]
    np.testing.assert_allclose(np.asarray(axes.images[0].get_array()).sum(axis=1), 100.0)
    assert f"{100 * (true == predicted).mean():.1f}" in axes.get_title()
