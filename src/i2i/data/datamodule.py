"""Rendered views of meshes as a Lightning data module: renders what is missing, then loads it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from i2i.data.clouds import strip_labels
from i2i.data.content import content_of
from i2i.data.dataset import ImageBlock
from i2i.data.info import CHANNELS, CLOUDS, DataInfo
from i2i.data.loaders import ImageDataModule, LoaderSettings, SplitData
from i2i.data.reference import reference_meshes
from i2i.data.rendering_job import StorePaths, is_rendered, render_store
from i2i.data.settings import store_settings
from i2i.data.sources.base import MeshItem, MeshSource, override_symmetry
from i2i.data.splits import Splits, class_modes, split_items
from i2i.data.store import RenderedStore
from i2i.geometry.cameras import Camera
from i2i.geometry.view_sets import num_views
from i2i.rendering.base import Renderer
from i2i.rendering.mesh import RenderMesh

STORED_SPLIT = {"train": "train", "val": "train", "test": "test"}
"""Store whose views a split uses: validation is carved from the training views or objects."""


class RenderedDataModule(ImageDataModule):
    """Views of the meshes of a source.

    Args:
        source: Where the meshes come from.
        object: A class, a list of classes, or ``"all"``.
        renderer: Name of a renderer, or one.
        modality: A key of `i2i.data.info.CHANNELS`.
        image_size: Height and width in pixels of images and views.
        camera_distance: Distance from the camera to the object's centre, in object radii.
        camera_fov_deg: Full field of view, in degrees.
        views_per_instance: Training (and validation) views of each object.
        test_views_per_instance: Test views of each object.
        split: ``"instance"``, or ``"view"``: the same objects, seen from other views.
        val_fraction: Share of the training objects (or views) for validation; 0 for none.
        test_fraction: Share of the objects for test, where there is no official split.
        fold: Cross-validation fold that is the test set; None for none.
        folds: Number of folds.
        seed: Seed of the views and of the split.
        strip_symmetry: Remove the rotation about z from the labels of z-symmetric classes.
        symmetry: ``"none"``, ``"z"`` or ``"z2"`` for all classes, or by class; None for the
            source's own.
        render_workers: Rendering processes; None for one per processor.
        store_root: Folder of the rendered stores.
        strict: Stop at a mesh that cannot be read, instead of leaving it out.
        shift_px: See `LoaderSettings`, as for all that follow.
        depth_shift: See `LoaderSettings`.
        test_shift_px: See `LoaderSettings`.
        test_depth_shift: See `LoaderSettings`.
        batch_size: See `LoaderSettings`.
        eval_batch_size: See `LoaderSettings`.
        num_workers: See `LoaderSettings`.
        batches_per_epoch: See `LoaderSettings`.
        sampler_seed: See `LoaderSettings`.
        num_points: Points of a cloud; for clouds only.
        camera_set: Name of a camera set of `i2i.geometry.view_sets`; for views only.
        cloud_image_size: Height and width of the depth image behind a partial cloud.
        rotate_points: See `LoaderSettings`, as for all that follow.
        point_dropout: See `LoaderSettings`.
        point_scale: See `LoaderSettings`.
        point_scale_per_axis: See `LoaderSettings`.
        point_shift: See `LoaderSettings`.
        point_noise: See `LoaderSettings`.

    Raises:
        ValueError: if a class or another setting is not allowed.
    """

    def __init__(
        self,
        source: MeshSource,
        *,
        object: str | Sequence[str] = "all",
        renderer: Renderer | str = "embree",
        modality: str = "gray",
        image_size: int = 64,
        camera_distance: float = 3.2,
        camera_fov_deg: float = 45.0,
        views_per_instance: int = 60,
        test_views_per_instance: int = 60,
        split: str = "instance",
        val_fraction: float = 0.0,
        test_fraction: float = 0.2,
        fold: int | None = None,
        folds: int = 3,
        seed: int = 0,
        strip_symmetry: bool = True,
        symmetry: str | Mapping[str, str] | None = None,
        render_workers: int | None = None,
        store_root: str | os.PathLike[str] = "data/renders",
        strict: bool = False,
        shift_px: float = 3,
        depth_shift: float = 0.0,
        test_shift_px: float = 0,
        test_depth_shift: float = 0.0,
        batch_size: int = 64,
        eval_batch_size: int | None = None,
        num_workers: int = 0,
        batches_per_epoch: int | None = None,
        sampler_seed: int = 0,
        num_points: int | None = None,
        camera_set: str | None = None,
        cloud_image_size: int = 128,
        rotate_points: bool | None = None,
        point_dropout: float = 0.0,
        point_scale: float = 0.0,
        point_scale_per_axis: bool | None = None,
        point_shift: float = 0.0,
        point_noise: float = 0.0,
    ) -> None:
        loader = LoaderSettings(
            batch_size=batch_size,
            eval_batch_size=eval_batch_size,
            num_workers=num_workers,
            batches_per_epoch=batches_per_epoch,
            sampler_seed=sampler_seed,
            shift_px=shift_px,
            depth_shift=depth_shift,
            test_shift_px=test_shift_px,
            test_depth_shift=test_depth_shift,
            rotate_points=rotate_points,
            point_dropout=point_dropout,
            point_scale=point_scale,
            point_scale_per_axis=point_scale_per_axis,
            point_shift=point_shift,
            point_noise=point_noise,
        )
        super().__init__(loader, modality=modality, image_size=image_size)
        self.source = source
        self.class_names = source.check_classes(source.classes if object == "all" else object)
        self.renderer = renderer
        self.image_size = cloud_image_size if modality in CLOUDS else image_size
        self.camera = Camera(distance=camera_distance, fov_deg=camera_fov_deg)
        self.views = {
            "train": _positive("views_per_instance", views_per_instance),
            "test": _positive("test_views_per_instance", test_views_per_instance),
        }
        self.split = split
        self.val_fraction = val_fraction
        self.test_fraction = test_fraction
        self.fold = fold
        self.folds = folds
        self.seed = seed
        self.strip_symmetry = strip_symmetry
        chosen = override_symmetry(source.symmetry, symmetry)
        self.symmetry = tuple(chosen[name] for name in self.class_names)
        self.render_workers = render_workers
        self.store_root = Path(store_root)
        self.strict = strict
        self._reference_meshes: dict[str, RenderMesh | None] = {}
        self._making: dict[str, Any] = {
            "renderer": renderer,
            "camera": self.camera,
            "modality": modality,
            "image_size": image_size,
            "seed": seed,
            "num_points": num_points,
            "camera_set": camera_set,
            "cloud_image_size": cloud_image_size,
        }
        self.settings = store_settings(source, **self._making)

    @property
    def info(self) -> DataInfo:
        """What networks and run folders need to know; available before anything is rendered."""
        camera_set = self.settings.camera_set
        return DataInfo(
            class_names=self.class_names,
            symmetry=self.symmetry,
            channels=CHANNELS[self.modality],
            image_size=self.image_size,
            modality=self.modality,
            camera_distance=self.camera.distance,
            camera_fov_deg=self.camera.fov_deg,
            source=self.source.name,
            symmetry_stripped=self.strip_symmetry,
            num_points=self.settings.num_points,
            num_views=None if camera_set is None else num_views(camera_set),
            camera_set=camera_set,
        )

    @cached_property
    def items(self) -> Splits:
        """Objects of ``"train"``, ``"val"`` and ``"test"``."""
        return split_items(
            self._all_items,
            split=self.split,
            test_fraction=self.test_fraction,
            val_fraction=self.val_fraction,
            seed=self.seed,
            fold=self.fold,
            folds=self.folds,
        )

    def prepare_data(self) -> None:
        """Render what the stores lack."""
        self.render()

    def render(
        self,
        *,
        overwrite: bool = False,
        progress: bool = True,
        part: tuple[int, int] | None = None,
    ) -> StorePaths:
        """Render what the stores lack.

        Args:
            overwrite: Render again what is there.
            progress: Show the progress.
            part: See `render_store`.

        Returns:
            Folder of the store of each (class name, split).

        Raises:
            I2IError: see `render_store`.
        """
        return render_store(
            self.source,
            self._stored_items(),
            views_per_instance=self.views,
            root=self.store_root,
            num_workers=self.render_workers,
            strict=self.strict,
            overwrite=overwrite,
            progress=progress,
            part=part,
            **self._making,
        )

    def is_rendered(self, part: tuple[int, int] | None = None) -> bool:
        """Whether `render` would find all of it, or of a part, there.

        Raises:
            I2IError: if the meshes are not there, or the stores were made with other settings.
        """
        return is_rendered(
            self._stored_items(),
            self.settings,
            views_per_instance=self.views,
            root=self.store_root,
            part=part,
        )

    def _stored_items(self) -> dict[str, list[MeshItem]]:
        # Classes that are split by view have the same objects in train and val.
        train = list(dict.fromkeys([*self.items["train"], *self.items["val"]]))
        return {"train": train, "test": self.items["test"]}

    def reference_mesh(self, class_name: str) -> RenderMesh | None:
        """A typical training object of a class, for drawing."""
        if class_name not in self._reference_meshes:
            members = [item for item in self.items["train"] if item.class_name == class_name]
            self._reference_meshes |= {class_name: None, **reference_meshes(self.source, members)}
        return self._reference_meshes[class_name]

    def load_splits(self) -> dict[str, SplitData]:
        """Open the stores and select the rows of each split.

        Raises:
            StoreError: if a store is missing or lacks something.
            StoreMismatchError: if a store was made with other settings.
        """
        return {name: self._load_split(name) for name in ("train", "val", "test")}

    @cached_property
    def _all_items(self) -> list[MeshItem]:
        return self.source.items(self.class_names)

    @cached_property
    def _modes(self) -> dict[str, str]:
        # split_items tells of the classes that are split by view.
        return class_modes(self._all_items, split=self.split, notice=False)

    def _view_range(self, split: str, class_name: str) -> range:
        """Views of each object of a class that belong to a split."""
        if split == "test":
            return range(self.views["test"])
        total = self.views["train"]
        if self._modes[class_name] == "instance" or self.val_fraction == 0:
            return range(total)
        # The last training views are for validation; at least one, and one is left.
        carved = min(max(1, round(self.val_fraction * total)), total - 1)
        return range(total - carved) if split == "train" else range(total - carved, total)

    def _load_split(self, split: str) -> SplitData:
        data = SplitData()
        for class_id, class_name in enumerate(self.class_names):
            members = [item for item in self.items[split] if item.class_name == class_name]
            if members:
                self._add_class(data, split, class_id, members)
        return data

    def _add_class(
        self, data: SplitData, split: str, class_id: int, members: Sequence[MeshItem]
    ) -> None:
        """Add the rows of one class to the data of a split."""
        class_name = self.class_names[class_id]
        folder = self.settings.folder(self.store_root, class_name, STORED_SPLIT[split])
        store = RenderedStore.open(folder, expected=self.settings)
        skipped = {entry["id"] for entry in store.card["skipped"]}
        names = [item.instance_id for item in members if item.instance_id not in skipped]
        views = self._view_range(split, class_name)
        rows = store.rows(names, views=views)
        full_names = [f"{class_name}/{name}" for name in names]
        first = len(data.instance_names)
        each = len(views)
        data.instance_names += full_names
        data.blocks.append(
            ImageBlock(
                content=folder / f"{content_of(store.card['settings']).name}.npy",
                rows=rows,
                rotation=self._labels(store.rotations[rows], class_id),
                class_id=np.full(len(rows), class_id),
                instance_id=np.repeat(first + np.arange(len(names)), each),
                instance_key=np.repeat(np.array([*map(_name_key, full_names)], np.int64), each),
                view_id=store.views[rows].astype(np.int64),
            )
        )

    def _labels(self, rotations: np.ndarray, class_id: int) -> np.ndarray:
        """Rotation labels, shape (N, 3, 3), float32; one for all that look the same."""
        symmetry = self.symmetry if self.strip_symmetry else ()
        labels = strip_labels(rotations, np.full(len(rotations), class_id), symmetry)
        return labels.astype(np.float32)


def _positive(name: str, value: int) -> int:
    if value < 1:
        raise ValueError(f"data.{name}={value} is not allowed: it must be at least 1.")
    return value


def _name_key(name: str) -> int:
    """Number of an object that depends on its name alone."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:7], "big")
