"""A mesh of each class for the run folder, so that predictions can be drawn without the data."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from i2i.data.sources.base import MeshItem, MeshSource
from i2i.errors import MeshError
from i2i.rendering.mesh import RenderMesh, prepare_mesh

log = logging.getLogger(__name__)


def reference_meshes(
    source: MeshSource, items: Sequence[MeshItem], *, candidates: int = 5
) -> dict[str, RenderMesh]:
    """Choose a typical training object of each class.

    Args:
        source: Where the meshes come from.
        items: Training objects.
        candidates: How many of each class are looked at; of these, the one with the median number
            of faces is taken. Meshes that cannot be read are passed over.

    Returns:
        A mesh in the object frame for each class name that has a readable one.
    """
    chosen: dict[str, RenderMesh] = {}
    for name in dict.fromkeys(item.class_name for item in items):
        meshes: list[RenderMesh] = []
        for item in (item for item in items if item.class_name == name):
            if len(meshes) == candidates:
                break
            try:
                meshes.append(prepare_mesh(source.load(item), up_axis=source.up_axis))
            except MeshError as error:
                log.warning("No reference mesh from %s/%s: %s", name, item.instance_id, error)
        if meshes:
            meshes.sort(key=lambda mesh: len(mesh.faces))
            chosen[name] = meshes[(len(meshes) - 1) // 2]
    return chosen
