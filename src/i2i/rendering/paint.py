"""Colours of a mesh at points of its surface: materials, textures, corner colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from i2i.rendering.mesh import RenderMesh
from i2i.rendering.shading import linear_from_srgb
from i2i.rendering.textures import TexturePyramid, texel_density


class Paint:
    """Linear base colours of a mesh."""

    def __init__(self, mesh: RenderMesh) -> None:
        self._mesh = mesh
        colors = linear_from_srgb([m.base_color for m in mesh.materials]).astype(np.float32)
        self._color = np.ascontiguousarray(colors.T)
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

    def albedo(
        self, face: NDArray[np.int32], weights: NDArray[np.float32], width: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Linear base colour at some points, shape (3, H).

        Args:
            face: Of each point, shape (H,).
            weights: Barycentric, shape (3, H).
            width: Of a pixel on the surface, shape (H,).
        """
        material = self._mesh.face_material[face]
        albedo = self._color.take(material, axis=1)
        for index, pyramid in self._textures.items():
            here = np.flatnonzero(material == index)
            if len(here) == 0 or self._mesh.corner_uv is None or self._density is None:
                continue
            part = face[here]
            uv = np.einsum("ji,ijk->ik", weights[:, here], self._mesh.corner_uv[part])
            texels = self._density[part] * width[here] * np.sqrt(np.prod(pyramid.size))
            albedo[:, here] *= linear_from_srgb(pyramid.sample(uv, texels)).astype(np.float32).T
        return albedo

    def tint(
        self, light: NDArray[np.float32], face: NDArray[np.int32], weights: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Light, (3, H), times the corner colours, as OpenGL does it: after the reflection."""
        if self._tint is None:
            return light
        tinted: NDArray[np.float32] = light * np.einsum("ji,ijk->ki", weights, self._tint[face])
        return tinted
