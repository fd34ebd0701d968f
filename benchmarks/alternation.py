"""Timing by turns: what is compared runs alternately in one process."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Seconds of one variant: the median, and the first and third quartile."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        digits = 0 if self.median >= 0.1 else 1 if self.median >= 0.01 else 2
        middle, low, high = (f"{x * 1e3:.{digits}f}" for x in (self.median, self.low, self.high))
        return f"{middle} [{low}, {high}]"


def alternate(
    variants: Mapping[str, Callable[[], object]],
    *,
    repeats: int,
    warm_up: int = 1,
    finish: Callable[[], object] = lambda: None,
) -> dict[str, Timing]:
    """Run the variants in turn and time each.

    Args:
        variants: What to call, by name.
        repeats: Timed rounds; at least 2.
        warm_up: Rounds before them.
        finish: Called before the clock is read; on a GPU, `torch.cuda.synchronize`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for turn in range(warm_up + repeats):
        for name, run in variants.items():
            finish()
            start = time.perf_counter()
            run()
            finish()
            if turn >= warm_up:
                seconds[name].append(time.perf_counter() - start)
    timings = {}
    for name, times in seconds.items():
        low, middle, high = statistics.quantiles(times, n=4, method="inclusive")
        timings[name] = Timing(middle, low, high)
    return timings
