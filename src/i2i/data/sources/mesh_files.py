"""Reading one mesh file, with errors that name the file and the reason."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from i2i.errors import MeshError

if TYPE_CHECKING:
    from trimesh.resolvers import Resolver

MESH_SUFFIXES: tuple[str, ...] = (".off", ".obj", ".ply", ".stl", ".glb", ".gltf")


def read_mesh(path: str | Path) -> trimesh.Trimesh | trimesh.Scene:
    """Read a mesh file with its materials; files beside it (MTL, textures) are followed.

    Raises:
        MeshError: The file is missing, empty, truncated, not a mesh, or has non-finite numbers.
    """
    path = Path(path)
    file_type = path.suffix.lower().lstrip(".")
    if f".{file_type}" not in MESH_SUFFIXES:
        raise MeshError(
            f"{path}: {path.suffix or 'no suffix'} is not a mesh format; "
            f"known: {', '.join(MESH_SUFFIXES)}"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror or error})") from error
    resolver = _BesideFile(str(path))
    return read_mesh_bytes(data, file_type=file_type, name=str(path), resolver=resolver)


class _BesideFile(trimesh.resolvers.FilePathResolver):
    """Files that a mesh refers to, by their path from the mesh's folder.

    trimesh 5 refuses ``../``, but ShapeNet keeps its textures in ``../images/``.
    """

    def get(self, name: str) -> bytes:
        """Return the content of a file; one that is not there is also sought beside the mesh.

        Raises:
            FileNotFoundError: No such file; trimesh then goes on without it.
        """
        relative = Path(name.strip().replace("\\", "/"))
        for candidate in (Path(self.parent) / relative, Path(self.parent) / relative.name):
            if candidate.is_file():
                return candidate.read_bytes()
        raise FileNotFoundError(name)


def read_mesh_bytes(
    data: bytes, *, file_type: str, name: str, resolver: Resolver | None = None
) -> trimesh.Trimesh | trimesh.Scene:
    """Read a mesh from memory.

    Args:
        data: The whole file.
        file_type: Suffix without the dot, such as ``"off"``.
        name: What error messages call the file.
        resolver: Finds the files that this one refers to.

    Returns:
        A mesh, or a scene where the file has several parts or materials. Vertices at the same
        place (with the same texture coordinates) are merged.

    Raises:
        MeshError: The data is empty, truncated, not a mesh, or has non-finite numbers.
    """
    if not data.strip():
        raise MeshError(f"{name}: the file is empty")
    if file_type == "off":
        _check_off_is_whole(data, name)
    try:
        # process=False: trimesh's processing would drop vertices that are not finite in silence.
        loaded = trimesh.load(
            trimesh.util.wrap_as_stream(data), file_type=file_type, resolver=resolver, process=False
        )
    except Exception as error:  # the parsers of trimesh raise whatever they trip over
        raise MeshError(f"{name}: not a readable {file_type.upper()} mesh ({error})") from error
    if not isinstance(loaded, trimesh.Trimesh | trimesh.Scene):
        raise MeshError(f"{name}: no faces; a point cloud or a drawing is not a mesh")
    _check_geometry(loaded, name)
    for part in mesh_parts(loaded):
        part.merge_vertices()
    return loaded


def mesh_parts(loaded: trimesh.Trimesh | trimesh.Scene) -> list[trimesh.Trimesh]:
    """Return the triangle meshes of what trimesh loaded; a scene's transforms are not applied."""
    if isinstance(loaded, trimesh.Trimesh):
        return [loaded]
    geometry = getattr(loaded, "geometry", {})
    return [part for part in geometry.values() if isinstance(part, trimesh.Trimesh)]


def _check_off_is_whole(data: bytes, name: str) -> None:
    """Compare the counts of an OFF header with the lines that follow it.

    trimesh keeps the faces it finds, so that a truncated file would be taken for a whole one. The
    ModelNet files whose header lacks its line break (``OFF123 456 0``) are accepted.
    """
    text = re.sub(r"#[^\n]*", "", data.decode("utf-8", errors="replace")).strip()
    header = re.match(r"(?:ST)?C?N?OFF", text)
    if header is None:
        raise MeshError(f"{name}: not an OFF mesh (it does not begin with OFF)")
    lines = [line.split() for line in text[header.end() :].splitlines() if line.strip()]
    try:
        num_vertices, num_faces = (int(count) for count in lines[0][:2])
    except (IndexError, ValueError) as error:
        raise MeshError(f"{name}: the OFF header has no vertex and face counts") from error
    missing = 1 + num_vertices + num_faces - len(lines)
    if missing > 0:
        raise MeshError(
            f"{name}: truncated, the header announces {num_vertices} vertices and {num_faces} "
            f"faces but {missing} lines are missing"
        )
    last = lines[num_vertices + num_faces]
    if num_faces > 0 and (not last[0].isdigit() or len(last) < 1 + int(last[0])):
        raise MeshError(f"{name}: truncated, the last face is incomplete")


def _check_geometry(loaded: trimesh.Trimesh | trimesh.Scene, name: str) -> None:
    """Refuse anything without triangles or with coordinates that are not finite."""
    parts = mesh_parts(loaded)
    if sum(len(part.faces) for part in parts) == 0:
        raise MeshError(f"{name}: no faces; a point cloud or a drawing is not a mesh")
    for part in parts:
        if not np.isfinite(part.vertices).all():
            raise MeshError(f"{name}: some vertices are not finite (NaN or infinite)")
        if len(part.faces) and (part.faces.min() < 0 or part.faces.max() >= len(part.vertices)):
            raise MeshError(f"{name}: some faces refer to vertices that do not exist")
