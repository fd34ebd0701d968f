"""Pictures from meshes: one interface, several renderers."""

from i2i.rendering.base import (
    CHANNELS,
    MODALITIES,
    Renderer,
    canonical_name,
    get_renderer,
    renderer_names,
)
from i2i.rendering.mesh import RenderMesh, prepare_mesh
from i2i.rendering.reference import decimate_mesh, load_mesh, save_mesh
from i2i.rendering.shading import encode_depth
from i2i.rendering.visuals import Material

__all__ = [
    "CHANNELS",
    "MODALITIES",
    "Material",
    "RenderMesh",
    "Renderer",
    "canonical_name",
    "decimate_mesh",
    "encode_depth",
    "get_renderer",
    "load_mesh",
    "prepare_mesh",
    "renderer_names",
    "save_mesh",
]
