"""Randomness by address: a number depends on what it is for, never on how many were drawn before.

So the result of a job does not depend on the order of its parts or on how many processes share
them, and views of different splits cannot coincide by a shared generator state.
"""

import hashlib
import json
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_ADDRESS_FORMAT = 1  # raise it when an address is spelled differently: every view changes


def view_rotation(
    dataset: str, split: str, class_name: str, instance_id: str, view: int, seed: int = 0
) -> NDArray[np.float64]:
    """Orientation of one rendered view, uniform on SO(3).

    SHA-256 of the whole address keys a Philox counter generator whose first three numbers make a
    quaternion (Shoemake 1992). Only raw 64-bit output is used: it is fixed by the algorithm, while
    numpy may change its distributions between releases.

    Args:
        dataset: Name of the mesh source.
        split: "train" or "test"; different names give unrelated views.
        class_name: Class of the object.
        instance_id: Name of the mesh within the class.
        view: Number of the view, from 0.
        seed: Seed of the whole rendered set.

    Returns:
        Object→camera rotation, shape (3, 3).
    """
    address = [_ADDRESS_FORMAT, dataset, split, class_name, str(instance_id), view, seed]
    digest = hashlib.sha256(json.dumps(address, default=int).encode()).digest()
    raw = np.random.Philox(key=int.from_bytes(digest[:16], "little")).random_raw(3)
    return _shoemake(*_unit_interval(np.asarray(raw, dtype=np.uint64)).tolist())


def _shoemake(u: float, v: float, w: float) -> NDArray[np.float64]:
    """Uniform rotation of three numbers uniform in [0, 1)."""
    x, y = (
        math.sqrt(1 - u) * math.sin(2 * math.pi * v),
        math.sqrt(1 - u) * math.cos(2 * math.pi * v),
    )
    z, s = math.sqrt(u) * math.sin(2 * math.pi * w), math.sqrt(u) * math.cos(2 * math.pi * w)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)],
            [2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)],
            [2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)],
        ]
    )


def uniform_hash(seed: int, *keys: ArrayLike) -> NDArray[np.float64]:
    """Uniform numbers that are a pure function of integers (splitmix64, chained over the keys).

    Args:
        seed: Any integer.
        *keys: Integers or integer arrays that broadcast together, such as stream positions and a
            number for the purpose. Order matters.

    Returns:
        Numbers in [0, 1) with 53 random bits, shape of the broadcast keys.

    Raises:
        TypeError: If a key is not of an integer type.
    """
    state = _mix(np.asarray(seed % 2**64, dtype=np.uint64))
    for key in keys:
        array = np.asarray(key)
        if array.dtype.kind not in "iu":
            raise TypeError(f"uniform_hash wants integers, got an array of {array.dtype}")
        state = _mix(state ^ _mix(array.astype(np.int64).view(np.uint64)))
    return _unit_interval(state)


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """One step of splitmix64 (Steele, Lea & Flood 2014); arithmetic modulo 2^64 is intended."""
    with np.errstate(over="ignore"):
        x = x + _GOLDEN
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(x ^ (x >> np.uint64(31)), dtype=np.uint64)


def _unit_interval(x: NDArray[np.uint64]) -> NDArray[np.float64]:
    return (x >> np.uint64(11)).astype(np.float64) * 2.0**-53
