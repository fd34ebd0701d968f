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
from i2i.rendering.blender_process import BlenderProcess
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.shading import BACKGROUND, display_value

# Raised when the pixels change for the same mesh and camera, so that stores are not mixed.
_SHADING_VERSION = 1
_SMALLEST_PICTURE = 4  # pixels; Blender silently draws smaller ones at this size
_DEFAULTS = {"samples": 32, "bounces": 2, "denoise": False}


class BlenderRenderer(Renderer):
    """Cycles on the processor: light that is reflected between surfaces, true area sampling.

    Camera, lamp, materials and normals are those of the other renderers. The same mesh, rotation
    and options give the same bytes, whatever was drawn before and with how many threads.

    Blender runs in a process of its own, which starts with the first picture and ends with this
    instance. It uses OMP_NUM_THREADS threads, without that variable one for each core.

    Args:
        samples: Paths through each pixel. The noise falls with the square root.
        bounces: Reflections between surfaces; 0 is direct light alone, as the others have.
        denoise: Filter the noise with Intel's Open Image Denoise; few samples are then enough, but
            the pictures depend on its version, too.

    Raises:
        ValueError: if an option is out of its range.
    """

    name: ClassVar[str] = "blender"
    _process: BlenderProcess | None = None

    def __init__(self, *, samples: int = 32, bounces: int = 2, denoise: bool = False) -> None:
        if samples < 1:
            raise ValueError(f"renderer.samples={samples} is not allowed: give at least 1.")
        if bounces < 0:
            raise ValueError(f"renderer.bounces={bounces} is not allowed: give 0 or more.")
        self.samples, self.bounces, self.denoise = samples, bounces, denoise
        self._mesh: RenderMesh | None = None
        self._key: tuple[str, Camera, int] | None = None

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
        """Return if Blender's module is installed; its libraries are first needed to draw.

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

    def close(self) -> None:
        """End Blender; the next call starts it again."""
        if self._process is not None:
            self._process.close()
        self._process, self._mesh, self._key = None, None, None

    def __del__(self) -> None:
        """End Blender with its last user."""
        self.close()

    def _ray_lengths(
        self, mesh: RenderMesh, rotations: NDArray[np.float64], camera: Camera, image_size: int
    ) -> NDArray[np.float32]:
        depth = np.zeros((len(rotations), image_size, image_size), dtype=np.float32)
        if not len(rotations):
            return depth
        process = self._prepare(mesh, "depth", camera, image_size)
        for view, rotation in enumerate(rotations):
            picture = process.shoot(rotation)
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
        process = self._prepare(mesh, modality, camera, image_size)
        for view, rotation in enumerate(rotations):
            picture = process.shoot(rotation)
            # White under white light: the three channels of a gray picture differ by rounding only.
            images[view] = _on_white(picture).transpose(2, 0, 1)[:channels]
        return images

    def _prepare(
        self, mesh: RenderMesh, modality: str, camera: Camera, image_size: int
    ) -> BlenderProcess:
        """Blender with this mesh set up; the last set-up is kept."""
        if image_size < _SMALLEST_PICTURE:
            raise ValueError(
                f"image_size={image_size} is too small for the renderer 'blender'; "
                f"give at least {_SMALLEST_PICTURE}"
            )
        if self._process is not None and not self._process.running:
            self.close()
        if self._process is None:
            self._process = BlenderProcess()
        key = (modality, camera, image_size)
        if self._mesh is not mesh or self._key != key:
            self._mesh, self._key = None, None  # if it fails, nothing is set up
            self._process.set_up(
                mesh,
                modality,
                camera,
                image_size,
                samples=self.samples,
                bounces=self.bounces,
                denoise=self.denoise,
            )
            self._mesh, self._key = mesh, key
        return self._process


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
