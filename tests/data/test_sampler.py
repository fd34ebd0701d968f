"""Order of samples: a function of seed and epoch, shared by processes."""

import numpy as np
import pytest
from torch.utils.data import BatchSampler

from i2i.data.sampler import EpochSampler, SliceSampler, permutation


def batches(sampler, epoch):
    sampler.set_epoch(epoch)
    return list(BatchSampler(sampler, sampler.local_batch_size, drop_last=True))


def test_permutation_is_one_and_depends_on_seed_and_number():
    first = permutation(1000, seed=0, number=0)
    assert sorted(first) == list(range(1000))
    assert (first != permutation(1000, seed=0, number=1)).mean() > 0.9
    assert (first != permutation(1000, seed=1, number=0)).mean() > 0.9
    assert (first == permutation(1000, seed=0, number=0)).all()


def test_permutation_is_uniform():
    # Each of 5 samples comes first in a fifth of the permutations: 3,000 draws, 5 sigma = 0.037.
    firsts = [permutation(5, seed=3, number=number)[0] for number in range(3000)]
    assert np.abs(np.bincount(firsts, minlength=5) / 3000 - 0.2).max() < 0.04


def test_one_pass_without_repeats_and_drops_the_last():
    sampler = EpochSampler(103, seed=0, batch_size=10)
    pairs = list(sampler)
    assert len(sampler) == len(pairs) == 100
    assert len({index for index, _ in pairs}) == 100
    assert [position for _, position in pairs] == list(range(100))


def test_positions_go_on_over_epochs():
    sampler = EpochSampler(20, seed=0, batch_size=8)
    positions = [p for epoch in range(3) for batch in batches(sampler, epoch) for _, p in batch]
    assert positions == list(range(48))


@pytest.mark.parametrize("batches_per_epoch", [None, 3, 7])
def test_epoch_does_not_depend_on_history(batches_per_epoch):
    options = {"seed": 5, "batch_size": 4, "batches_per_epoch": batches_per_epoch}
    running = EpochSampler(18, **options)
    history = [batches(running, epoch) for epoch in range(4)]
    assert batches(EpochSampler(18, **options), 3) == history[3]
    assert history[0] != history[1]


def test_virtual_epochs_use_each_sample_equally_often():
    sampler = EpochSampler(10, seed=0, batch_size=4, batches_per_epoch=5)
    indices = [i for epoch in range(3) for batch in batches(sampler, epoch) for i, _ in batch]
    for start in range(0, 60, 10):
        assert sorted(indices[start : start + 10]) == list(range(10))


@pytest.mark.parametrize("batches_per_epoch", [None, 5])
@pytest.mark.parametrize("world_size", [2, 4])
def test_processes_share_the_batch_of_one_process(world_size, batches_per_epoch):
    options = {"seed": 1, "batch_size": 8, "batches_per_epoch": batches_per_epoch}
    alone = batches(EpochSampler(50, **options), 2)
    ranks = [
        batches(EpochSampler(50, rank=rank, world_size=world_size, **options), 2)
        for rank in range(world_size)
    ]
    joint = [[pair for part in parts for pair in part] for parts in zip(*ranks, strict=True)]
    assert joint == alone


def test_slices_are_disjoint_and_complete():
    slices = [[i for i, _ in SliceSampler(11, rank=rank, world_size=3)] for rank in range(3)]
    assert sorted(index for part in slices for index in part) == list(range(11))
    assert [len(SliceSampler(11, rank=rank, world_size=3)) for rank in range(3)] == [4, 4, 3]


def test_impossible_batches_are_refused():
    with pytest.raises(ValueError, match="3 training samples"):
        EpochSampler(3, seed=0, batch_size=4)
    with pytest.raises(ValueError, match="multiple of 4"):
        EpochSampler(100, seed=0, batch_size=6, world_size=4)
    with pytest.raises(ValueError, match="at least 1"):
        EpochSampler(100, seed=0, batch_size=6, batches_per_epoch=0)
