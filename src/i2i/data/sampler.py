"""The order of training samples, as a pure function of the seed and the epoch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch.utils.data import Sampler

from i2i.geometry.seeding import uniform_hash


def permutation(num_samples: int, *, seed: int, number: int) -> np.ndarray:
    """Random order of ``num_samples`` samples, the same on every machine and in every process.

    Args:
        num_samples: How many samples to order.
        seed: Seed of the whole stream of permutations.
        number: Which permutation of the stream.

    Returns:
        Indices, shape (num_samples,), int64.
    """
    # Sorting hashed numbers needs no generator whose stream a library could change.
    keys = uniform_hash(seed, np.full(num_samples, number), np.arange(num_samples))
    return np.argsort(keys, kind="stable")


class EpochSampler(Sampler[tuple[int, int]]):
    """Yields (sample index, position) pairs, to be grouped in batches of `local_batch_size`.

    The position counts samples over the whole training, over all processes. Augmentation draws its
    randomness from it, so a batch is the same for any number of loader workers, for any number of
    processes that share it, and after a resume.

    Without ``batches_per_epoch`` epoch e runs through permutation e once and leaves out what does
    not fill a batch. With it, epochs are pieces of one endless stream of permutations.

    Args:
        num_samples: Size of the training set.
        seed: Seed of the order.
        batch_size: Samples in one batch of all processes together.
        batches_per_epoch: Batches in an epoch; None for one pass over the data.
        rank: Number of this process.
        world_size: Number of processes.

    Raises:
        ValueError: if the batch cannot be divided among the processes or exceeds the data.

    Example:
        >>> sampler = EpochSampler(10, seed=0, batch_size=4, batches_per_epoch=None)
        >>> len(sampler), [position for _, position in sampler]
        (8, [0, 1, 2, 3, 4, 5, 6, 7])
    """

    def __init__(
        self,
        num_samples: int,
        *,
        seed: int,
        batch_size: int,
        batches_per_epoch: int | None = None,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if batch_size < 1 or batch_size > num_samples:
            raise ValueError(
                f"batch_size is {batch_size}, but there are {num_samples} training samples: "
                "set data.batch_size to a number from 1 to that, or render more views "
                "(data.views_per_instance)."
            )
        if batch_size % world_size:
            raise ValueError(
                f"batch_size {batch_size} cannot be divided among {world_size} processes: "
                f"set data.batch_size to a multiple of {world_size}."
            )
        if batches_per_epoch is not None and batches_per_epoch < 1:
            raise ValueError(f"batches_per_epoch is {batches_per_epoch}; it must be at least 1.")
        self.num_samples = num_samples
        self.seed = seed
        self.batch_size = batch_size
        self.batches_per_epoch = batches_per_epoch
        self.rank = rank
        self.world_size = world_size
        self.epoch = 0

    @property
    def local_batch_size(self) -> int:
        """Samples of each batch that this process loads."""
        return self.batch_size // self.world_size

    @property
    def num_batches(self) -> int:
        """Batches in an epoch."""
        return self.batches_per_epoch or self.num_samples // self.batch_size

    def __len__(self) -> int:
        return self.num_batches * self.local_batch_size

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch that the next iteration yields (Lightning calls it)."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[tuple[int, int]]:
        positions = self._positions()
        indices = self._indices(positions)
        return iter(list(zip(indices.tolist(), positions.tolist(), strict=True)))

    def _positions(self) -> np.ndarray:
        """Positions of this process in the epoch, shape (len(self),)."""
        start = self.epoch * self.num_batches * self.batch_size
        grid = np.arange(self.num_batches * self.batch_size).reshape(self.num_batches, -1)
        first = self.rank * self.local_batch_size
        return start + grid[:, first : first + self.local_batch_size].reshape(-1)

    def _indices(self, positions: np.ndarray) -> np.ndarray:
        """Samples at the positions, shape of ``positions``."""
        if self.batches_per_epoch is None:
            order = permutation(self.num_samples, seed=self.seed, number=self.epoch)
            return order[positions - self.epoch * self.num_batches * self.batch_size]
        passes, offsets = np.divmod(positions, self.num_samples)
        indices = np.empty_like(positions)
        for number in np.unique(passes):
            order = permutation(self.num_samples, seed=self.seed, number=int(number))
            here = passes == number
            indices[here] = order[offsets[here]]
        return indices


class SliceSampler(Sampler[tuple[int, int]]):
    """In-order (index, index) pairs of every ``world_size``-th sample: disjoint, none left out.

    Args:
        num_samples: Size of the evaluated set.
        rank: Number of this process.
        world_size: Number of processes.
    """

    def __init__(self, num_samples: int, *, rank: int = 0, world_size: int = 1) -> None:
        self.indices = range(rank, num_samples, world_size)

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return ((index, index) for index in self.indices)
