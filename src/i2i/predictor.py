"""A trained network that answers for one picture: `i2i.load(run).predict("photo.png")`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from i2i.data.info import DataInfo
from i2i.data.photographs import prepare_photograph
from i2i.data.pictures import Picture
from i2i.data.point_files import Cloud, prepare_cloud
from i2i.errors import CheckpointError, ConfigurationError
from i2i.geometry.cameras import Camera
from i2i.geometry.rotations import euler_deg_from_rotation, quaternion_xyzw_from_rotation
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.models.prediction import PosePrediction
from i2i.prediction_results import Alternative, ClassResult, Drawing, PoseResult
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.reference import load_mesh
from i2i.runs.loading import load_task, locate, move_to
from i2i.viz.inputs import input_pictures

SAME_ANSWER_DEG = 15.0
"""Candidates closer than this to a better one count as the same answer; their mass is added up."""

_NUM_ALTERNATIVES = 3


@dataclass(frozen=True)
class _Seen:
    """What the network gets (without the class), and what was done to it."""

    batch: dict[str, Tensor]
    crop_box: tuple[float, float, float, float] | None
    warnings: tuple[str, ...]
    camera_from_crop: np.ndarray


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
        if self.info.num_points is not None:
            crop = {"mask": mask, "box": box, "intrinsics": intrinsics}
            seen = self._see_cloud(image, axes, **crop, margin=None if margin == 1 else margin)
        elif axes != "opengl":
            raise ConfigurationError(
                f"axes={axes} is for clouds, and this network sees {self.info.modality}: leave it "
                "out"
            )
        else:
            seen = self._see_picture(image, mask, box, intrinsics, margin)
        batch = {name: tensor.to(self.device) for name, tensor in seen.batch.items()}
        chosen = class_name or self.info.class_names[0]
        batch["class_id"] = torch.tensor([self.info.class_names.index(chosen)], device=self.device)
        with torch.inference_mode():
            prediction = self.network(batch)
        if not isinstance(prediction, PosePrediction):
            return self._class_result(prediction.logits, seen)
        if class_name is None and self.info.num_classes > 1:
            raise ConfigurationError(
                "This network was trained for several classes and looks at each with its own "
                f"weights: add class_name=, one of {', '.join(self.info.class_names)}."
            )
        return self._pose_result(prediction, seen, class_name=chosen)

    def _see_picture(
        self, image: Any, mask: Any, box: Any, intrinsics: Any, margin: float  # noqa: ANN401
    ) -> _Seen:  # fmt: skip
        """A picture as an image network wants it."""
        if self.info.num_views is not None:
            raise ConfigurationError(
                f"This network looks at {self.info.num_views} views of one object at once, from "
                "fixed cameras around it: it cannot answer for a single picture. Use a run with "
                "data.modality=gray | depth | rgb."
            )
        prepared = prepare_photograph(
            image, channels=self.info.channels, image_size=self.info.image_size,
            background=self.info.background, mask=mask, box=box, intrinsics=intrinsics,
            margin=margin,
            camera=Camera(distance=self.info.camera_distance, fov_deg=self.info.camera_fov_deg),
        )  # fmt: skip
        return _Seen(
            {"image": prepared.tensor}, prepared.crop_box,
            (*prepared.warnings, *self._modality_warnings()), prepared.camera_from_crop,
        )  # fmt: skip

    def _see_cloud(self, cloud: Any, axes: str, **of_pictures: Any) -> _Seen:  # noqa: ANN401
        """A cloud as a point network wants it."""
        given = [name for name, value in of_pictures.items() if value is not None]
        if given:
            raise ConfigurationError(
                f"{given[0]}= is for pictures, and this network sees {self.info.modality}: "
                "give the points of the object alone"
            )
        assert self.info.num_points is not None
        points = prepare_cloud(cloud, num_points=self.info.num_points, axes=axes)
        return _Seen({"points": points}, None, (), np.eye(3))

    def _check_class(self, class_name: str) -> None:
        if class_name not in self.info.class_names:
            raise ConfigurationError(
                f"class_name={class_name!r} is unknown to this network. Allowed: "
                f"{', '.join(self.info.class_names)}."
            )

    def _modality_warnings(self) -> tuple[str, ...]:
        if self.info.modality != "depth":
            return ()
        return (
            "The network was trained on depth images (near white, far black, background white), "
            "not on photographs: give such a depth image.",
        )

    def _pose_result(
        self, prediction: PosePrediction, seen: _Seen, *, class_name: str
    ) -> PoseResult:
        symmetry = self.info.symmetry[self.info.class_names.index(class_name)]
        best = prediction.rotation[0].double().cpu()
        _check_finite(best)
        answers = _distinct_answers(prediction, best, symmetry=symmetry)
        turn = torch.from_numpy(seen.camera_from_crop)
        rotation = turn @ best
        return PoseResult(
            class_name=class_name,
            symmetry=symmetry,
            rotation=rotation.numpy(),
            quaternion_xyzw=quaternion_xyzw_from_rotation(rotation).numpy(),
            euler_deg=euler_deg_from_rotation(rotation).numpy(),
            confidence=answers[0][1] if answers else None,
            alternatives=tuple(
                Alternative(rotation=(turn @ other).numpy(), probability=probability)
                for other, probability in answers[1 : 1 + _NUM_ALTERNATIVES]
            ),
            warnings=seen.warnings,
            crop_box=seen.crop_box,
            drawing=self._drawing(seen, self.reference_meshes.get(class_name)),
        )

    def _class_result(self, logits: Tensor, seen: _Seen) -> ClassResult:
        _check_finite(logits)
        probabilities = torch.softmax(logits[0].double().cpu(), dim=0)
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

    def _drawing(self, seen: _Seen, mesh: RenderMesh | None) -> Drawing:
        return Drawing(
            image=input_pictures(seen.batch)[0],
            info=self.info,
            mesh=mesh,
            camera_from_crop=seen.camera_from_crop,
        )


def load(run: str | Path, *, ckpt: str = "last", device: str = "cpu") -> Predictor:
    """Load a trained network for prediction.

    Args:
        run: A run folder, or a checkpoint file.
        ckpt: `last` or `best`, when a folder is given.
        device: Where the network goes.

    Returns:
        A predictor with `.predict(image)`.

    Raises:
        CheckpointError: if there is no checkpoint, or one of another format.
    """
    folder, path = locate(run, ckpt)
    task = load_task(path)
    return Predictor(
        move_to(task.network, device),
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


def _distinct_answers(
    prediction: PosePrediction, best: Tensor, *, symmetry: str
) -> list[tuple[Tensor, float]]:
    """Different answers and their probability masses, the given best one first.

    Several candidates may stand for one rotation (neighbouring group elements whose residuals
    meet): each candidate's mass goes to the first answer within `SAME_ANSWER_DEG` of it, going
    through the candidates from the most probable to the least. Answers that look the same by the
    symmetry of the class are one.

    Returns:
        Empty for a network without a distribution.
    """
    if prediction.log_prob is None or prediction.candidates is None:
        return []
    candidates = prediction.candidates.double().cpu()
    candidates = candidates if candidates.ndim == 3 else candidates[0]  # (K, 3, 3)
    mass = prediction.log_prob[0].double().exp().cpu()
    answers, free = [], torch.ones(len(mass), dtype=torch.bool)
    order = torch.argsort(mass, descending=True, stable=True).tolist()
    centers = [best, *(candidates[index] for index in order)]
    for number, center in enumerate(centers):
        if number and not free[order[number - 1]]:
            continue
        same = free & (torch.rad2deg(symmetric_angle_rad(candidates, center, symmetry))
                       <= SAME_ANSWER_DEG)  # fmt: skip
        answers.append((center, float(mass[same].sum())))
        free &= ~same
        if len(answers) > _NUM_ALTERNATIVES:
            break
    # The best stays first: it is what the network answers, even where merged masses rank higher.
    return [answers[0], *sorted(answers[1:], key=lambda answer: -answer[1])]
