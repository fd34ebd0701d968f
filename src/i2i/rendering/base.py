"""The interface of a renderer, and how to get one by name."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from i2i.geometry.cameras import Camera
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.shading import encode_depth

Modality = Literal["gray", "depth", "rgb"]
MODALITIES: tuple[str, ...] = get_args(Modality)
CHANNELS: dict[str, int] = {"gray": 1, "depth": 1, "rgb": 3}

# Class of each renderer by name; imported on demand, since one of them loads OpenGL.
_RENDERERS: dict[str, tuple[str, str]] = {
    "embree": ("i2i.rendering.embree", "EmbreeRenderer"),
    "pyrender": ("i2i.rendering.pyrender", "PyrenderRenderer"),
    "blender": ("i2i.rendering.blender", "BlenderRenderer"),
}


class Renderer(ABC):
    """Draws meshes as seen by a camera on the z axis that looks at the origin.

    An instance holds native resources (a ray-casting scene, an OpenGL context): make one in each
    process, do not pickle it. Successive calls with the same mesh object share its set-up.
    """

    name: ClassVar[str]

    @classmethod
    def options(cls, words: Mapping[str, str]) -> dict[str, Any]:
        """Arguments of the constructor from the options behind a renderer's name.

        Args:
            words: Each option's text by its name.

        Returns:
            All options, those left out with their defaults; most renderers have none.

        Raises:
            ValueError: for an unknown option or value.
        """
        if words:
            raise ValueError(f"renderer={cls.name!r} has no options, but got {', '.join(words)}")
        return {}

    @property
    @abstractmethod
    def version(self) -> str:
        """Versions of what makes the pixels; part of a store's identity."""

    @classmethod
    @abstractmethod
    def available(cls) -> None:
        """Return if the renderer can run here.

        Raises:
            RendererUnavailableError: with what to install.
        """

    def render(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        *,
        camera: Camera | None = None,
        image_size: int = 128,
        modality: str = "gray",
    ) -> NDArray[np.uint8]:
        """Draw a mesh in several orientations.

        Args:
            mesh: In the object frame.
            rotations: Object to camera, shape (N, 3, 3): `x_camera = rotation @ x_object`.
            camera: Distance and field of view; the default camera if None.
            image_size: Side of the square picture in pixels.
            modality: "gray" (white material, light at the camera), "depth" (near 255, far 0) or
                "rgb" (materials and textures in the same light).

        Returns:
            Pictures, shape (N, C, H, W), uint8, first row on top; background 255.

        Raises:
            ValueError: for another modality, shape or size, or matrices that are not rotations.
        """
        if modality not in MODALITIES:
            raise ValueError(
                f"modality={modality!r} is unknown; use one of {', '.join(MODALITIES)}"
            )
        camera = Camera() if camera is None else camera
        rotations = _checked_rotations(rotations, image_size)
        if modality == "depth":
            depth = self._ray_lengths(mesh, rotations, camera, image_size)
            return encode_depth(depth, distance=camera.distance)[:, None]
        return self._colors(mesh, rotations, camera, image_size, modality)

    def depth(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        *,
        camera: Camera | None = None,
        image_size: int = 128,
    ) -> NDArray[np.float32]:
        """Length of the ray from the camera to the surface (not its z), in object units.

        Args:
            mesh: In the object frame.
            rotations: Object to camera, shape (N, 3, 3).
            camera: Distance and field of view; the default camera if None.
            image_size: Side of the square picture in pixels.

        Returns:
            Shape (N, H, W), float32; 0 is background.

        Raises:
            ValueError: for another shape or size, or matrices that are not rotations.
        """
        camera = Camera() if camera is None else camera
        rotations = _checked_rotations(rotations, image_size)
        return self._ray_lengths(mesh, rotations, camera, image_size)

    @abstractmethod
    def _ray_lengths(
        self, mesh: RenderMesh, rotations: NDArray[np.float64], camera: Camera, image_size: int
    ) -> NDArray[np.float32]:
        """See `depth`; the arguments are checked."""

    @abstractmethod
    def _colors(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        camera: Camera,
        image_size: int,
        modality: str,
    ) -> NDArray[np.uint8]:
        """See `render` for "gray" and "rgb"; the arguments are checked."""


def get_renderer(name: str) -> Renderer:
    """A new renderer.

    Args:
        name: "embree" (ray casting, no system library), "pyrender" (OpenGL, as in the paper) or
            "blender" (path tracing), with options behind a colon: "blender:samples=16,bounces=0".

    Raises:
        ValueError: for another name or option.
        RendererUnavailableError: if its library is missing.
    """
    renderer_class, options = _renderer_class(name)
    renderer_class.available()
    return renderer_class(**options)


def canonical_name(name: str) -> str:
    """The name of a renderer with all of its options spelled out, as far as it has any.

    Two names that mean the same renderer have the same canonical name, and it says what was drawn
    even if a default changes. Works where the renderer is not installed.

    Raises:
        ValueError: for another name or option.
    """
    renderer_class, options = _renderer_class(name)
    words = ",".join(f"{key}={value}".lower() for key, value in sorted(options.items()))
    return f"{renderer_class.name}:{words}" if words else renderer_class.name


def _renderer_class(name: str) -> tuple[type[Renderer], dict[str, Any]]:
    """The class behind a name such as "blender:samples=16", and the options for its constructor."""
    bare, _, words = name.partition(":")
    if bare not in _RENDERERS:
        raise ValueError(f"renderer={name!r} is unknown; use one of {', '.join(_RENDERERS)}")
    module, class_name = _RENDERERS[bare]
    renderer_class: type[Renderer] = getattr(importlib.import_module(module), class_name)
    pairs = [word.partition("=") for word in words.split(",") if word]
    return renderer_class, renderer_class.options({key.strip(): v.strip() for key, _, v in pairs})


def renderer_names() -> tuple[str, ...]:
    """The names that `get_renderer` knows."""
    return tuple(_RENDERERS)


def _checked_rotations(rotations: NDArray[np.float64], image_size: int) -> NDArray[np.float64]:
    """The rotations as float64; ValueError if they are none."""
    if image_size < 1:
        raise ValueError(f"image_size={image_size} must be at least 1")
    matrices = np.asarray(rotations, dtype=np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise ValueError(f"rotations has shape {matrices.shape}; it must be (N, 3, 3)")
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    # A triple product, since numpy's determinant warns about NaN instead of passing it on.
    handedness = (np.cross(matrices[:, 0], matrices[:, 1]) * matrices[:, 2]).sum(axis=1)
    good = (off < 1e-4) & (handedness > 0)
    if not good.all():
        first = int(np.flatnonzero(~good)[0])
        raise ValueError(
            f"rotations[{first}] is not a rotation: its rows must be orthonormal and its "
            f"determinant +1, got {matrices[first].tolist()}"
        )
    return matrices
