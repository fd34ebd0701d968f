"""The default renderer: ray casting on the CPU with Embree, which comes as a wheel."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version as package_version
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering.base import CHANNELS, Renderer
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.raygrid import RayGrid, edge_pixels
from i2i.rendering.shading import (
    BACKGROUND,
    COLOR_LIGHT,
    GRAY_LIGHT,
    corner_normals,
    display_value,
    face_normals,
    linear_from_srgb,
    reflected_light,
)
from i2i.rendering.textures import TexturePyramid, texel_density

# Raised when the pixels change for the same mesh and camera, so that stores are not mixed.
_SHADING_VERSION = 1
# Neighbours that differ by more (of 255) are an edge; smaller steps would not be seen smoothed.
_EDGE_THRESHOLD = 25.0
_MIN_SLANT = 0.05  # cosine below which texture levels stop growing coarser


@dataclass(frozen=True, eq=False)
class _Hits:
    """Where rays meet the surface; arrays over the H rays that do."""

    ray: NDArray[np.int64]  # (H,) number of the ray
    face: NDArray[np.int32]  # (H,)
    distance: NDArray[np.float32]  # (H,) ray length
    direction: NDArray[np.float32]  # (H, 3) unit, object frame
    weights: NDArray[np.float32]  # (H, 3) barycentric


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
        self._scene: _Scene | None = None
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
        depth = np.zeros((len(rotations), image_size * image_size), dtype=np.float32)
        for view, rotation in enumerate(rotations):
            pixel, hits = scene.cast_grid(rays, rotation)
            depth[view, pixel] = hits.distance
        return depth.reshape(len(rotations), image_size, image_size)

    def _colors(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        camera: Camera,
        image_size: int,
        modality: str,
    ) -> NDArray[np.uint8]:
        scene, rays = self._prepare(mesh, camera, image_size)
        channels = CHANNELS[modality]
        shape = (len(rotations), channels, image_size, image_size)
        images = np.empty(shape, dtype=np.uint8)
        for view, rotation in enumerate(rotations):
            values = np.full((channels, image_size * image_size), BACKGROUND, dtype=np.float32)
            pixel, hits = scene.cast_grid(rays, rotation)
            values[:, pixel] = scene.picture_values(hits, modality, rays.pixel_width)
            if self._antialias:
                edge = edge_pixels(values.reshape(shape[1:]), _EDGE_THRESHOLD)
                values[:, edge] = _smoothed(scene, rays, rotation, edge, modality)
            images[view] = np.rint(values).reshape(shape[1:])
        return images

    def _prepare(self, mesh: RenderMesh, camera: Camera, image_size: int) -> tuple[_Scene, RayGrid]:
        """The scene of the mesh and the camera's rays; the last ones are kept."""
        if self._scene is None or self._scene.mesh is not mesh:
            self._scene = _Scene(mesh)
        radius = self._scene.radius
        rays = self._rays
        if rays is None or (rays.camera, rays.image_size, rays.radius) != (
            camera,
            image_size,
            radius,
        ):
            self._rays = rays = RayGrid(camera, image_size, radius)
        return self._scene, rays


def _smoothed(
    scene: _Scene,
    rays: RayGrid,
    rotation: NDArray[np.float64],
    pixel: NDArray[np.int64],
    modality: str,
) -> NDArray[np.float32]:
    """Values of some pixels as the mean of four samples, shape (C, K)."""
    if not len(pixel):  # a box seen along an axis has no edges that cut a pixel
        return np.empty((CHANNELS[modality], 0), dtype=np.float32)
    directions = rays.samples(pixel).reshape(-1, 3)
    hits = scene.cast(directions, rotation, rays.camera.distance)
    values = np.full((CHANNELS[modality], len(directions)), BACKGROUND, dtype=np.float32)
    values[:, hits.ray] = scene.picture_values(hits, modality, rays.pixel_width)
    mean: NDArray[np.float32] = values.reshape(len(values), len(pixel), -1).mean(axis=-1)
    return mean


class _Scene:
    """A mesh in Embree, with what shading needs for each face."""

    def __init__(self, mesh: RenderMesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.mesh = mesh
        self.radius = mesh.bounding_radius
        self._face_normals = face_normals(mesh.vertices, mesh.faces).astype(np.float32)
        self._corner_normals: NDArray[np.float32] | None = None
        self._paint: _Paint | None = None
        # The robust mode costs a third more time; without it, half a million rays aimed exactly at
        # edges that two faces share found no gap either.
        self._embree = EmbreeScene(robust=False)
        TriangleMesh(
            scene=self._embree,
            vertices=mesh.vertices.astype(np.float32),
            indices=mesh.faces.astype(np.int32),
        )

    def cast_grid(
        self, rays: RayGrid, rotation: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], _Hits]:
        """First hits of one view's centre rays, and the pixel of each, shape (H,).

        Args:
            rays: The camera's rays.
            rotation: Object to camera, shape (3, 3).
        """
        points = self.mesh.vertices @ rotation.T
        points[:, 2] -= rays.camera.distance
        chosen = rays.around(points)
        hits = self.cast(rays.directions[chosen], rotation, rays.camera.distance)
        return chosen[hits.ray], hits

    def cast(
        self, directions: NDArray[np.float64], rotation: NDArray[np.float64], distance: float
    ) -> _Hits:
        """First hits of rays from the camera.

        Args:
            directions: Unit, camera frame, shape (R, 3).
            rotation: Object to camera, shape (3, 3).
            distance: Of the camera from the origin.
        """
        # x_object = rotation.T @ x_camera; as rows: x_camera @ rotation
        turned = (directions @ rotation).astype(np.float32)
        origin = (distance * rotation[2]).astype(np.float32)
        found = self._embree.run(np.broadcast_to(origin, turned.shape), turned, output=True)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][ray], found["v"][ray]
        return _Hits(
            ray=ray,
            face=found["primID"][ray],
            distance=found["tfar"][ray],
            direction=turned[ray],
            weights=np.stack([1 - u - v, u, v], axis=1),
        )

    def picture_values(self, hits: _Hits, modality: str, pixel_width: float) -> NDArray[np.float32]:
        """Values in [0, 255] of the hits, shape (C, H); `pixel_width` at a distance of 1."""
        face_cosine = self._face_cosine(hits)
        cosine = self._cosine(hits, face_cosine)
        if modality == "gray":
            light = reflected_light(cosine, hits.distance, albedo=1.0, intensity=GRAY_LIGHT)
            return display_value(light)[None]
        if self._paint is None:
            self._paint = _Paint(self.mesh)
        # The geometric mean of a pixel's width and length on the inclined surface.
        slant = np.sqrt(np.maximum(np.abs(face_cosine), _MIN_SLANT))
        albedo = self._paint.albedo(hits, pixel_width * hits.distance / slant)
        light = reflected_light(cosine, hits.distance, albedo=albedo, intensity=COLOR_LIGHT)
        return display_value(self._paint.tint(light, hits)).T

    def _face_cosine(self, hits: _Hits) -> NDArray[np.float32]:
        """Cosine between a face's own normal and the way back to the camera; sign = winding."""
        cosine: NDArray[np.float32] = -np.einsum(
            "ij,ij->i", self._face_normals[hits.face], hits.direction
        )
        return cosine

    def _cosine(self, hits: _Hits, face_cosine: NDArray[np.float32]) -> NDArray[np.float32]:
        """Cosine for shading: blended normals, on the side of the face that is seen."""
        if self._corner_normals is None:
            blended = corner_normals(self.mesh.vertices, self.mesh.faces)
            self._corner_normals = blended.astype(np.float32)
        normal = np.einsum("ij,ijk->ik", hits.weights, self._corner_normals[hits.face])
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        cosine = -np.einsum("ij,ij->i", normal, hits.direction) / np.maximum(length, 1e-6)
        return np.where(face_cosine >= 0, cosine, -cosine)


class _Paint:
    """Linear base colours of a mesh: materials, textures, corner colours."""

    def __init__(self, mesh: RenderMesh) -> None:
        self._mesh = mesh
        self._color = linear_from_srgb([m.base_color for m in mesh.materials]).astype(np.float32)
        self._textures: dict[int, TexturePyramid] = {}
        self._density: NDArray[np.float64] | None = None
        if mesh.corner_uv is not None:
            self._density = texel_density(mesh.corner_uv, mesh.vertices, mesh.faces)
            self._textures = {
                i: TexturePyramid(m.texture)
                for i, m in enumerate(mesh.materials)
                if m.texture is not None
            }
        self._tint: NDArray[np.float32] | None = None
        if mesh.corner_color is not None:
            self._tint = linear_from_srgb(mesh.corner_color / 255.0).astype(np.float32)

    def albedo(self, hits: _Hits, width: NDArray[np.float32]) -> NDArray[np.float32]:
        """Linear base colour at each hit, shape (H, 3); `width` of a pixel on the surface, (H,)."""
        material = self._mesh.face_material[hits.face]
        albedo = self._color[material]
        for index, pyramid in self._textures.items():
            here = np.flatnonzero(material == index)
            if len(here) == 0 or self._mesh.corner_uv is None or self._density is None:
                continue
            face = hits.face[here]
            uv = np.einsum("ij,ijk->ik", hits.weights[here], self._mesh.corner_uv[face])
            texels = self._density[face] * width[here] * np.sqrt(np.prod(pyramid.size))
            albedo[here] *= linear_from_srgb(pyramid.sample(uv, texels)).astype(np.float32)
        return albedo

    def tint(self, light: NDArray[np.float32], hits: _Hits) -> NDArray[np.float32]:
        """Light times the corner colours, as OpenGL multiplies them: after the reflection."""
        if self._tint is None:
            return light
        tinted: NDArray[np.float32] = light * np.einsum(
            "ij,ijk->ik", hits.weights, self._tint[hits.face]
        )
        return tinted
