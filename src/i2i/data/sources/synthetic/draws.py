"""Counter-based random draws: the parameters of one instance depend on its key and nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

_Option = TypeVar("_Option")

# Part of every key: raise it when a change of the shapes should be visible as other instances.
_STREAM = "i2i.synthetic.1"


class Draws:
    """The stream of random parameters of one instance.

    The stream is a Philox counter generator whose key is the SHA-256 of (class, index, seed), so
    an instance is the same whatever was drawn before it, in whatever process.

    Args:
        class_name: Class of the instance.
        index: Number of the instance within its class.
        seed: Seed of the whole source.

    Example:
        >>> Draws("chair", 7, seed=0).integer(0, 99) == Draws("chair", 7, seed=0).integer(0, 99)
        True
    """

    def __init__(self, class_name: str, index: int, *, seed: int) -> None:
        """See the class."""
        digest = hashlib.sha256(f"{_STREAM}|{class_name}|{index}|{seed}".encode()).digest()
        key = np.frombuffer(digest[:16], dtype="<u8").astype(np.uint64)
        self._generator = np.random.Generator(np.random.Philox(key=key))

    def uniform(self, low: float, high: float) -> float:
        """A number in [low, high)."""
        return float(self._generator.uniform(low, high))

    def integer(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return int(self._generator.integers(low, high + 1))

    def flag(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self._generator.random() < probability)

    def choice(self, options: Sequence[_Option], weights: Sequence[float] | None = None) -> _Option:
        """One of the options, by weight (all equal by default)."""
        cumulative = np.cumsum(np.ones(len(options)) if weights is None else np.asarray(weights))
        position = self._generator.random() * cumulative[-1]
        index = int(np.searchsorted(cumulative, position, side="right"))
        return options[min(index, len(options) - 1)]
