"""Means, spreads and intervals of finished jobs, and differences in pairs."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from i2i.metrics.bootstrap import (
    Interval,
    instance_bootstrap,
    percentile_interval,
    resampled_counts,
    weighted_median,
)
from i2i.reports.model import Cell
from i2i.reports.results import Result
from i2i.runs.results import pooled_errors

Groups = Mapping[str, Sequence[Result]]
"""Results by class, one a seed."""

_RESAMPLES = 1000
_CHUNK_ELEMENTS = 2**24
_METRIC = "median_error_deg"


def median_cell(groups: Groups) -> Cell:
    """Median error: mean over seeds of the mean over classes, its spread and its interval.

    Args:
        groups: Results by class, one a seed.
    """
    by_class = [
        {result.seed: _median(result, name) for result in results}
        for name, results in groups.items()
    ]
    value = float(np.mean([np.mean(list(seeds.values())) for seeds in by_class]))
    shared = sorted(set.intersection(*(set(seeds) for seeds in by_class)))
    spread = _spread([float(np.mean([seeds[s] for seeds in by_class])) for s in shared])
    pools = [pooled(name, results) for name, results in groups.items()]
    interval = _combined([_resampled(*pool, seed=i) for i, pool in enumerate(pools)], pools)
    seeds = tuple(sorted({seed for seeds in by_class for seed in seeds}))
    return Cell(
        value, spread, interval.low, interval.high, seeds, interval.num_instances, tuple(groups)
    )


def metric_cell(results: Sequence[Result], metric: str, *, factor: float = 1.0) -> Cell | None:
    """A metric of classification: mean over seeds and spread; accuracy has an interval too.

    Args:
        results: One a seed.
        metric: Its name.
        factor: What it is multiplied with, 100 for percent.

    Returns:
        The cell; None where no result has the metric.
    """
    known = [result for result in results if metric in result.metrics]
    if not known:
        return None
    values = [result.metrics[metric] * factor for result in known]
    low = high = None
    if metric == "accuracy" and all("correct" in result.content for result in known):
        interval = instance_bootstrap(*pooled_errors(_fractions(known)), statistic="mean")
        low, high = interval.low * factor, interval.high * factor
    return Cell(
        float(np.mean(values)),
        _spread(values),
        low,
        high,
        tuple(result.seed for result in known),
        max(len(result.content["instance_names"]) for result in known),
        tuple(known[0].classes),
    )


def pooled(class_name: str, results: Sequence[Result]) -> tuple[Tensor, Tensor]:
    """Errors of one class of all seeds, (N,), and the instances that they belong to, (N,)."""
    return pooled_errors([result.only(class_name) for result in results])


def median_gain(reference: Groups, other: Groups) -> tuple[Interval, int] | None:
    """By how much the reference's median error is smaller, resampled in pairs.

    Args:
        reference: Results by class, one a seed.
        other: The same of another method.

    Returns:
        Interval of median(other) − median(reference), averaged over the classes that both have,
        and the number of seeds that both have of each class at least; None where they share no
        class and seed, or were not tested on the same images.
    """
    resampled, pools, counts, values = [], [], [], []
    for index, name in enumerate(n for n in reference if n in other):
        pair = _same_seeds(reference[name], other[name])
        if pair is None or not _same_images(*pair, name):
            return None
        (ours, instance), (theirs, _) = (pooled(name, members) for members in pair)
        first, second = (_resampled(e, instance, seed=index) for e in (theirs, ours))
        resampled.append(first - second)
        values.append((theirs.quantile(0.5) - ours.quantile(0.5)).item())
        pools.append((ours, instance))
        counts.append(len(pair[0]))
    if not resampled:
        return None
    return _combined(resampled, pools, float(np.mean(values))), min(counts)


def accuracy_gain(
    reference: Sequence[Result], other: Sequence[Result], *, factor: float = 1.0
) -> tuple[Interval, int] | None:
    """By how much the reference's accuracy is larger, resampled in pairs; see `median_gain`."""
    pair = _same_seeds(reference, other)
    if pair is None or any("correct" not in r.content for members in pair for r in members):
        return None
    if any(a.content["instance_names"] != b.content["instance_names"] for a, b in zip(*pair)):  # noqa: B905
        return None
    (first, instance), (second, _) = (pooled_errors(_fractions(members)) for members in pair)
    interval = instance_bootstrap((first - second) * factor, instance, statistic="mean")
    return interval, len(pair[0])


def _median(result: Result, class_name: str) -> float:
    """The metric of a class as the job recorded it."""
    for name in (f"{class_name}/{_METRIC}", *([_METRIC] if len(result.classes) == 1 else [])):
        if name in result.metrics:
            return float(result.metrics[name])
    return float(np.median(np.concatenate(result.only(class_name)["errors_deg"])))


def _spread(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _fractions(results: Sequence[Result]) -> list[dict[str, object]]:
    """Fractions of correct views in the place of errors, one an instance."""
    return [
        {
            "job": {"seed": result.seed},
            "instance_names": result.content["instance_names"],
            "errors_deg": [[fraction] for fraction in result.content["correct"]],
        }
        for result in results
    ]


def _same_seeds(
    first: Sequence[Result], second: Sequence[Result]
) -> tuple[list[Result], list[Result]] | None:
    seeds = {r.seed for r in first} & {r.seed for r in second}
    if not seeds:
        return None
    ours, theirs = (
        sorted((r for r in members if r.seed in seeds), key=lambda r: r.seed)
        for members in (first, second)
    )
    return ours, theirs


def _same_images(first: Sequence[Result], second: Sequence[Result], class_name: str) -> bool:
    """Whether each pair was tested on the same instances in the same order, with as many views."""

    def images(result: Result) -> list[tuple[str, int]]:
        kept = result.only(class_name)
        counts = [len(errors) for errors in kept["errors_deg"]]
        return list(zip(kept["instance_names"], counts, strict=True))

    return all(images(a) == images(b) for a, b in zip(first, second, strict=True))


def _resampled(errors: Tensor, instance: Tensor, *, seed: int) -> Tensor:
    """Medians of resamples of whole instances: (R,); the draws depend on the seed alone."""
    unique, member = instance.unique(return_inverse=True)
    counts = resampled_counts(len(unique), _RESAMPLES, seed)
    rows = max(1, _CHUNK_ELEMENTS // len(errors))
    return torch.cat([weighted_median(errors, c[:, member]) for c in counts.split(rows)])


def _combined(
    resampled: Sequence[Tensor], pools: Sequence[tuple[Tensor, Tensor]], value: float = 0.0
) -> Interval:
    """Interval of the mean over classes, whose instances are resampled independently."""
    instances = sum(len(instance.unique()) for _, instance in pools)
    return percentile_interval(value, torch.stack(list(resampled)).mean(dim=0), 0.95, instances)
