"""Learning-rate schedules that PyTorch does not have in a form that any number of steps can use."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def one_cycle(
    optimizer: Optimizer,
    *,
    total_steps: int,
    warmup_fraction: float = 0.1,
    start: float = 0.04,
    end: float = 1e-5,
) -> LambdaLR:
    """Cosine from `start` up to the optimiser's rate, then cosine down to `end`, in one run.

    PyTorch's own one-cycle schedule divides by zero when the warm-up is a single step.

    Args:
        optimizer: Its learning rate is the peak.
        total_steps: Optimiser steps of the run; the rate stays at `end` after them.
        warmup_fraction: Part of the steps until the peak.
        start: First rate as a fraction of the peak.
        end: Last rate as a fraction of the peak.

    Raises:
        ValueError: if the number of steps is not given.
    """
    if total_steps is None or total_steps < 1:
        raise ValueError(
            f"one_cycle needs the number of steps, got {total_steps}: set trainer.max_steps"
        )
    warmup = max(1, round(warmup_fraction * total_steps))

    def factor(step: int) -> float:
        if step < warmup:
            return start + (1 - start) * (1 - math.cos(math.pi * step / warmup)) / 2
        progress = min(1.0, (step - warmup) / max(1, total_steps - 1 - warmup))
        return end + (1 - end) * (1 + math.cos(math.pi * progress)) / 2

    return LambdaLR(optimizer, factor)
