"""The default renderer: ray casting on the CPU with Embree, which comes as a wheel."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version as package_version
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering.base import CHANNELS, Renderer
from i2i.rendering.embree_scene import EmbreeScene
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.raygrid import SAMPLE_OFFSETS, RayGrid, edge_pixels
from i2i.rendering.shading import BACKGROUND

# Raised when the pixels change for the same mesh and camera, so that stores are not mixed.
_SHADING_VERSION = 1
# Neighbours that differ by more (of 255) are an edge; smaller steps would not be seen smoothed.
_EDGE_THRESHOLD = 25.0
# Pixels of the views that are drawn together: enough to make up for what a call costs, and few
# enough that the arrays between the steps stay in the processor's cache.
_PIXELS_AT_ONCE = 8 * 128 * 128


class EmbreeRenderer(Renderer):
    """Ray casting with smooth normals that keep sharp edges; both sides of a face are lit alike.

    Depth is taken at the pixel centres. In gray and rgb, pixels on an edge are the mean of four
    samples, like OpenGL's multisampling. Rays that cannot meet the object are never cast.

    Args:
        antialias: False casts only the centre ray, about twice as fast.
    """

    name: ClassVar[str] = "embree"

    def __init__(self, *, antialias: bool = True) -> None:
        self._antialias = antialias
        self._scene: EmbreeScene | None = None
        self._rays: RayGrid | None = None

    @property
    def version(self) -> str:
        """Version of embreex and of the shading."""
        samples = 4 if self._antialias else 1
        return (
            f"embreex {package_version('embreex')}, shading {_SHADING_VERSION}, samples {samples}"
        )

    @classmethod
    def available(cls) -> None:
        """Return if embreex can be imported.

        Raises:
            RendererUnavailableError: if not.
        """
        try:
            import embreex.rtcore_scene  # noqa: F401
        except ImportError as error:
            raise RendererUnavailableError(
                f"the renderer 'embree' needs the package embreex ({error}); "
                "type: pip install embreex"
            ) from error

    def _ray_lengths(
        self, mesh: RenderMesh, rotations: NDArray[np.float64], camera: Camera, image_size: int
    ) -> NDArray[np.float32]:
        scene, rays = self._prepare(mesh, camera, image_size)
        depth = np.zeros((len(rotations), image_size, image_size), dtype=np.float32)
        for views in _groups(len(rotations), image_size):
            pixel, hits = scene.cast_centers(rays, rotations[views])
            depth[views].reshape(-1)[pixel] = hits.distance
        return depth

    def _colors(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        camera: Camera,
        image_size: int,
        modality: str,
    ) -> NDArray[np.uint8]:
        scene, rays = self._prepare(mesh, camera, image_size)
        shape = (len(rotations), CHANNELS[modality], image_size, image_size)
        images = np.empty(shape, dtype=np.uint8)
        for views in _groups(len(rotations), image_size):
            images[views] = self._draw(scene, rays, rotations[views], modality)
        return images

    def _draw(
        self, scene: EmbreeScene, rays: RayGrid, rotations: NDArray[np.float64], modality: str
    ) -> NDArray[np.float32]:
        """Whole numbers of the pictures of some views, shape (N, C, S, S)."""
        size, channels = rays.image_size, CHANNELS[modality]
        values = np.full((channels, len(rotations) * size * size), BACKGROUND, dtype=np.float32)
        pictures = values.reshape(channels, len(rotations), size, size)
        pixel, hits = scene.cast_centers(rays, rotations)
        _put(values, pixel, scene.picture_values(hits, modality, rays.pixel_width))
        if self._antialias:
            edge = edge_pixels(pictures, _EDGE_THRESHOLD)
            _put(values, edge, _smoothed(scene, rays, rotations, edge, modality))
        np.rint(values, out=values)
        return pictures.swapaxes(0, 1)

    def _prepare(
        self, mesh: RenderMesh, camera: Camera, image_size: int
    ) -> tuple[EmbreeScene, RayGrid]:
        """The scene of the mesh and the camera's rays; the last ones are kept."""
        if self._scene is None or self._scene.mesh is not mesh:
            self._scene = EmbreeScene(mesh)
        rays = self._rays
        if rays is None or (rays.camera, rays.image_size) != (camera, image_size):
            self._rays = rays = RayGrid(camera, image_size)
        return self._scene, rays


def _groups(count: int, image_size: int) -> Iterator[slice]:
    """Views that are drawn together."""
    step = max(1, _PIXELS_AT_ONCE // image_size**2)
    return (slice(start, start + step) for start in range(0, count, step))


def _put(values: NDArray[np.float32], pixel: NDArray[np.int64], new: NDArray[np.float32]) -> None:
    """`values[:, pixel] = new`, which numpy does faster row by row."""
    for row, part in zip(values, new, strict=True):
        row[pixel] = part


def _smoothed(
    scene: EmbreeScene,
    rays: RayGrid,
    rotations: NDArray[np.float64],
    pixel: NDArray[np.int64],
    modality: str,
) -> NDArray[np.float32]:
    """Values of some pixels of the views as the mean of their samples, shape (C, K)."""
    samples = len(SAMPLE_OFFSETS)
    hits = scene.cast_samples(rays, rotations, pixel)
    values = np.full((CHANNELS[modality], len(pixel) * samples), BACKGROUND, dtype=np.float32)
    _put(values, hits.ray, scene.picture_values(hits, modality, rays.pixel_width))
    # One by one, in this order: a sum over so short an axis is slow.
    total = values[:, 0::samples] + values[:, 1::samples]
    for number in range(2, samples):
        total += values[:, number::samples]
    total /= np.float32(samples)
    return total
