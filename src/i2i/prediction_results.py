"""What a `Predictor` answers: numbers, text, plain data and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from i2i.data.info import DataInfo
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.rendering.mesh import RenderMesh
from i2i.viz.predictions import class_figure, pose_figure
from i2i.viz.rerender import rerender
from i2i.viz.style import save_figure

EULER_CONVENTION = "extrinsic xyz: rotation = Rz(c) @ Ry(b) @ Rx(a)"
FRAME = "object to camera, x_camera = rotation @ x_object; camera x right, y up, z to the viewer"


_NOT_TOLD_APART = {"z": "turns", "z2": "half turns"}


@dataclass(frozen=True)
class Alternative:
    """Another answer that the network holds possible.

    Attributes:
        rotation: Shape (3, 3), object → camera.
        probability: Its probability mass.
    """

    rotation: np.ndarray
    probability: float


@dataclass(frozen=True)
class Drawing:
    """What a picture of an answer needs.

    Attributes:
        image: The network's input, shape (C, S, S), float32 in [0, 1].
        info: What the network was trained on.
        mesh: Reference mesh of the class; None where there is none.
        camera_from_crop: Shape (3, 3): rotations are drawn as the crop shows them.
    """

    image: np.ndarray
    info: DataInfo
    mesh: RenderMesh | None
    camera_from_crop: np.ndarray


@dataclass(frozen=True)
class PoseResult:
    """How the object in a picture is turned.

    Attributes:
        class_name: Class of the object.
        symmetry: ``"z"`` or ``"z2"`` if turns or half turns about the object's own z axis mean
            nothing, else ``"none"``.
        rotation: Shape (3, 3), object → camera (see `FRAME`).
        quaternion_xyzw: Shape (4,), the same rotation, scalar last.
        euler_deg: (a, b, c) in degrees, see `EULER_CONVENTION`.
        confidence: Probability mass of the answer; None for a network without a distribution.
        alternatives: Up to three other answers, the most probable first.
        warnings: What looked wrong with the picture.
        crop_box: (x0, y0, x1, y1) of what the network saw, in pixels of the picture; None for a
            cloud.
        drawing: What `draw` uses.
    """

    class_name: str
    symmetry: str
    rotation: np.ndarray
    quaternion_xyzw: np.ndarray
    euler_deg: np.ndarray
    confidence: float | None
    alternatives: tuple[Alternative, ...]
    warnings: tuple[str, ...]
    crop_box: tuple[float, float, float, float] | None
    drawing: Drawing

    def __str__(self) -> str:
        """Everything in plain lines."""
        lines = [f"class           {self.class_name}", "rotation        object to camera"]
        lines += ["  " + "  ".join(f"{value:+.4f}" for value in row) for row in self.rotation]
        x, y, z, w = self.quaternion_xyzw
        lines.append(f"quaternion xyzw {x:+.4f} {y:+.4f} {z:+.4f} {w:+.4f}")
        a, b, c = self.euler_deg
        lines.append(f"Euler           {a:+.1f}° {b:+.1f}° {c:+.1f}°  ({EULER_CONVENTION})")
        if self.symmetry in _NOT_TOLD_APART:
            turns = _NOT_TOLD_APART[self.symmetry]
            lines.append(
                f"symmetry        {turns} about the object's own z axis are not told apart"
            )
        if self.confidence is not None:
            lines.append(f"confidence      {self.confidence:.1%}")
        lines += [
            f"alternative {number}   {other.probability:.1%}, {self._apart_deg(other):.0f}° away"
            for number, other in enumerate(self.alternatives, start=1)
        ]
        return "\n".join(lines + [f"warning: {text}" for text in self.warnings])

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and numbers, ready for JSON."""
        return {
            "task": "pose",
            "class_name": self.class_name,
            "symmetry": self.symmetry,
            "frame": FRAME,
            "rotation": self.rotation.tolist(),
            "quaternion_xyzw": self.quaternion_xyzw.tolist(),
            "euler_deg": self.euler_deg.tolist(),
            "euler_convention": EULER_CONVENTION,
            "confidence": self.confidence,
            "alternatives": [
                {"rotation": other.rotation.tolist(), "probability": other.probability}
                for other in self.alternatives
            ],
            "crop_box": None if self.crop_box is None else list(self.crop_box),
            "warnings": list(self.warnings),
        }

    def draw(self, path: str | Path, *, renderer: str = "embree") -> Path:
        """Save a picture: the input beside the reference mesh in the predicted orientations.

        Args:
            path: Where to; .png, .pdf or .svg.
            renderer: Name of the renderer.

        Returns:
            The path.
        """
        rotations = np.stack([self.rotation, *(other.rotation for other in self.alternatives)])
        views = None
        if self.drawing.mesh is not None:
            views = rerender(
                self.drawing.mesh, self.drawing.camera_from_crop.T @ rotations,
                info=self.drawing.info, image_size=max(128, self.drawing.info.image_size),
                renderer=renderer,
            )  # fmt: skip
        figure = pose_figure(
            self.drawing.image,
            views=views,
            class_name=self.class_name,
            euler_deg=self.euler_deg,
            probabilities=[self.confidence, *(other.probability for other in self.alternatives)],
            warnings=self.warnings,
        )
        return save_figure(figure, path)

    def _apart_deg(self, other: Alternative) -> float:
        """Angle between an alternative and the answer, the smallest that the symmetry allows."""
        a, b = torch.from_numpy(self.rotation), torch.from_numpy(other.rotation)
        return float(torch.rad2deg(symmetric_angle_rad(a.double(), b.double(), self.symmetry)))


@dataclass(frozen=True)
class ClassResult:
    """Of which class the object in a picture is.

    Attributes:
        class_name: The most probable class.
        confidence: Its probability.
        probabilities: Of every class, the most probable first.
        warnings: What looked wrong with the picture.
        crop_box: (x0, y0, x1, y1) of what the network saw, in pixels of the picture; None for a
            cloud.
        drawing: What `draw` uses.
    """

    class_name: str
    confidence: float
    probabilities: dict[str, float]
    warnings: tuple[str, ...]
    crop_box: tuple[float, float, float, float] | None
    drawing: Drawing

    def __str__(self) -> str:
        """Everything in plain lines: the four most probable classes."""
        lines = [f"class           {self.class_name}", f"confidence      {self.confidence:.1%}"]
        others = list(self.probabilities.items())[1:4]
        lines += [
            f"alternative {number}   {name} {probability:.1%}"
            for number, (name, probability) in enumerate(others, start=1)
        ]
        return "\n".join(lines + [f"warning: {text}" for text in self.warnings])

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and numbers, ready for JSON."""
        return {
            "task": "classification",
            "class_name": self.class_name,
            "confidence": self.confidence,
            "probabilities": dict(self.probabilities),
            "crop_box": None if self.crop_box is None else list(self.crop_box),
            "warnings": list(self.warnings),
        }

    def draw(self, path: str | Path) -> Path:
        """Save a picture: the input beside the most probable classes.

        Args:
            path: Where to; .png, .pdf or .svg.

        Returns:
            The path.
        """
        figure = class_figure(
            self.drawing.image, probabilities=self.probabilities, warnings=self.warnings
        )
        return save_figure(figure, path)
