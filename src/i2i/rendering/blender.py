"""Path tracing with Blender's Cycles: the kind of pictures that the paper has of ShapeNet."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from importlib.metadata import version as package_version
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering.base import CHANNELS, Renderer
from i2i.rendering.blender_scene import CyclesScene, load_bpy
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.shading import BACKGROUND, display_value

# Raised when the pixels change for the same mesh and camera, so that stores are not mixed.
_SHADING_VERSION = 1
_SMALLEST_PICTURE = 4  # pixels; Blender silently draws smaller ones at this size
_DEFAULTS = {"samples": 32, "bounces": 2, "denoise": False}


class BlenderRenderer(Renderer):
    """Cycles on the processor: light that is reflected between surfaces, true area sampling.

    Camera, lamp, materials and normals are those of the other renderers. The same mesh, rotation
    and options give the same bytes, whatever was drawn before and with how many threads. There is
    one Blender in a process: two instances that take turns set up their scenes anew each time.

    Args:
        samples: Paths through each pixel. The noise falls with the square root.
        bounces: Reflections between surfaces; 0 is direct light alone, as the others have.
        denoise: Filter the noise with Intel's Open Image Denoise; few samples are then enough, but
            the pictures depend on its version, too.

    Raises:
        ValueError: if an option is out of its range.
    """

    name: ClassVar[str] = "blender"

    def __init__(self, *, samples: int = 32, bounces: int = 2, denoise: bool = False) -> None:
        if samples < 1:
            raise ValueError(f"renderer.samples={samples} is not allowed: give at least 1.")
        if bounces < 0:
            raise ValueError(f"renderer.bounces={bounces} is not allowed: give 0 or more.")
        self.samples, self.bounces, self.denoise = samples, bounces, denoise
        self._mesh: RenderMesh | None = None
        self._key: tuple[str, Camera, int] | None = None
        self._scene: CyclesScene | None = None

    @classmethod
    def options(cls, words: Mapping[str, str]) -> dict[str, Any]:
        """Arguments of the constructor from texts, with the defaults of those left out.

        Raises:
            ValueError: if one is unknown or not a number (not true or false, for `denoise`).
        """
        chosen: dict[str, Any] = dict(_DEFAULTS)
        for name, text in words.items():
            if name not in _DEFAULTS:
                raise ValueError(
                    f"renderer={cls.name!r} has no option {name!r}; it has {', '.join(_DEFAULTS)}"
                )
            chosen[name] = _truth(name, text) if name == "denoise" else _whole(name, text)
        return chosen

    @property
    def version(self) -> str:
        """Version of Blender and of the shading, and the options."""
        filtered = ", denoised" if self.denoise else ""
        return (
            f"bpy {package_version('bpy')}, shading {_SHADING_VERSION}, samples {self.samples}, "
            f"bounces {self.bounces}{filtered}"
        )

    @classmethod
    def available(cls) -> None:
        """Return if Blender's module is installed and its libraries are there.

        Raises:
            RendererUnavailableError: with what to install.
        """
        if importlib.util.find_spec("bpy") is None:
            python = ".".join(map(str, sys.version_info[:2]))
            raise RendererUnavailableError(
                "the renderer 'blender' needs the package bpy 4.5; type: "
                f'pip install "i2i[blender]" (it exists for Python 3.11 only; this is {python}), '
                "or use the default: renderer=embree"
            )
        try:
            load_bpy()
        except ImportError as error:
            raise RendererUnavailableError(
                f"the renderer 'blender' cannot load bpy ({error}); it needs these libraries "
                "(Debian, Ubuntu): apt-get install libx11-6 libxrender1 libxfixes3 libxi6 "
                "libxkbcommon0 libsm6 libice6 libgl1, or use the default: renderer=embree"
            ) from error

    def close(self) -> None:
        """Forget the mesh; the next call sets up a scene."""
        if self._scene is not None:
            self._scene.close()
        self._mesh, self._key, self._scene = None, None, None

    def _ray_lengths(
        self, mesh: RenderMesh, rotations: NDArray[np.float64], camera: Camera, image_size: int
    ) -> NDArray[np.float32]:
        depth = np.zeros((len(rotations), image_size, image_size), dtype=np.float32)
        if not len(rotations):
            return depth
        scene = self._prepare(mesh, "depth", camera, image_size)
        for view, rotation in enumerate(rotations):
            picture = scene.shoot(rotation)
            depth[view] = np.where(picture[..., 3] > 0.5, picture[..., 0], 0.0)
        return depth

    def _colors(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        camera: Camera,
        image_size: int,
        modality: str,
    ) -> NDArray[np.uint8]:
        channels = CHANNELS[modality]
        images = np.empty((len(rotations), channels, image_size, image_size), dtype=np.uint8)
        if not len(rotations):
            return images
        scene = self._prepare(mesh, modality, camera, image_size)
        for view, rotation in enumerate(rotations):
            picture = scene.shoot(rotation)
            # White under white light: the three channels of a gray picture differ by rounding only.
            images[view] = _on_white(picture).transpose(2, 0, 1)[:channels]
        return images

    def _prepare(
        self, mesh: RenderMesh, modality: str, camera: Camera, image_size: int
    ) -> CyclesScene:
        """The scene of the last call if it fits and is still there, else a new one."""
        if image_size < _SMALLEST_PICTURE:
            raise ValueError(
                f"image_size={image_size} is too small for the renderer 'blender'; "
                f"give at least {_SMALLEST_PICTURE}"
            )
        key = (modality, camera, image_size)
        fits = self._mesh is mesh and self._key == key
        if self._scene is None or not fits or not self._scene.alive:
            self.close()
            self._scene = CyclesScene(
                mesh,
                modality,
                camera,
                image_size,
                samples=self.samples,
                bounces=self.bounces,
                denoise=self.denoise,
            )
            self._mesh, self._key = mesh, key
        return self._scene


def _on_white(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Bytes of a picture in front of white, shape (H, W, 3).

    Args:
        picture: Linear light times coverage, and coverage, shape (H, W, 4).
    """
    coverage = np.clip(picture[..., 3:], 0.0, 1.0)
    light = picture[..., :3] / np.maximum(coverage, 1e-6)
    # Mixed as values of the display, as the other renderers average their samples.
    values = display_value(light) * coverage + BACKGROUND * (1 - coverage)
    return np.rint(values).astype(np.uint8)


def _whole(name: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"renderer.{name}={text} is not allowed: give a whole number.") from None


def _truth(name: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(f"renderer.{name}={text} is not allowed: give true or false.")
    return text.lower() == "true"
