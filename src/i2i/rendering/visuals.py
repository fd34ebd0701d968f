"""What a loaded mesh looks like: materials, textures and colours, read from trimesh's visuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from i2i.rendering.shading import srgb_from_linear

# An object covers about 100 of 128 pixels; larger textures only cost memory in every worker.
MAX_TEXTURE_SIZE = 1024


@dataclass(frozen=True, eq=False)
class Material:
    """A colour, and a picture that multiplies it.

    Opacity is not kept: everything is drawn opaque, so that depth, silhouette and colour agree.

    Attributes:
        base_color: sRGB in [0, 1], shape (3,).
        texture: sRGB picture, shape (h, w, 3), uint8, or None.
    """

    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with what is painted on them, in the file's frame (see `RenderMesh` for shapes)."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_material: NDArray[np.int64]
    corner_uv: NDArray[np.float64] | None
    corner_color: NDArray[np.uint8] | None
    materials: tuple[Material, ...]

    def select(self, keep: NDArray[np.bool_]) -> Surface:
        """Only the faces where `keep`, shape (F,), is true."""
        return replace(
            self,
            faces=self.faces[keep],
            face_material=self.face_material[keep],
            corner_uv=None if self.corner_uv is None else self.corner_uv[keep],
            corner_color=None if self.corner_color is None else self.corner_color[keep],
        )


def surface_from_trimesh(mesh: trimesh.Trimesh, transform: NDArray[np.float64]) -> Surface:
    """Read one mesh with its visuals.

    Texture coordinates that are missing or not finite leave the material's plain colour.

    Args:
        mesh: A mesh with faces.
        transform: 4x4 matrix applied to the vertices.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    with np.errstate(invalid="ignore"):  # what is not finite is reported once the mesh is whole
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    surface = Surface(
        vertices=vertices,
        faces=faces,
        face_material=np.zeros(len(faces), dtype=np.int64),
        corner_uv=None,
        corner_color=None,
        materials=(Material(),),
    )
    visual = mesh.visual
    if isinstance(visual, trimesh.visual.TextureVisuals):
        return _with_texture(surface, visual)
    if not isinstance(visual, trimesh.visual.ColorVisuals):
        return surface
    if visual.kind == "face":
        colors = np.asarray(visual.face_colors)[:, None, :3]
        return replace(surface, corner_color=np.repeat(colors, 3, axis=1).astype(np.uint8))
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[faces][..., :3]
        return replace(surface, corner_color=colors.astype(np.uint8))
    return surface


def _with_texture(surface: Surface, visual: trimesh.visual.TextureVisuals) -> Surface:
    """The surface with the materials and coordinates of trimesh's TextureVisuals."""
    uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)
    usable = (
        uv is not None and uv.shape == (len(surface.vertices), 2) and bool(np.isfinite(uv).all())
    )
    corner_uv = uv[surface.faces] if usable and uv is not None else None
    parts = getattr(visual.material, "materials", None)
    face_material = surface.face_material
    if parts:  # several materials on one mesh, chosen by face
        chosen = getattr(visual, "face_materials", None)
        if chosen is not None and len(chosen) == len(surface.faces):
            face_material = np.clip(np.asarray(chosen, dtype=np.int64), 0, len(parts) - 1)
    else:
        parts = [visual.material]
    materials = tuple(_material(part, textured=usable) for part in parts)
    if all(m.texture is None for m in materials):
        corner_uv = None
    return replace(surface, face_material=face_material, corner_uv=corner_uv, materials=materials)


def _material(source: object, *, textured: bool) -> Material:
    """Our material from trimesh's SimpleMaterial or PBRMaterial; white from anything else."""
    color = np.ones(3)
    picture = None
    if isinstance(source, trimesh.visual.material.PBRMaterial):
        if source.baseColorFactor is not None:  # linear by the glTF specification
            color = srgb_from_linear(_unit_rgb(source.baseColorFactor))
        picture = source.baseColorTexture
    elif isinstance(source, trimesh.visual.material.SimpleMaterial):
        color = _unit_rgb(source.diffuse)
        picture = source.image
    texture = _texture(picture) if textured and picture is not None else None
    if texture is not None and float(color.max()) < 0.02:
        # Exporters write a black diffuse colour beside a texture and mean the texture alone.
        color = np.ones(3)
    red, green, blue = (float(c) for c in color)
    return Material(base_color=(red, green, blue), texture=texture)


def _unit_rgb(color: ArrayLike) -> NDArray[np.float64]:
    """RGB in [0, 1] from a colour in uint8 or float, with or without alpha."""
    value = np.asarray(color)
    rgb = np.ones(3)
    flat = value.reshape(-1)[:3].astype(np.float64)
    rgb[: len(flat)] = flat
    if np.issubdtype(value.dtype, np.integer):
        rgb = rgb / 255.0
    return np.clip(rgb, 0.0, 1.0)


def _texture(picture: Image.Image | ArrayLike) -> NDArray[np.uint8] | None:
    """An RGB array from a picture, at most MAX_TEXTURE_SIZE wide; None if it cannot be read."""
    try:
        image = (
            picture if isinstance(picture, Image.Image) else Image.fromarray(np.asarray(picture))
        )
        image = image.convert("RGB")
    except (OSError, TypeError, ValueError):
        return None  # a broken picture must not lose the shape: the plain colour stays
    if max(image.size) > MAX_TEXTURE_SIZE:
        factor = MAX_TEXTURE_SIZE / max(image.size)
        width, height = (max(1, round(side * factor)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    return np.asarray(image, dtype=np.uint8)
