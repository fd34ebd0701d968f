"""The instance bootstrap against a loop and against what is known."""

import numpy as np
import pytest
import torch

from i2i.metrics.bootstrap import instance_bootstrap


@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_agrees_with_a_loop(statistic):
    rng = np.random.default_rng(0)
    instance = rng.integers(0, 7, size=60) * 10
    values = rng.exponential(size=60) + instance / 20
    result = instance_bootstrap(
        torch.from_numpy(values), torch.from_numpy(instance), statistic=statistic, num_resamples=150
    )
    drawn = torch.randint(7, (150, 7), generator=torch.Generator().manual_seed(0)).numpy()
    names, function = np.unique(instance), getattr(np, statistic)
    resampled = [
        function(np.concatenate([values[instance == names[i]] for i in row])) for row in drawn
    ]
    assert result.value == pytest.approx(function(values))
    low, high = np.quantile(resampled, [0.025, 0.975])
    assert (result.low, result.high) == pytest.approx((low, high))
    assert result.num_instances == 7


def test_chunks_and_seeds():
    values, instance = torch.rand(50), torch.arange(50) // 5
    whole = instance_bootstrap(values, instance, statistic="mean")
    chunked = instance_bootstrap(values, instance, statistic="mean", chunk_elements=100)
    assert (chunked.low, chunked.high) == pytest.approx((whole.low, whole.high))
    other = instance_bootstrap(values, instance, statistic="mean", seed=1)
    assert (other.low, other.high) != (whole.low, whole.high)


def test_views_of_one_instance_are_not_independent():
    """Copying every view a hundred times must not narrow the interval."""
    values, instance = torch.rand(20), torch.arange(20)
    once = instance_bootstrap(values, instance)
    often = instance_bootstrap(values.repeat(100), instance.repeat(100))
    assert (often.low, often.high) == pytest.approx((once.low, once.high))
    independent = instance_bootstrap(values.repeat(100), torch.arange(2000))
    assert independent.high - independent.low < 0.5 * (once.high - once.low)


def test_errors():
    with pytest.raises(ValueError, match="median, mean"):
        instance_bootstrap(torch.ones(2), torch.zeros(2), statistic="mode")
    with pytest.raises(ValueError, match="no values"):
        instance_bootstrap(torch.ones(0), torch.zeros(0))
