"""Which classes are taken for which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from i2i.viz.style import HEAT, ImageArray, new_figure, to_numpy

_NUMBERS_UP_TO = 12  # classes; beyond, the numbers no longer fit into the cells


def confusion_matrix(true: ImageArray, *, predicted: ImageArray, num_classes: int) -> np.ndarray:
    """Counts with the true class in the row and the predicted one in the column.

    Example:
        >>> confusion_matrix(np.array([0, 1, 1]), predicted=np.array([0, 0, 1]), num_classes=2)
        array([[1, 0],
               [1, 1]])
    """
    pairs = to_numpy(true).astype(np.int64) * num_classes + to_numpy(predicted).astype(np.int64)
    counts = np.bincount(pairs, minlength=num_classes**2)
    return counts.reshape(num_classes, num_classes)


def confusion_figure(
    true: ImageArray, *, predicted: ImageArray, class_names: Sequence[str]
) -> Figure:
    """Share of each true class that was taken for each class, in percent.

    Args:
        true: Class ids, shape (N,).
        predicted: Class ids, shape (N,).
        class_names: Names by id.

    Returns:
        The figure.
    """
    size = len(class_names)
    counts = confusion_matrix(true, predicted=predicted, num_classes=size)
    shares = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = min(max(3.2, 0.45 * size + 1.6), 11.0)
    figure = new_figure(side + 0.8, side)
    axes = figure.subplots()
    drawn = axes.imshow(shares, cmap=HEAT, vmin=0.0, vmax=100.0)
    figure.colorbar(drawn, ax=axes, label="share of the true class (%)", shrink=0.8)
    axes.set_xticks(range(size), class_names, rotation=90, fontsize=8)
    axes.set_yticks(range(size), class_names, fontsize=8)
    accuracy = 100.0 * np.trace(counts) / max(int(counts.sum()), 1)
    axes.set(xlabel="predicted class", ylabel="true class", title=f"accuracy {accuracy:.1f} %")
    axes.title.set_fontsize(10)
    if size <= _NUMBERS_UP_TO:
        for row, column in np.ndindex(size, size):
            color = "black" if shares[row, column] > 60.0 else "white"
            axes.text(column, row, f"{shares[row, column]:.0f}", ha="center", va="center",
                      fontsize=8, color=color)  # fmt: skip
    return figure
