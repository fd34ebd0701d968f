"""The part of a data module that rendered and photographed data share: data loaders."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from lightning import LightningDataModule
from torch.utils.data import BatchSampler, DataLoader

from i2i.data.augment import Augmentation, scaled_shift
from i2i.data.clouds import CloudAugmentation
from i2i.data.dataset import Batch, ImageBlock, RenderedDataset, collate
from i2i.data.info import CLOUDS, IMAGES, VIEWS, DataInfo
from i2i.data.sampler import EpochSampler, SliceSampler
from i2i.rendering.mesh import RenderMesh

log = logging.getLogger(__name__)


@dataclass
class LoaderSettings:
    """How batches are made.

    Attributes:
        batch_size: Training samples in a batch of all processes together.
        eval_batch_size: Samples in a validation or test batch; None for ``batch_size``.
        num_workers: Loader processes; 0 loads in the training process.
        batches_per_epoch: Batches in an epoch; None for one pass over the data.
        sampler_seed: Seed of the order and of the augmentation.
        shift_px: Largest training shift in pixels of a 128 px image (paper: 3); clouds and views
            are not shifted.
        depth_shift: Largest training shift of depth images in percent of the object's diameter.
        test_shift_px: The same for test images, one fixed shift for each.
        test_depth_shift: The same for test images, one fixed shift for each.
        rotate_points: Turn each training cloud by a fresh random rotation, and its label with it;
            None for full clouds only.
        point_dropout: Training clouds: largest share of dropped points.
        point_scale: Training clouds: largest change of the size.
        point_scale_per_axis: Draw a factor for each axis of the camera; otherwise one for all.
        point_shift: Training clouds: largest shift along each axis, in radii of the cloud.
        point_noise: Training clouds: standard deviation of each coordinate, in radii of the cloud.
    """

    batch_size: int = 64
    eval_batch_size: int | None = None
    num_workers: int = 0
    batches_per_epoch: int | None = None
    sampler_seed: int = 0
    shift_px: float = 3
    depth_shift: float = 0.0
    test_shift_px: float = 0
    test_depth_shift: float = 0.0
    rotate_points: bool | None = None
    point_dropout: float = 0.0
    point_scale: float = 0.0
    point_scale_per_axis: bool | None = None
    point_shift: float = 0.0
    point_noise: float = 0.0

    def check(self, modality: str) -> None:
        """Check the settings that do not depend on the data.

        Raises:
            ValueError: naming the setting and what is allowed.
        """
        for name in ("batch_size", "eval_batch_size", "batches_per_epoch"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"data.{name}={value} is not allowed: it must be at least 1.")
        for name in ("depth_shift", "test_depth_shift"):
            value = getattr(self, name)
            if not 0 <= value <= 100:
                raise ValueError(f"data.{name}={value} is not allowed: give percent, 0 to 100.")
            if value and modality != "depth":
                raise ValueError(
                    f"data.{name}={value} needs data.modality=depth, but it is {modality}: leave "
                    "the depth shift out."
                )
        if self.test_shift_px and modality not in IMAGES:
            raise ValueError(
                f"data.test_shift_px={self.test_shift_px} needs one of data.modality="
                f"{', '.join(IMAGES)}, but it is {modality}: leave the pixel shift out."
            )
        self._check_points(modality)

    def _check_points(self, modality: str) -> None:
        """Check the settings of clouds."""
        below_one = ("point_dropout", "point_scale")
        for name in ("rotate_points", *below_one, "point_shift", "point_noise"):
            value = getattr(self, name)
            if value and modality not in CLOUDS:
                raise ValueError(
                    f"data.{name}={value} needs data.modality={' or '.join(CLOUDS)}, but it is "
                    f"{modality}: leave it out."
                )
            if name in below_one and not 0 <= value < 1:
                raise ValueError(f"data.{name}={value} is not allowed: it must be in [0, 1).")
            if name in ("point_shift", "point_noise") and not value >= 0:
                raise ValueError(f"data.{name}={value} is not allowed: it must be 0 or more.")


@dataclass
class SplitData:
    """Rows and object names of one split.

    Attributes:
        blocks: Where the images, clouds or view sets are.
        instance_names: ``<class>/<object>`` for each ``instance_id``.
    """

    blocks: list[ImageBlock] = field(default_factory=list)
    instance_names: list[str] = field(default_factory=list)


class ImageDataModule(LightningDataModule):
    """Data loaders over labelled images, clouds or view sets; subclasses say where they come from.

    The loaders divide batches among processes themselves, so run the trainer with
    ``use_distributed_sampler=False``.

    Args:
        loader: How batches are made.
        modality: A key of `i2i.data.info.CHANNELS`.
        image_size: Height and width in pixels.
    """

    def __init__(self, loader: LoaderSettings, *, modality: str, image_size: int) -> None:
        super().__init__()
        loader.check(modality)
        self.loader = loader
        self.modality = modality
        # Out-of-range shifts should be refused before anything is rendered.
        self._train_shift = scaled_shift(loader.shift_px, image_size)
        self._test_shift = scaled_shift(loader.test_shift_px, image_size)
        self._splits: dict[str, SplitData] = {}
        self._datasets: dict[str, RenderedDataset] = {}

    @property
    def info(self) -> DataInfo:
        """What networks and run folders need to know about the data."""
        raise NotImplementedError

    def reference_mesh(self, class_name: str) -> RenderMesh | None:
        """A mesh to draw predictions of a class with; None where there is none."""
        return None

    def load_splits(self) -> dict[str, SplitData]:
        """Rows of ``"train"``, ``"val"`` and ``"test"``; called once."""
        raise NotImplementedError

    def setup(self, stage: str | None = None) -> None:
        """Open the data; calling it again does nothing."""
        if self._datasets:
            return
        self._splits = self.load_splits()
        augmentations = self._augmentations()
        self._datasets = {
            name: RenderedDataset(
                split.blocks,
                augmentation=augmentations[name],
                key="position" if name == "train" else "view",
                name=self._batch_name(),
            )
            for name, split in self._splits.items()
        }

    def _batch_name(self) -> str:
        """Name of the rows in a batch."""
        if self.modality in CLOUDS:
            return "points"
        return "views" if self.modality == VIEWS else "image"

    def _augmentations(self) -> dict[str, Augmentation | CloudAugmentation]:
        """What is done to the samples of each split."""
        loader, seed = self.loader, self.loader.sampler_seed
        if self.modality in CLOUDS:
            turned = loader.rotate_points
            train = CloudAugmentation(
                rotate=self.modality == "full_points" if turned is None else turned,
                dropout=loader.point_dropout,
                scale=loader.point_scale,
                scale_per_axis=bool(loader.point_scale_per_axis),
                shift=loader.point_shift,
                noise=loader.point_noise,
                seed=seed,
                symmetry=self.info.symmetry if self.info.symmetry_stripped else (),
            )
            return {"train": train, "val": CloudAugmentation(), "test": CloudAugmentation()}
        if self.modality == VIEWS:
            return {split: Augmentation() for split in ("train", "val", "test")}
        return {
            "train": Augmentation(self._train_shift, loader.depth_shift, seed),
            "val": Augmentation(),
            # The seed is fixed: the shifted test set is the same one for every run.
            "test": Augmentation(self._test_shift, loader.test_depth_shift, 0),
        }

    def dataset(self, split: str) -> RenderedDataset:
        """Data set of ``"train"``, ``"val"`` or ``"test"``.

        Raises:
            ValueError: for another name.
        """
        self.setup()
        if split not in self._datasets:
            raise ValueError(f"Split {split!r} is not known. Allowed: train, val, test.")
        return self._datasets[split]

    def instance_names(self, split: str) -> list[str]:
        """``<class>/<object>`` for each ``instance_id`` of a split."""
        self.dataset(split)
        return self._splits[split].instance_names

    def train_sampler(self) -> EpochSampler:
        """Order of the training samples for this process.

        Raises:
            ValueError: if there are too few samples for one in each process.
        """
        rank, world_size = self._process()
        num_samples = len(self.dataset("train"))
        batch_size = self.loader.batch_size
        if num_samples < batch_size:
            batch_size = num_samples // world_size * world_size
            if batch_size == 0:
                raise ValueError(
                    f"There are {num_samples} training samples for {world_size} process(es): "
                    "render more views (data.views_per_instance) or use fewer devices."
                )
            log.warning(
                "There are only %d training samples: "
                "batches have %d instead of data.batch_size=%d.",
                num_samples,
                batch_size,
                self.loader.batch_size,
            )
        return EpochSampler(
            num_samples,
            seed=self.loader.sampler_seed,
            batch_size=batch_size,
            batches_per_epoch=self.loader.batches_per_epoch,
            rank=rank,
            world_size=world_size,
        )

    def train_dataloader(self) -> DataLoader[Batch]:
        """Shuffled, augmented batches of equal size."""
        sampler = self.train_sampler()
        # torch declares that samplers yield single numbers, but passes on whatever they yield.
        batches = BatchSampler(cast(Any, sampler), sampler.local_batch_size, drop_last=True)
        return self._loader("train", batches)

    def val_dataloader(self) -> DataLoader[Batch] | list[DataLoader[Batch]]:
        """Validation batches in order; an empty list if there is no validation set."""
        return self._eval_loader("val") if len(self.dataset("val")) else []

    def test_dataloader(self) -> DataLoader[Batch]:
        """Test batches in order, every image once."""
        return self._eval_loader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        """The test batches."""
        return self._eval_loader("test")

    def _eval_loader(self, split: str) -> DataLoader[Batch]:
        rank, world_size = self._process()
        sampler = SliceSampler(len(self.dataset(split)), rank=rank, world_size=world_size)
        size = self.loader.eval_batch_size or self.loader.batch_size
        return self._loader(split, BatchSampler(cast(Any, sampler), size, drop_last=False))

    def _loader(self, split: str, batches: BatchSampler) -> DataLoader[Batch]:
        return DataLoader(
            self.dataset(split),
            batch_sampler=batches,
            num_workers=self.loader.num_workers,
            collate_fn=cast(Any, collate),
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.loader.num_workers > 0 and split == "train",
        )

    def _process(self) -> tuple[int, int]:
        """Number of this process and of all, from the trainer if there is one."""
        if self.trainer is None:
            return 0, 1
        return self.trainer.global_rank, self.trainer.world_size
