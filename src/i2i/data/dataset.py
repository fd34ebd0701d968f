"""Batches cut from arrays of images, clouds or view sets, on disk or in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from i2i.data.augment import Augmentation
from i2i.data.clouds import CloudAugmentation

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class ImageBlock:
    """Labelled rows of one array.

    Attributes:
        content: Path of an ``.npy`` file that is opened as a memory map, or an array in memory:
            images (R, C, S, S) or view sets (R, V, C, S, S), uint8, or points (R, P, 3), float32.
        rows: Rows of the array that belong to the data set, shape (N,), int64.
        rotation: Labels of these rows, object to camera, shape (N, 3, 3), float32.
        class_id: Class of each row, shape (N,), int64.
        instance_id: Object of each row, unique over the data set, shape (N,), int64.
        instance_key: Number that stays with the object whatever else is in the data set, (N,).
        view_id: View of each row, shape (N,), int64.
    """

    content: Path | np.ndarray
    rows: np.ndarray
    rotation: np.ndarray
    class_id: np.ndarray
    instance_id: np.ndarray
    instance_key: np.ndarray
    view_id: np.ndarray


class RenderedDataset(Dataset[Batch]):
    """Images, clouds or view sets with rotation labels; a batch is cut and augmented at once.

    They stay on disk: memory does not grow with the data set.

    Args:
        blocks: Where the rows are; the samples are numbered block after block.
        augmentation: Shifts, or None; for clouds, what is done to clouds.
        key: What an augmentation depends on: ``"position"`` in the order of training, or
            ``"view"``: one fixed shift for each object and view.
        name: Name of the rows in a batch: ``"image"``, ``"points"`` or ``"views"``.
    """

    def __init__(
        self,
        blocks: Sequence[ImageBlock],
        *,
        augmentation: Augmentation | CloudAugmentation | None = None,
        key: str = "position",
        name: str = "image",
    ) -> None:
        if key not in ("position", "view"):
            raise ValueError(f"key={key!r} is not known. Allowed: position, view.")
        self.augmentation = augmentation or Augmentation()
        self.key = key
        self.name = name
        self._sources = [block.content for block in blocks]
        self._opened: dict[int, np.ndarray] = {}
        sizes = [len(block.rows) for block in blocks]
        self._source = np.repeat(np.arange(len(blocks)), sizes)
        self._rows = _joined([block.rows for block in blocks])
        self.rotation = _joined([block.rotation for block in blocks], (3, 3), np.float32)
        self.class_id = _joined([block.class_id for block in blocks])
        self.instance_id = _joined([block.instance_id for block in blocks])
        self.view_id = _joined([block.view_id for block in blocks])
        self._instance_key = _joined([block.instance_key for block in blocks])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Batch:
        """One sample: the entries of a batch without their first dimension."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        return {name: value[0] for name, value in self.__getitems__([index % len(self)]).items()}

    def __getitems__(self, pairs: Sequence[tuple[int, int]] | Sequence[int]) -> Batch:
        """One batch.

        Args:
            pairs: (sample index, position in training) for each sample; for plain indices the
                index is the position too.

        Returns:
            ``image`` (B, C, S, S) or ``views`` (B, V, C, S, S), float32 in [0, 1], or ``points``
            (B, P, 3) float32; ``rotation`` (B, 3, 3) float32; and ``class_id``, ``instance_id``,
            ``view_id``, each (B,) int64.
        """
        numbers = np.asarray(pairs, dtype=np.int64)
        indices, positions = (numbers, numbers) if numbers.ndim == 1 else numbers.T
        if self.key == "position":
            keys = [positions]
        else:
            keys = [self._instance_key[indices], self.view_id[indices]]
        content, rotation = self._gather(indices), self.rotation[indices]
        class_id = self.class_id[indices]
        if isinstance(self.augmentation, CloudAugmentation):
            content, rotation = self.augmentation(content, rotation, class_id, keys)
        else:
            content = self.augmentation(content, keys)
        arrays = {
            self.name: content,
            "rotation": rotation,
            "class_id": class_id,
            "instance_id": self.instance_id[indices],
            "view_id": self.view_id[indices],
        }
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    def raw_images(self, indices: Sequence[int] | np.ndarray) -> np.ndarray:
        """Stored rows without augmentation, for images of shape (B, C, S, S), uint8."""
        return self._gather(np.asarray(indices, dtype=np.int64))

    def _gather(self, indices: np.ndarray) -> np.ndarray:
        """Stored rows of the samples, shape (B, ...)."""
        sources, rows = self._source[indices], self._rows[indices]
        used = np.unique(sources)
        if len(used) == 1:
            return self._open(int(used[0]))[rows]
        first = self._open(int(used[0]))
        result = np.empty((len(indices), *first.shape[1:]), first.dtype)
        for source in used:
            here = sources == source
            result[here] = self._open(int(source))[rows[here]]
        return result

    def _open(self, number: int) -> np.ndarray:
        """Array of a block; a file is mapped when it is first used, in each process."""
        if number not in self._opened:
            source = self._sources[number]
            self._opened[number] = (
                source
                if isinstance(source, np.ndarray)
                # A plain array over the map: indexing a np.memmap object itself is slower.
                else np.asarray(np.load(source, mmap_mode="r"))
            )
        return self._opened[number]

    def __getstate__(self) -> dict[str, Any]:
        """Leave opened maps behind: pickling one for a worker would read the whole file."""
        return {**self.__dict__, "_opened": {}}


def collate(batch: Batch) -> Batch:
    """Batches come whole from the data set; there is nothing left to collate."""
    return batch


def _joined(
    parts: Sequence[np.ndarray], tail: tuple[int, ...] = (), dtype: type = np.int64
) -> np.ndarray:
    """Concatenate, also nothing."""
    return np.concatenate([np.zeros((0, *tail), dtype), *parts]).astype(dtype, copy=False)
