"""A trained network that answers for one picture: `i2i.load(run).predict("photo.png")`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from i2i.data.info import DataInfo
from i2i.data.pictures import Picture
from i2i.data.point_files import Cloud
from i2i.distinct_answers import distinct_answers
from i2i.errors import CheckpointError, ConfigurationError
from i2i.geometry.rotations import euler_deg_from_rotation, quaternion_xyzw_from_rotation
from i2i.models.prediction import PosePrediction
from i2i.network_input import Seen, in_batches, see
from i2i.nn.folding import fold
from i2i.prediction_results import Alternative, ClassResult, Drawing, PoseResult
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.reference import load_mesh
from i2i.runs.loading import load_task, locate, move_to
from i2i.viz.inputs import input_pictures

_NUM_ALTERNATIVES = 3


class Predictor:
    """A network in evaluation mode with what is needed to feed it pictures and to draw its answers.

    Args:
        network: Maps a batch to a `PosePrediction` or a `ClassPrediction`.
        info: What the network was trained on.
        config: Resolved configuration of the run.
        run_folder: Folder of the run; its ``reference_meshes/<class>.npz`` are used for drawing.
        reference_meshes: Meshes by class name, instead of the run folder's.

    Example:
        >>> predictor = i2i.load("runs/chairs")  # doctest: +SKIP
        >>> result = predictor.predict("chair.png", box=(40, 30, 220, 260))  # doctest: +SKIP
        >>> result.rotation, result.confidence  # doctest: +SKIP
        >>> result.draw("chair_pose.png")  # doctest: +SKIP
    """

    def __init__(
        self,
        network: nn.Module,
        info: DataInfo,
        *,
        config: Mapping[str, Any] | None = None,
        run_folder: str | Path | None = None,
        reference_meshes: Mapping[str, RenderMesh] | None = None,
    ) -> None:
        self.network = network.eval()
        self.info = info
        self.config = dict(config or {})
        self.run_folder = None if run_folder is None else Path(run_folder)
        self._given_meshes = reference_meshes

    def __repr__(self) -> str:
        """Network, classes and input."""
        return (
            f"Predictor({type(self.network).__name__}, {', '.join(self.info.class_names)}; "
            f"{self.info.modality}, {self._input_size()})"
        )

    def _input_size(self) -> str:
        if self.info.num_points is not None:
            return f"{self.info.num_points} points"
        views = "" if self.info.num_views is None else f"{self.info.num_views} × "
        return f"{views}{self.info.image_size} px"

    @cached_property
    def reference_meshes(self) -> dict[str, RenderMesh]:
        """Meshes for drawing, by class name; classes without one are left out."""
        if self._given_meshes is not None:
            return dict(self._given_meshes)
        if self.run_folder is None:
            return {}
        paths = {
            name: self.run_folder / "reference_meshes" / f"{name}.npz"
            for name in self.info.class_names
        }
        return {name: load_mesh(path) for name, path in paths.items() if path.is_file()}

    @property
    def device(self) -> torch.device:
        """Where the network's weights are."""
        first = next(self.network.parameters(), None)
        return torch.device("cpu") if first is None else first.device

    def predict(
        self,
        image: Picture | Cloud,
        *,
        class_name: str | None = None,
        mask: Picture | None = None,
        box: Sequence[float] | None = None,
        intrinsics: Sequence[float] | None = None,
        margin: float = 1.0,
        axes: str = "opengl",
    ) -> PoseResult | ClassResult:
        """Say how the object in a picture or a cloud is turned, or of which class it is.

        Args:
            image: Path, PIL image or array (H, W), (H, W, 1 | 3 | 4); for a network of clouds a
                path or an array (N, 3), the points of the object alone.
            class_name: Class of the object; needed by a pose network of several classes.
            mask: Picture of the same size, non-zero on the object; else the image's alpha is used.
            box: (x0, y0, x1, y1) around the object in pixels.
            intrinsics: (fx, fy, cx, cy) of the camera in pixels. With them the rotation is into
                this camera's frame, without them into the frame of a camera that looks at the
                middle of the crop.
            margin: Factor on the side of the crop; above 1 the object becomes smaller.
            axes: Camera axes of a cloud, see `i2i.data.point_files.prepare_cloud`. The answer is
                always in axes x right, y up, z to the viewer.

        Returns:
            A `PoseResult` or a `ClassResult`, depending on the network.

        Raises:
            ImageError: if the picture cannot be read, or mask, box or intrinsics do not fit it.
            ConfigurationError: if the class is unknown, or is needed and not given; or if what is
                meant for pictures was given with a cloud, or the other way round.
            CheckpointError: if the network's answer is not finite.
        """
        if class_name is not None:
            self._check_class(class_name)
        seen = see(
            image, self.info, mask=mask, box=box, intrinsics=intrinsics, margin=margin, axes=axes
        )
        return next(self._answer([seen], class_name))

    def predict_many(
        self,
        images: Iterable[Picture | Cloud],
        *,
        class_name: str | None = None,
        batch_size: int | None = None,
        workers: int = 2,
        read_ahead: bool | None = None,
        **how: Any,  # noqa: ANN401 - passed on as they are
    ) -> Iterator[PoseResult | ClassResult]:
        """Answer for many pictures or clouds, in their order, a batch at a time.

        No more than two batches are held at a time, so `images` may be a generator.

        Args:
            images: Pictures or clouds, see `predict`.
            class_name: Class of all of them, see `predict`.
            batch_size: How many go through the network at once, and are waited for before the
                first answer; 64 pictures or 16 clouds if None.
            workers: Threads that read and crop.
            read_ahead: Whether they read the next batch while the network is busy. If None, not
                on a CPU, where they would hold up what computes; it is worth it there where
                reading is waiting, such as for a slow disk.
            **how: `mask`, `box`, `intrinsics`, `margin` and `axes` of `predict`, for all.

        Yields:
            What `predict` gives. A picture that cannot be read raises when its turn comes, after
            the answers for those before it.

        Raises:
            ConfigurationError: as `predict`, or if a number is below 1.
            ImageError: as `predict`.
            CheckpointError: as `predict`.
        """
        if batch_size is None:
            batch_size = 16 if self.info.num_points else 64
        if batch_size < 1 or workers < 1:
            raise ConfigurationError(
                f"batch_size={batch_size} and workers={workers} must be at least 1"
            )
        if class_name is not None:
            self._check_class(class_name)
        prepare = partial(see, info=self.info, **how)
        if read_ahead is None:
            read_ahead = self.device.type != "cpu"
        lead = int(read_ahead)
        for batch in in_batches(prepare, images, workers=workers, size=batch_size, lead=lead):
            seen: list[Seen] = []
            for future in batch:
                if future.exception() is not None:
                    yield from self._answer(seen, class_name)
                seen.append(future.result())
            yield from self._answer(seen, class_name)
            del seen, batch, future  # before another one is read

    def _answer(
        self, seen: list[Seen], class_name: str | None
    ) -> Iterator[PoseResult | ClassResult]:
        """One batch through the network."""
        if not seen:
            return
        names = self.info.class_names
        batch = {
            name: torch.cat([one.batch[name] for one in seen]).to(self.device)
            for name in seen[0].batch
        }
        chosen = class_name or names[0]
        batch["class_id"] = torch.full((len(seen),), names.index(chosen), device=self.device)
        with torch.inference_mode():
            prediction = self.network(batch)
        if not isinstance(prediction, PosePrediction):
            for row, one in enumerate(seen):
                yield self._class_result(prediction.logits[row], one)
            return
        if class_name is None and self.info.num_classes > 1:
            raise ConfigurationError(
                "This network was trained for several classes and looks at each with its own "
                f"weights: add class_name=, one of {', '.join(names)}."
            )
        yield from self._pose_results(prediction, seen, class_name=chosen)

    def _check_class(self, class_name: str) -> None:
        if class_name not in self.info.class_names:
            raise ConfigurationError(
                f"class_name={class_name!r} is unknown to this network. Allowed: "
                f"{', '.join(self.info.class_names)}."
            )

    def _pose_results(
        self, prediction: PosePrediction, seen: list[Seen], *, class_name: str
    ) -> Iterator[PoseResult]:
        """The answers of one batch; what they have in common to compute is computed together."""
        symmetry = self.info.symmetry[self.info.class_names.index(class_name)]
        best = prediction.rotation.double().cpu()
        turns = torch.from_numpy(np.stack([one.camera_from_crop for one in seen]))
        answers = distinct_answers(prediction, symmetry, count=1 + _NUM_ALTERNATIVES)
        is_finite = best.isfinite().all(dim=(1, 2), keepdim=True)
        rotations = turns @ torch.where(is_finite, best, torch.eye(3, dtype=torch.float64))
        quaternions = quaternion_xyzw_from_rotation(rotations)
        euler_deg = euler_deg_from_rotation(rotations)
        mesh = self.reference_meshes.get(class_name)
        for row, one in enumerate(seen):
            _check_finite(best[row])
            yield PoseResult(
                class_name=class_name,
                symmetry=symmetry,
                rotation=rotations[row].numpy(),
                quaternion_xyzw=quaternions[row].numpy(),
                euler_deg=euler_deg[row].numpy(),
                confidence=answers[row][0][1] if answers[row] else None,
                alternatives=tuple(
                    Alternative(rotation=(turns[row] @ other).numpy(), probability=probability)
                    for other, probability in answers[row][1:]
                ),
                warnings=one.warnings,
                crop_box=one.crop_box,
                drawing=self._drawing(one, mesh),
            )

    def _class_result(self, logits: Tensor, seen: Seen) -> ClassResult:
        """The answer for one picture from its logits (C,)."""
        _check_finite(logits)
        probabilities = torch.softmax(logits.double().cpu(), dim=0)
        ranked = torch.argsort(probabilities, descending=True, stable=True).tolist()
        names = self.info.class_names
        return ClassResult(
            class_name=names[ranked[0]],
            confidence=float(probabilities[ranked[0]]),
            probabilities={names[index]: float(probabilities[index]) for index in ranked},
            warnings=seen.warnings,
            crop_box=seen.crop_box,
            drawing=self._drawing(seen, None),
        )

    def _drawing(self, seen: Seen, mesh: RenderMesh | None) -> Drawing:
        return Drawing(
            image=input_pictures(seen.batch)[0],
            info=self.info,
            mesh=mesh,
            camera_from_crop=seen.camera_from_crop,
        )


def load(
    run: str | Path, *, ckpt: str = "last", device: str = "cpu", optimize: bool = False
) -> Predictor:
    """Load a trained network for prediction.

    Args:
        run: A run folder, a checkpoint file, or a folder that `python -m i2i.export` wrote.
        ckpt: `last` or `best`, when a run folder is given.
        device: Where the network goes.
        optimize: Fold batch norms into plain convolutions (`i2i.nn.folding`): the same answers up
            to rounding.

    Returns:
        A predictor with `.predict(image)`.

    Raises:
        CheckpointError: if there is no checkpoint, or one of another format.
    """
    folder, path = locate(run, ckpt)
    task = load_task(path)
    network = fold(task.network) if optimize else task.network
    return Predictor(
        move_to(network, device),
        task.info,
        config=task.run_config,
        run_folder=folder.path,
    )


def _check_finite(values: Tensor) -> None:
    if not torch.isfinite(values).all():
        raise CheckpointError(
            "The network's answer is not a finite number: its weights are damaged or training "
            "diverged. Use another checkpoint (ckpt=best), or train again with a lower lr."
        )
