"""The user's own labelled pictures as a Lightning data module."""

from __future__ import annotations

import csv
import hashlib
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from i2i.data.clouds import strip_labels
from i2i.data.dataset import ImageBlock
from i2i.data.images import LabelledImages, read_labelled_images
from i2i.data.info import CHANNELS, IMAGES, DataInfo
from i2i.data.loaders import ImageDataModule, LoaderSettings, SplitData
from i2i.errors import ImageError

SPLITS = ("train", "val", "test")


class LabelledImagesDataModule(ImageDataModule):
    """Pictures with rotation labels from a folder and a CSV file.

    The CSV's column ``split`` (train, val or test) is obeyed where there is one; else pictures are
    divided at random by the fractions.

    Args:
        root: Folder of the pictures.
        csv: CSV file, looked up in ``root`` first.
        object: A class, a list of classes, or ``"all"`` for all in the file.
        modality: ``"gray"``, ``"depth"`` or ``"rgb"``.
        image_size: Height and width in pixels.
        quaternion_order: ``"xyzw"`` or ``"wxyz"``, for columns that do not say it themselves.
        camera_distance: Recorded for drawing only.
        camera_fov_deg: Recorded for drawing only.
        symmetry: ``"none"``, ``"z"`` or ``"z2"`` for all classes, or by class.
        strip_symmetry: Remove the rotation about z from the labels of z-symmetric classes.
        val_fraction: Share of the pictures that are not for test, for validation.
        test_fraction: Share of the pictures for test.
        seed: Seed of the split.
        **loader: Fields of `LoaderSettings`: how batches are made.

    Raises:
        ValueError: if a setting is not allowed.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        csv: str | os.PathLike[str] = "labels.csv",
        object: Sequence[str] | str = "all",
        modality: str = "rgb",
        image_size: int = 64,
        quaternion_order: str | None = None,
        camera_distance: float = 3.2,
        camera_fov_deg: float = 45.0,
        symmetry: str | Mapping[str, str] = "none",
        strip_symmetry: bool = True,
        val_fraction: float = 0.0,
        test_fraction: float = 0.2,
        seed: int = 0,
        **loader: Any,  # noqa: ANN401 - the fields of LoaderSettings, which checks them
    ) -> None:
        if modality not in IMAGES:
            raise ValueError(
                f"data.modality={modality} is not allowed: labelled pictures are "
                f"{', '.join(IMAGES)}. Clouds and views are made from meshes, for example with "
                "data=meshes."
            )
        super().__init__(LoaderSettings(**loader), modality=modality, image_size=image_size)
        for name, value in (("val_fraction", val_fraction), ("test_fraction", test_fraction)):
            if not 0 <= value < 1:
                raise ValueError(f"data.{name}={value} is not allowed: it must be in [0, 1).")
        self.root = Path(root)
        inside = self.root.expanduser() / csv
        self.csv = inside if inside.exists() else Path(csv).expanduser()
        self.classes = None if object == "all" else _as_list(object)
        self.image_size = image_size
        self.quaternion_order = quaternion_order
        self.camera_distance = camera_distance
        self.camera_fov_deg = camera_fov_deg
        self.symmetry = symmetry
        self.strip_symmetry = strip_symmetry
        self.fractions = (val_fraction, test_fraction)
        self.seed = seed

    @cached_property
    def _content(self) -> LabelledImages:
        """Pictures and labels."""
        return read_labelled_images(
            self.root,
            self.csv,
            image_size=self.image_size,
            modality=self.modality,
            classes=self.classes,
            quaternion_order=self.quaternion_order,
        )

    @property
    def info(self) -> DataInfo:
        """What networks and run folders need to know; reads the pictures when first asked."""
        names = self._content.class_names
        if isinstance(self.symmetry, str):
            symmetry = (self.symmetry,) * len(names)
        else:
            symmetry = tuple(self.symmetry.get(name, "none") for name in names)
        return DataInfo(
            class_names=names,
            symmetry=symmetry,
            channels=CHANNELS[self.modality],
            image_size=self.image_size,
            modality=self.modality,
            camera_distance=self.camera_distance,
            camera_fov_deg=self.camera_fov_deg,
            source="images",
            symmetry_stripped=self.strip_symmetry,
        )

    def load_splits(self) -> dict[str, SplitData]:
        """Divide the pictures; each picture counts as an object of its own.

        Raises:
            ImageError: if no picture is left for training.
        """
        content = self._content
        labels = self._labels(content)
        parts = self._parts(content.file_names)
        if not (parts == "train").any():
            raise ImageError(f"{self.csv} leaves no picture for training: {len(parts)} in all.")
        return {
            split: self._split_data(np.flatnonzero(parts == split), content, labels)
            for split in SPLITS
        }

    def _split_data(
        self, rows: np.ndarray, content: LabelledImages, labels: np.ndarray
    ) -> SplitData:
        names = [
            f"{content.class_names[content.class_ids[row]]}/{content.file_names[row]}"
            for row in rows
        ]
        block = ImageBlock(
            content=content.images,
            rows=rows,
            rotation=labels[rows],
            class_id=content.class_ids[rows].astype(np.int64),
            instance_id=np.arange(len(rows)),
            instance_key=np.array([_number(name) for name in names], np.int64),
            view_id=np.zeros(len(rows), np.int64),
        )
        return SplitData([block], names)

    def _labels(self, content: LabelledImages) -> np.ndarray:
        """Rotation labels, shape (N, 3, 3), float32."""
        symmetry = self.info.symmetry if self.strip_symmetry else ()
        return strip_labels(content.rotations, content.class_ids, symmetry).astype(np.float32)

    def _parts(self, files: Sequence[str]) -> np.ndarray:
        """``"train"``, ``"val"`` or ``"test"`` for each picture."""
        told = _split_column(self.csv)
        if told:
            return np.array([told[name] for name in files])
        order = sorted(range(len(files)), key=lambda row: _number(f"{self.seed}|{files[row]}"))
        num_test = round(self.fractions[1] * len(files))
        num_val = round(self.fractions[0] * (len(files) - num_test))
        parts = np.full(len(files), "train", dtype="<U5")
        parts[order[:num_test]] = "test"
        parts[order[num_test : num_test + num_val]] = "val"
        return parts


def _split_column(path: Path) -> dict[str, str]:
    """Split of each file in the CSV; empty if it has no such column.

    Raises:
        ImageError: if a value is not a split.
    """
    with path.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.DictReader(stream, skipinitialspace=True)
        reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or []]
        rows = [(reader.line_num, row) for row in reader]
    if "split" not in reader.fieldnames:
        return {}
    told: dict[str, str] = {}
    for line, row in rows:
        split = row["split"].strip()
        if split not in SPLITS:
            raise ImageError(
                f"{path}, line {line}: split is {split!r}. Allowed: {', '.join(SPLITS)}."
            )
        if told.setdefault(row["file"].strip(), split) != split:
            raise ImageError(f"{path}, line {line}: {row['file']} is in two splits; choose one.")
    return told


def _as_list(names: Sequence[str] | str) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _number(name: str) -> int:
    """Number that depends on a name alone."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:7], "big")
