"""Confidence intervals that resample instances: the views of one object are not independent."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Interval:
    """A statistic with its bootstrap interval.

    Attributes:
        value: The statistic of the sample itself.
        low: Lower end.
        high: Upper end.
        num_instances: How many instances were resampled.
    """

    value: float
    low: float
    high: float
    num_instances: int


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Averaging median of `values` (N,) where sample i counts weights[r, i] times: (R,)."""
    order = values.argsort()
    cumulative = weights[:, order].cumsum(dim=1)  # (R, N)
    total = cumulative[:, -1:]
    # The two middle samples of `total` copies; the same one where the number is odd.
    lower = torch.searchsorted(cumulative, (total - 1) // 2, right=True)
    upper = torch.searchsorted(cumulative, total // 2, right=True)
    ordered = values[order]
    return (ordered[lower] + ordered[upper]).squeeze(1) / 2


def _weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    scaled = weights.to(values.dtype)
    return (scaled @ values) / scaled.sum(dim=1)


_STATISTICS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "median": weighted_median,
    "mean": _weighted_mean,
}


def instance_bootstrap(
    values: Tensor,
    instance_id: Tensor,
    *,
    statistic: str = "median",
    num_resamples: int = 1000,
    level: float = 0.95,
    seed: int = 0,
    chunk_elements: int = 2**24,
) -> Interval:
    """Percentile interval of a statistic over views, resampling whole instances.

    Args:
        values: (N,) one number per view, e.g. errors in degrees, or 0/1 for a fraction.
        instance_id: (N,) which instance each view shows.
        statistic: `"median"` (averaging) or `"mean"`.
        num_resamples: Number of resamples.
        level: Coverage of the interval.
        seed: Seed of the resampling; the result is a function of the inputs and this.
        chunk_elements: Bound on the elements of an intermediate tensor.

    Raises:
        ValueError: If there are no values, or the statistic is unknown.

    Example:
        >>> values = torch.tensor([1.0, 3.0, 2.0, 4.0])
        >>> instance_bootstrap(values, torch.tensor([0, 0, 1, 1])).value
        2.5
    """
    if statistic not in _STATISTICS:
        raise ValueError(
            f"statistic={statistic!r} is not known: choose one of {', '.join(_STATISTICS)}"
        )
    if values.numel() == 0:
        raise ValueError("no values to resample")
    function = _STATISTICS[statistic]
    values = values.double().cpu()
    unique, member = instance_id.cpu().unique(return_inverse=True)
    num_instances = len(unique)
    counts = resampled_counts(num_instances, num_resamples, seed)

    rows = max(1, chunk_elements // len(values))
    resampled = torch.cat([function(values, chunk[:, member]) for chunk in counts.split(rows)])
    value = function(values, torch.ones(1, len(values), dtype=torch.int64))
    return percentile_interval(value.item(), resampled, level, num_instances)


def paired_median_difference(
    first: Tensor,
    second: Tensor,
    instance_id: Tensor,
    *,
    num_resamples: int = 1000,
    level: float = 0.95,
    seed: int = 0,
) -> Interval:
    """Interval of median(first) − median(second) over the same views of the same objects.

    Both are resampled with the same instances, so what the objects have in common drops out.

    Args:
        first: (N,) one number per view.
        second: (N,) the other's numbers of the same views.
        instance_id: (N,) which instance each view shows.
        num_resamples: Number of resamples.
        level: Coverage of the interval.
        seed: Seed of the resampling.

    Example:
        >>> first, second = torch.tensor([3.0, 5.0]), torch.tensor([1.0, 2.0])
        >>> paired_median_difference(first, second, torch.tensor([0, 1])).value
        2.5
    """
    first, second = first.double().cpu(), second.double().cpu()
    unique, member = instance_id.cpu().unique(return_inverse=True)
    weights = resampled_counts(len(unique), num_resamples, seed)[:, member]
    resampled = weighted_median(first, weights) - weighted_median(second, weights)
    value = first.quantile(0.5) - second.quantile(0.5)
    return percentile_interval(value.item(), resampled, level, len(unique))


def resampled_counts(num_instances: int, num_resamples: int, seed: int) -> Tensor:
    """How often each instance is drawn in each resample: (R, I)."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(num_instances, (num_resamples, num_instances), generator=generator)
    counts = torch.zeros(num_resamples, num_instances, dtype=torch.int64)
    return counts.scatter_add_(1, drawn, torch.ones_like(drawn))


def percentile_interval(
    value: float, resampled: Tensor, level: float, num_instances: int
) -> Interval:
    """The central part of resampled statistics (R,), around the statistic of the sample itself."""
    tail = (1 - level) / 2
    low, high = torch.quantile(resampled, torch.tensor([tail, 1 - tail], dtype=torch.float64))
    return Interval(value, low.item(), high.item(), num_instances)
