"""Pictures of the distributions over rotations that a network has."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from matplotlib.figure import Figure
from torch import Tensor

from i2i.callbacks.events import log_figure
from i2i.data.info import DataInfo
from i2i.geometry.icosahedron import nearest_element
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.models.prediction import PosePrediction
from i2i.viz.inputs import input_pictures
from i2i.viz.so3 import PoseSample, RotationDistribution, so3_figure
from i2i.viz.sphere import MapAxis
from i2i.viz.style import save_figure

log = logging.getLogger(__name__)

_GROUP_ORDER = 60


class DistributionImages(Callback):
    """Draws the distribution over SO(3) of a few images, and over the 60 rotations where there are.

    ``val/distribution`` in TensorBoard; after a test ``figures/distributions.png`` in the run
    folder and ``test/distribution``. The images are spread evenly over the set and are the same
    ones each time. Networks without a distribution are left alone.

    Args:
        every_n_validations: Draw at the first validation and then at each n-th.
        max_images: How many images.
        max_candidates: At most so many rotations of an image are drawn, the most probable ones.
        axis: What the position on the map says: ``"view"``, from where the camera looks at the
            object, or ``"object"``, where the object's z axis points.
    """

    def __init__(
        self,
        *,
        every_n_validations: int = 5,
        max_images: int = 4,
        max_candidates: int = 2000,
        axis: MapAxis = "view",
    ) -> None:
        if min(every_n_validations, max_images, max_candidates) < 1:
            raise ValueError(
                f"every_n_validations={every_n_validations}, max_images={max_images} and "
                f"max_candidates={max_candidates} must be at least 1; callbacks.distributions=null "
                "turns the pictures off."
            )
        if axis not in ("view", "object"):
            raise ValueError(f"axis={axis!r} is unknown. Allowed: view, object.")
        self.every_n_validations = every_n_validations
        self.max_images = max_images
        self.max_candidates = max_candidates
        self.axis: MapAxis = axis
        self._validations = 0
        self._warned = False
        self._samples: list[PoseSample] = []

    def state_dict(self) -> dict[str, Any]:
        """The count of validations, so that a resumed run draws at the same ones."""
        return {"validations": self._validations}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Invert `state_dict`."""
        self._validations = int(state_dict["validations"])

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._samples = []

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation or test."""
        self._samples = []

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: Any, batch_idx: int, dataloader_idx: int = 0,  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Keep the chosen images of a batch."""
        due = self._validations % self.every_n_validations == 0
        if due and dataloader_idx == 0 and not trainer.sanity_checking:
            self._keep(trainer, pl_module, outputs, batch, batch_idx, trainer.num_val_batches)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any,  # noqa: ANN401
        batch: Any, batch_idx: int, dataloader_idx: int = 0,  # noqa: ANN401
    ) -> None:  # fmt: skip
        """Keep the chosen images of a batch."""
        if dataloader_idx == 0:
            self._keep(trainer, pl_module, outputs, batch, batch_idx, trainer.num_test_batches)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw and log, from the first process only."""
        if trainer.sanity_checking:
            return
        self._validations += 1
        figure = self._figure(pl_module, f"validation, step {trainer.global_step:,}")
        if figure is not None:
            log_figure(trainer, "val/distribution", figure)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, log and write, from the first process only."""
        figure = self._figure(pl_module, "test: images spread evenly over the set")
        if figure is None:
            return
        log_figure(trainer, "test/distribution", figure)
        try:
            save_figure(figure, Path(trainer.default_root_dir) / "figures" / "distributions.png")
        except OSError as error:
            self._warn(f"writing failed: {error}")

    def _keep(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any,  # noqa: ANN401
        batch_idx: int, batches: Any,  # noqa: ANN401 - a list with a number, or with infinity
    ) -> None:  # fmt: skip
        if not trainer.is_global_zero or not isinstance(outputs, Mapping):
            return
        prediction = outputs.get("prediction")
        if not isinstance(prediction, PosePrediction) or prediction.log_prob is None:
            return
        chosen = picks(batch_idx, sum(batches), size=len(batch["class_id"]), count=self.max_images)
        try:
            for index in chosen:
                self._samples.append(self._sample(pl_module, prediction, batch, index))
        except Exception as error:  # a picture is never worth a training run
            self._warn(f"an image was left out: {type(error).__name__}: {error}")

    def _sample(
        self, pl_module: LightningModule, prediction: PosePrediction, batch: Any, index: int  # noqa: ANN401
    ) -> PoseSample:  # fmt: skip
        distribution = RotationDistribution.from_prediction(
            prediction, index, max_kept=self.max_candidates
        )
        if distribution is None:
            raise ValueError("the prediction has masses without candidates")
        info = pl_module.info
        assert isinstance(info, DataInfo)
        class_id = int(batch["class_id"][index])
        true, predicted = (
            rotation[index].detach().double().cpu()
            for rotation in (batch["rotation"], prediction.rotation)
        )
        group = group_of(pl_module)
        mass, target = None, None
        if group is not None and prediction.log_prob is not None:
            mass = prediction.log_prob[index].detach().double().exp().cpu()
            target = int(nearest_element(true.mT, group)[0])
        # A stripped label stands for all that look the same; the network knows only that one.
        symmetry = "none" if info.symmetry_stripped else info.symmetry[class_id]
        angle = float(torch.rad2deg(symmetric_angle_rad(predicted, true, symmetry)))
        return PoseSample(
            distribution,
            image=input_pictures({name: value[index : index + 1] for name, value in batch.items()})[
                0
            ],
            true=true,
            predicted=predicted,
            symmetry=symmetry,
            group_mass=mass,
            group_target=target,
            title=f"{info.class_names[class_id]}, {angle:.1f}°",
        )

    def _figure(self, pl_module: LightningModule, heading: str) -> Figure | None:
        """The figure of what was kept; None if that is nothing."""
        samples, self._samples = self._samples[: self.max_images], []
        if not samples:
            return None
        try:
            return so3_figure(samples, axis=self.axis, group=group_of(pl_module), heading=heading)
        except Exception as error:  # a picture is never worth a training run
            self._warn(f"drawing failed: {type(error).__name__}: {error}")
            return None

    def _warn(self, reason: str) -> None:
        """Say once why pictures are missing; training goes on."""
        if not self._warned:
            self._warned = True
            log.warning("DistributionImages: %s; training goes on without.", reason)


def picks(batch_idx: int, batches: float, *, size: int, count: int) -> list[int]:
    """Which images of a batch are kept, so that `count` lie evenly over all batches.

    Args:
        batch_idx: Number of the batch.
        batches: Batches in all; infinite or 0 if that is not known, then the first ones are kept.
        size: Images in the batch.
        count: Images wanted in all.

    Example:
        >>> [picks(b, 8, size=10, count=4) for b in range(8)]
        [[], [0], [], [0], [], [0], [], [0]]
        >>> picks(0, 1, size=10, count=4)
        [0, 2, 5, 7]
    """
    if not 0 < batches < float("inf"):
        return list(range(min(size, max(count - batch_idx * size, 0))))
    wanted = sum(int((n + 0.5) * batches / count) == batch_idx for n in range(count))
    wanted = min(wanted, size)
    return [n * size // wanted for n in range(wanted)]


def group_of(module: LightningModule) -> Tensor | None:
    """The 60 elements that a network gives masses to, camera → object, (60, 3, 3), or None."""
    network = getattr(module, "network", None)
    elements = getattr(network, "elements", None)
    if not isinstance(elements, Tensor) or elements.shape != (_GROUP_ORDER, 3, 3):
        return None
    elements = elements.detach().double().cpu()
    return elements.mT if getattr(network, "target", "view") == "rotation" else elements
