"""A mesh in Embree: where rays meet it, and how it looks there.

Arrays with an axis of three components have it in front: each component then lies in one piece,
which numpy works through several times as fast as through rows of three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from i2i.rendering.culling import Culling
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.paint import Paint
from i2i.rendering.raygrid import SAMPLE_OFFSETS, RayGrid
from i2i.rendering.shading import (
    COLOR_LIGHT,
    GRAY_LIGHT,
    corner_normals,
    display_value,
    face_normals,
    reflected_light,
)

_MIN_SLANT = 0.05  # cosine below which texture levels stop growing coarser


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet the surface; arrays over the H rays that do."""

    ray: NDArray[np.int64]  # (H,) number of the ray
    face: NDArray[np.int32]  # (H,)
    distance: NDArray[np.float32]  # (H,) ray length
    direction: NDArray[np.float32]  # (3, H) unit, object frame
    weights: NDArray[np.float32]  # (3, H) barycentric


class EmbreeScene:
    """A mesh in Embree, with what shading needs for each face."""

    def __init__(self, mesh: RenderMesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene as NativeScene

        self.mesh = mesh
        self._culling: Culling | None = None
        self._normals: NDArray[np.float32] | None = None
        self._paint: Paint | None = None
        # The robust mode costs a third more time; without it, half a million rays aimed exactly at
        # edges that two faces share found no gap either.
        self._embree = NativeScene(robust=False)
        TriangleMesh(
            scene=self._embree,
            vertices=mesh.vertices.astype(np.float32),
            indices=mesh.faces.astype(np.int32),
        )

    def cast_centers(
        self, rays: RayGrid, rotations: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], Hits]:
        """First hits of the rays through the pixels' centres, and the pixel of each, shape (H,).

        Args:
            rays: The camera's rays.
            rotations: Object to camera of each view, shape (N, 3, 3).
        """
        pixels = rays.image_size**2
        chosen = self._culling_of(rays).pixels(rotations)
        stops = np.searchsorted(chosen, pixels * np.arange(1, len(rotations) + 1))
        directions = rays.directions.take(chosen % pixels, axis=1)
        hits = self._cast(directions, stops, rays, rotations)
        return chosen[hits.ray], hits

    def cast_samples(
        self, rays: RayGrid, rotations: NDArray[np.float64], pixel: NDArray[np.int64]
    ) -> Hits:
        """First hits of the samples of some pixels; the rays of a pixel follow each other.

        Args:
            rays: The camera's rays.
            rotations: Object to camera of each view, shape (N, 3, 3).
            pixel: Indices into the flattened pictures of all views, ascending, shape (K,).
        """
        pixels = rays.image_size**2
        stops = np.searchsorted(pixel, pixels * np.arange(1, len(rotations) + 1))
        directions = rays.samples(pixel % pixels).reshape(3, -1)
        return self._cast(directions, stops * len(SAMPLE_OFFSETS), rays, rotations)

    def _cast(
        self,
        directions: NDArray[np.float64],
        stops: NDArray[np.int64],
        rays: RayGrid,
        rotations: NDArray[np.float64],
    ) -> Hits:
        """First hits of rays from the camera, the views one after the other.

        Args:
            directions: Unit, camera frame, shape (3, R).
            stops: One past the last ray of each view, shape (N,).
            rays: For the camera.
            rotations: Object to camera of each view, shape (N, 3, 3).
        """
        turned = np.empty(directions.shape, dtype=np.float32)
        start = 0
        for rotation, stop in zip(rotations, stops.tolist(), strict=True):
            turned[:, start:stop] = rotation.T @ directions[:, start:stop]
            start = stop
        origins = (rays.camera.distance * rotations[:, 2]).astype(np.float32)
        origin = np.repeat(origins, np.diff(stops, prepend=0), axis=0)
        found = self._embree.run(origin, turned.T, output=True)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][ray], found["v"][ray]
        return Hits(
            ray=ray,
            face=found["primID"][ray],
            distance=found["tfar"][ray],
            direction=turned.take(ray, axis=1),
            weights=np.stack([1 - u - v, u, v]),
        )

    def _culling_of(self, rays: RayGrid) -> Culling:
        """Culling for a camera; the last one is kept."""
        if self._culling is None or self._culling.rays is not rays:
            self._culling = Culling(self.mesh, rays)
        return self._culling

    def picture_values(self, hits: Hits, modality: str, pixel_width: float) -> NDArray[np.float32]:
        """Values in [0, 255] of the hits, shape (C, H); `pixel_width` at a distance of 1."""
        face_cosine, cosine = self._cosines(hits)
        if modality == "gray":
            light = reflected_light(cosine, hits.distance, albedo=1.0, intensity=GRAY_LIGHT)
            return display_value(light)[None]
        if self._paint is None:
            self._paint = Paint(self.mesh)
        # The geometric mean of a pixel's width and length on the inclined surface.
        slant = np.sqrt(np.maximum(np.abs(face_cosine), _MIN_SLANT))
        width = pixel_width * hits.distance / slant
        albedo = self._paint.albedo(hits.face, hits.weights, width)
        light = reflected_light(cosine, hits.distance, albedo=albedo, intensity=COLOR_LIGHT)
        return display_value(self._paint.tint(light, hits.face, hits.weights))

    def _cosines(self, hits: Hits) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cosines between normals and the way back to the camera, each of shape (H,).

        The first is that of the face's own normal, with the sign of its winding. The second is the
        one for shading: blended normals, on the side of the face that is seen.
        """
        if self._normals is None:
            self._normals = _normal_table(self.mesh)
        normals = self._normals.take(hits.face, axis=1)
        own, corners = normals[:3], normals[3:].reshape(3, 3, -1)
        face_cosine = -_dot(own, hits.direction)
        corners *= hits.weights[:, None]
        blended = corners[0] + corners[1]
        blended += corners[2]
        length = np.sqrt(_dot(blended, blended))
        cosine = -_dot(blended, hits.direction) / np.maximum(length, 1e-6)
        return face_cosine, np.where(face_cosine >= 0, cosine, -cosine)


def _normal_table(mesh: RenderMesh) -> NDArray[np.float32]:
    """Own normal of each face, then those of its corners, shape (3 + 3 * 3, F)."""
    own = face_normals(mesh.vertices, mesh.faces)
    corners = corner_normals(mesh.vertices, mesh.faces).reshape(-1, 9)
    return np.ascontiguousarray(np.concatenate([own, corners], axis=1).T, dtype=np.float32)


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Products of vectors, shape (N,) from (3, N)."""
    product = a[0] * b[0]
    product += a[1] * b[1]
    product += a[2] * b[2]
    return product
