"""Small copies of meshes that travel with a run: predictions can be drawn without the data."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from i2i.errors import MeshError
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.visuals import Material

_FORMAT = 1
_REFERENCE_TEXTURE_SIZE = 64
_SEARCH_STEPS = 12


def decimate_mesh(mesh: RenderMesh, *, max_faces: int = 2000) -> RenderMesh:
    """A coarser mesh by vertex clustering: vertices in one cell of a grid become their mean.

    Faces that survive keep their colours and texture coordinates. It needs no library, never fails
    on broken topology, and keeps thin parts, which is what a small picture wants.

    Args:
        mesh: Any mesh.
        max_faces: Upper bound on the number of faces; a mesh that has no more is returned as it is.

    Returns:
        A mesh with at most `max_faces` faces in the same frame.

    Raises:
        ValueError: if `max_faces` is less than 4.
    """
    if max_faces < 4:
        raise ValueError(f"max_faces={max_faces} must be at least 4")
    if len(mesh.faces) <= max_faces:
        return mesh
    # The number of faces grows with the number of cells: bisect for the finest grid that fits.
    coarse, fine = 1, 512
    best = None
    for _ in range(_SEARCH_STEPS):
        cells = (coarse + fine) // 2
        candidate = _cluster(mesh, cells)
        if len(candidate.faces) <= max_faces:
            coarse = cells
            best = candidate if len(candidate.faces) else best
        else:
            fine = cells
        if fine - coarse <= 1:
            break
    if best is None:  # not even a coarse grid left a face under the bound: keep the largest faces
        return _largest_faces(mesh, max_faces)
    return best


def save_mesh(mesh: RenderMesh, path: str | Path) -> Path:
    """Write a mesh as `.npz`; textures are shrunk to 64 px.

    Args:
        mesh: Usually from `decimate_mesh`.
        path: File to write; `.npz` is added if it is missing.

    Returns:
        The path that was written, whole or not at all.
    """
    target = Path(path)
    if target.suffix != ".npz":
        target = target.with_name(target.name + ".npz")
    arrays: dict[str, NDArray[np.generic]] = {
        "format": np.array(_FORMAT),
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "face_material": mesh.face_material,
        "object_from_mesh": mesh.object_from_mesh,
        "base_colors": np.array([m.base_color for m in mesh.materials], dtype=np.float64),
    }
    if mesh.corner_uv is not None:
        arrays["corner_uv"] = mesh.corner_uv
    if mesh.corner_color is not None:
        arrays["corner_color"] = mesh.corner_color
    for index, material in enumerate(mesh.materials):
        if material.texture is not None:
            arrays[f"texture_{index}"] = _shrink(material.texture)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + ".partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    os.replace(partial, target)
    return target


def load_mesh(path: str | Path) -> RenderMesh:
    """Read a mesh that `save_mesh` wrote.

    Raises:
        MeshError: if the file is missing, cut off or of another format.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if int(arrays["format"]) != _FORMAT:
            raise MeshError(
                f"{path} has format {int(arrays['format'])}; this version reads {_FORMAT}"
            )
        materials = tuple(
            Material(
                base_color=(float(color[0]), float(color[1]), float(color[2])),
                texture=arrays.get(f"texture_{index}"),
            )
            for index, color in enumerate(arrays["base_colors"])
        )
        return RenderMesh(
            vertices=arrays["vertices"],
            faces=arrays["faces"],
            face_material=arrays["face_material"],
            corner_uv=arrays.get("corner_uv"),
            corner_color=arrays.get("corner_color"),
            materials=materials,
            object_from_mesh=arrays["object_from_mesh"],
        )
    # zipfile.BadZipFile and zlib.error are no OSError; numpy raises ValueError for other content.
    except MeshError:
        raise
    except Exception as error:
        raise MeshError(
            f"{path} cannot be read as a reference mesh ({type(error).__name__}: {error})"
        ) from error


def _cluster(mesh: RenderMesh, cells: int) -> RenderMesh:
    """The mesh with its vertices merged in a grid of `cells` along its longest side."""
    low = mesh.vertices.min(axis=0)
    side = float(np.ptp(mesh.vertices, axis=0).max()) / cells
    cell = np.floor((mesh.vertices - low) / side).astype(np.int64)
    key = (cell[:, 0] * (cells + 1) + cell[:, 1]) * (cells + 1) + cell[:, 2]
    _, group = np.unique(key, return_inverse=True)
    count = np.bincount(group)
    sums = [np.bincount(group, weights=mesh.vertices[:, axis]) for axis in range(3)]
    vertices = np.stack(sums, axis=1) / count[:, None]
    faces = group[mesh.faces]
    corners = np.sort(faces, axis=1)
    whole = np.flatnonzero((corners[:, 0] < corners[:, 1]) & (corners[:, 1] < corners[:, 2]))
    _, first = np.unique(corners[whole], axis=0, return_index=True)
    return _select(replace(mesh, vertices=vertices, faces=faces), whole[np.sort(first)])


def _largest_faces(mesh: RenderMesh, count: int) -> RenderMesh:
    """Only the `count` faces with the largest area."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return _select(mesh, np.sort(np.argsort(-area, kind="stable")[:count]))


def _select(mesh: RenderMesh, keep: NDArray[np.int64]) -> RenderMesh:
    """The mesh with only some faces, and only the vertices that they use."""
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3).astype(np.int64),
        face_material=mesh.face_material[keep],
        corner_uv=None if mesh.corner_uv is None else mesh.corner_uv[keep],
        corner_color=None if mesh.corner_color is None else mesh.corner_color[keep],
    )


def _shrink(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A texture of at most 64 px a side."""
    height, width = texture.shape[:2]
    factor = _REFERENCE_TEXTURE_SIZE / max(height, width)
    if factor >= 1:
        return texture
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(Image.fromarray(texture).resize(size, Image.Resampling.BOX), dtype=np.uint8)
