"""Pictures of validation predictions in TensorBoard."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from matplotlib.figure import Figure
from torch import Tensor

from i2i.callbacks.events import log_figure
from i2i.data.info import DataInfo
from i2i.geometry.rotations import geodesic_angle_rad
from i2i.models.prediction import PosePrediction
from i2i.rendering.mesh import RenderMesh
from i2i.viz.grids import class_grid, prediction_grid
from i2i.viz.inputs import input_pictures
from i2i.viz.rerender import rerender_each

log = logging.getLogger(__name__)


class PredictionImages(Callback):
    """Logs inputs beside the mesh re-rendered in the predicted and the true orientation.

    The images are the first of the validation set, the same ones each time. Meshes come from
    ``trainer.datamodule.reference_mesh(class_name)``; without one the inputs are logged alone.

    Args:
        every_n_validations: Log at the first validation and then at each n-th.
        max_images: How many images.
        renderer: Name of the renderer; the default one needs no system library.
    """

    def __init__(
        self, *, every_n_validations: int = 1, max_images: int = 8, renderer: str = "embree"
    ) -> None:
        if every_n_validations < 1 or max_images < 1:
            raise ValueError(
                f"every_n_validations={every_n_validations} and max_images={max_images} must be "
                "at least 1; callbacks.images=null turns the pictures off."
            )
        self.every_n_validations = every_n_validations
        self.max_images = max_images
        self.renderer = renderer
        self._validations = 0
        self._warned = False
        self._parts: list[dict[str, Tensor]] = []
        self._meshes: dict[str, RenderMesh | None] = {}

    def state_dict(self) -> dict[str, Any]:
        """The count of validations, so that a resumed run draws at the same ones."""
        return {"validations": self._validations}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Invert `state_dict`."""
        self._validations = int(state_dict["validations"])

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._parts = []

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,  # noqa: ANN401 - Lightning's signature
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the first images and what was predicted for them."""
        kept = sum(len(part["class_id"]) for part in self._parts)
        if kept >= self.max_images or dataloader_idx > 0 or not self._is_due(trainer):
            return
        if not isinstance(outputs, Mapping) or "prediction" not in outputs:
            self._warn("the validation step returned no 'prediction'")
            return
        prediction, room = outputs["prediction"], self.max_images - kept
        first = {name: value[:room] for name, value in batch.items()}
        part = {"image": torch.from_numpy(input_pictures(first)), "class_id": batch["class_id"]}
        if isinstance(prediction, PosePrediction):
            part |= {"predicted": prediction.rotation, "true": batch["rotation"]}
        else:
            part["predicted_class"] = prediction.logits.argmax(dim=1)
        self._parts.append({name: v[:room].detach().cpu() for name, v in part.items()})

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw and log, from the first process only."""
        if trainer.sanity_checking:
            return
        due = self._is_due(trainer)
        self._validations += 1
        if not due or not self._parts:
            return
        samples = {name: torch.cat([part[name] for part in self._parts]) for name in self._parts[0]}
        self._parts = []
        try:
            figure = self._draw(trainer, pl_module, samples)
        except Exception as error:  # a picture is never worth a training run
            self._warn(f"drawing failed: {type(error).__name__}: {error}")
            return
        log_figure(trainer, "val/predictions", figure)

    def _is_due(self, trainer: Trainer) -> bool:
        return (
            trainer.is_global_zero
            and not trainer.sanity_checking
            and self._validations % self.every_n_validations == 0
        )

    def _draw(
        self, trainer: Trainer, pl_module: LightningModule, samples: dict[str, Tensor]
    ) -> Figure:
        info = pl_module.info
        assert isinstance(info, DataInfo)
        heading = f"validation, step {trainer.global_step:,}"
        names = [info.class_names[index] for index in samples["class_id"].tolist()]
        if "predicted_class" in samples:
            predicted = [info.class_names[index] for index in samples["predicted_class"].tolist()]
            return class_grid(samples["image"], predicted=predicted, true=names, heading=heading)
        error_deg = torch.rad2deg(
            geodesic_angle_rad(samples["predicted"].double(), samples["true"].double())
        )
        meshes = [self._mesh(trainer, name) for name in names]
        pictures: list[np.ndarray | None] = [None, None]
        if any(mesh is not None for mesh in meshes):
            pictures = [
                rerender_each(meshes, samples[name], info=info, renderer=self.renderer)
                for name in ("predicted", "true")
            ]
        return prediction_grid(
            samples["image"],
            predicted=pictures[0],
            true=pictures[1],
            error_deg=error_deg,
            titles=names if info.num_classes > 1 else None,
            heading=heading,
        )

    def _mesh(self, trainer: Trainer, class_name: str) -> RenderMesh | None:
        """The class's mesh, asked for once."""
        if class_name not in self._meshes:
            datamodule = getattr(trainer, "datamodule", None)
            find = getattr(datamodule, "reference_mesh", None)
            self._meshes[class_name] = None if find is None else find(class_name)
            if self._meshes[class_name] is None:
                self._warn(f"there is no reference mesh of {class_name!r} to re-render")
        return self._meshes[class_name]

    def _warn(self, reason: str) -> None:
        """Say once why pictures are missing; training goes on."""
        if not self._warned:
            self._warned = True
            log.warning("PredictionImages: %s; training goes on without these pictures.", reason)
