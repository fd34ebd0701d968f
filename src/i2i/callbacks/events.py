"""Writing figures and histograms to whatever TensorBoard loggers a trainer has."""

from __future__ import annotations

import torch
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from torch import Tensor

from i2i.viz.style import figure_to_array


def tensorboard_loggers(trainer: Trainer) -> list[TensorBoardLogger]:
    """The trainer's TensorBoard loggers; empty if there are none."""
    return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


def log_figure(trainer: Trainer, name: str, figure: Figure) -> None:
    """Log a figure as an image at the current step; nothing happens without TensorBoard."""
    loggers = tensorboard_loggers(trainer)
    if not loggers or not trainer.is_global_zero:
        return
    # Not add_figure(), which imports pyplot and its global state.
    pixels = torch.from_numpy(figure_to_array(figure))
    for logger in loggers:
        logger.experiment.add_image(name, pixels, trainer.global_step, dataformats="HWC")


def log_histogram(trainer: Trainer, name: str, values: Tensor) -> None:
    """Log finite values as a histogram at the current step; nothing happens without TensorBoard."""
    finite = values[torch.isfinite(values)]
    if finite.numel() == 0 or not trainer.is_global_zero:
        return
    for logger in tensorboard_loggers(trainer):
        logger.experiment.add_histogram(name, finite, trainer.global_step)
