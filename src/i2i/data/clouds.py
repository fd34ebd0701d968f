"""Point clouds of a batch: a fresh rotation, normalised coordinates, and small disturbances.

Randomness comes from hashed counters, as in `i2i.data.augment`: what happens to a cloud depends on
its key alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from i2i.geometry.points import normalize_points
from i2i.geometry.rotations import rotation_from_quaternion_xyzw
from i2i.geometry.seeding import uniform_hash
from i2i.geometry.symmetries import strip_symmetry

Keys = Sequence[np.ndarray]
"""Integer arrays, each of shape (B,), that together name a sample."""

# One independent random stream each; those of images have the numbers below 10.
_TURN, _SCALE, _SHIFT, _SHARE, _DROP, _NOISE = 11, 12, 13, 14, 15, 16


@dataclass(frozen=True)
class CloudAugmentation:
    """What is done to the clouds of a batch; the same for a sample with the same key.

    A cloud is turned, normalised (mean at the origin, largest norm 1), disturbed by noise, thinned,
    scaled and shifted, in this order. It is not normalised again: that would undo the scale and the
    shift, and thinned clouds would differ in size from the whole ones of a test. So lengths are
    in units of the normalised cloud's radius.

    Attributes:
        rotate: Turn each cloud by a uniform rotation Q; its label becomes Q @ rotation.
        dropout: Largest share of dropped points; a cloud's own share is uniform from 0 to it. They
            become copies of the cloud's first point, so their number stays (as in PointNet++).
        scale: Largest change s of the size: a factor uniform in [1 − s, 1 + s].
        scale_per_axis: A factor for each axis of the camera instead of one for all.
        shift: Largest shift along each axis, uniform.
        noise: Standard deviation of a normal disturbance of each coordinate.
        seed: Seed of the draws.
        symmetry: Symmetry of each class that labels are to be stripped of (again, after a turn);
            empty to leave them whole.
    """

    rotate: bool = False
    dropout: float = 0.0
    scale: float = 0.0
    scale_per_axis: bool = False
    shift: float = 0.0
    noise: float = 0.0
    seed: int = 0
    symmetry: tuple[str, ...] = ()

    def __call__(
        self, points: np.ndarray, rotation: np.ndarray, class_id: np.ndarray, keys: Keys
    ) -> tuple[np.ndarray, np.ndarray]:
        """Augment and normalise a batch.

        Args:
            points: In camera axes, shape (B, P, 3), float32.
            rotation: Labels, object to camera, shape (B, 3, 3), float32.
            class_id: Shape (B,), int64.
            keys: See `Keys`.

        Returns:
            Points (B, P, 3) and labels (B, 3, 3), float32.
        """
        wide = points.astype(np.float64)
        if self.rotate:
            turn = self.turns(keys)
            wide = wide @ turn.transpose(0, 2, 1)
            rotation = strip_labels(turn @ rotation, class_id, self.symmetry)
        wide = normalize_points(torch.from_numpy(wide)).numpy()
        if self.noise:
            wide = wide + self.noise * self._normal(wide.shape, keys)
        if self.dropout:
            wide = np.where(self.dropped(wide.shape[1], keys)[..., None], wide[:, :1], wide)
        if self.scale:
            axes = 3 if self.scale_per_axis else 1
            wide = wide * (1 + self.scale * self._signed(_SCALE, (axes,), keys))[:, None]
        if self.shift:
            wide = wide + self.shift * self._signed(_SHIFT, (3,), keys)[:, None]
        return wide.astype(np.float32), rotation.astype(np.float32)

    def turns(self, keys: Keys) -> NDArray[np.float64]:
        """Uniform rotations of the samples with these keys, shape (B, 3, 3) (Shoemake 1992)."""
        u, v, w = np.moveaxis(self._uniform(_TURN, (3,), keys), -1, 0)
        lengths = np.sqrt(np.stack((1 - u, 1 - u, u, u), axis=-1))
        angles = 2 * np.pi * np.stack((v, v + 0.25, w, w + 0.25), axis=-1)
        quaternion = torch.from_numpy(lengths * np.sin(angles))  # + ¼: the cosine
        turns: NDArray[np.float64] = rotation_from_quaternion_xyzw(quaternion).numpy()
        return turns

    def dropped(self, num_points: int, keys: Keys) -> NDArray[np.bool_]:
        """Which points of the samples with these keys are dropped, shape (B, P)."""
        share = self.dropout * self._uniform(_SHARE, (), keys)
        return self._uniform(_DROP, (num_points,), keys) < share[:, None]

    def _normal(self, shape: tuple[int, ...], keys: Keys) -> NDArray[np.float64]:
        """Standard normal numbers (Box and Muller 1958)."""
        pair = self._uniform(_NOISE, (*shape[1:], 2), keys)
        radius = np.sqrt(-2 * np.log1p(-pair[..., 0]))
        normal: NDArray[np.float64] = radius * np.cos(2 * np.pi * pair[..., 1])
        return normal

    def _signed(self, stream: int, tail: tuple[int, ...], keys: Keys) -> NDArray[np.float64]:
        """Uniform numbers in [−1, 1), shape (B, *tail)."""
        return 2 * self._uniform(stream, tail, keys) - 1

    def _uniform(self, stream: int, tail: tuple[int, ...], keys: Keys) -> NDArray[np.float64]:
        """Uniform numbers in [0, 1), shape (B, *tail)."""
        count = np.arange(int(np.prod(tail, dtype=np.int64))).reshape(tail)
        names = [key.reshape(-1, *(1 for _ in tail)) for key in keys]
        return uniform_hash(self.seed, stream, *names, count)


def strip_labels(
    rotations: np.ndarray, class_id: np.ndarray, symmetry: Sequence[str]
) -> NDArray[np.float64]:
    """One label for all rotations that look the same.

    What is left of a label after stripping still says all that is needed: stripping takes away a
    turn Z of the object about its own axis, and ``Q @ rotation @ Z`` is stripped like ``Q @
    rotation``.

    Args:
        rotations: Object to camera, shape (N, 3, 3).
        class_id: Class of each, shape (N,).
        symmetry: Symmetry of each class; empty to change nothing.

    Returns:
        Shape (N, 3, 3), float64.
    """
    labels = np.array(rotations, np.float64)
    for number, name in enumerate(symmetry):
        mine = class_id == number
        if name != "none" and mine.any():
            labels[mine] = strip_symmetry(torch.from_numpy(labels[mine]), name).numpy()
    return labels
