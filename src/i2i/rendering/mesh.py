"""The mesh that renderers draw: object frame, materials; and how a loaded file becomes one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

from i2i.errors import MeshError
from i2i.rendering.visuals import Material, Surface, surface_from_trimesh

# Rotations that turn the named "up" axis of a file to +z. Each is a proper rotation, and each keeps
# one horizontal axis where it was, so that turning and turning back lose nothing.
_Z_UP_FROM: dict[str, NDArray[np.float64]] = {
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "z": np.eye(3),
    "-z": np.diag([1.0, -1, -1]),
}

# The share of vertices inside the unit sphere after normalisation, in percent (the paper's rule:
# a few far vertices, e.g. of an antenna, must not shrink the whole object).
RADIUS_PERCENTILE = 98.0


@dataclass(frozen=True, eq=False)
class RenderMesh:
    """A triangle mesh in the object frame (z up, centred, scaled), ready to draw.

    Vertices are shared by position; whatever may differ between the faces that meet in a vertex
    (texture coordinates, colours) is kept for each corner of each face.

    Attributes:
        vertices: Object frame, shape (V, 3), float64.
        faces: Vertex numbers, shape (F, 3), int64. The winding has no meaning: real files mix it.
        corner_uv: Texture coordinates, shape (F, 3, 2), origin at the bottom left, or None.
        corner_color: sRGB colours, shape (F, 3, 3), uint8, multiplied onto the material, or None.
        face_material: Index into `materials`, shape (F,), int64.
        materials: At least one.
        object_from_mesh: 4x4 matrix from the file's frame to the object frame, float64.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_material: NDArray[np.int64]
    corner_uv: NDArray[np.float64] | None = None
    corner_color: NDArray[np.uint8] | None = None
    materials: tuple[Material, ...] = (Material(),)
    object_from_mesh: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a vertex from the origin (a little above 1 for most meshes)."""
        return float(np.sqrt((self.vertices**2).sum(axis=1).max()))

    def __repr__(self) -> str:
        """Sizes instead of the arrays themselves."""
        return (
            f"RenderMesh(vertices={len(self.vertices)}, faces={len(self.faces)}, "
            f"materials={len(self.materials)}, uv={self.corner_uv is not None}, "
            f"colors={self.corner_color is not None})"
        )


def prepare_mesh(loaded: trimesh.Trimesh | trimesh.Scene, *, up_axis: str = "z") -> RenderMesh:
    """Turn a loaded file into a mesh in the object frame.

    A scene of several parts is flattened with the transforms and the materials of its parts, and is
    normalised like a single mesh: subtract the area-weighted centroid of the surface, then divide
    by the 98th percentile of the vertex norms (systems.md section 3.1).

    Args:
        loaded: What `trimesh.load` gave: a `Trimesh` or a `Scene`.
        up_axis: The axis that points up in the file: "x", "y", "z", "-x", "-y" or "-z".

    Returns:
        The mesh with z up, its centre at the origin and (almost) inside the unit sphere.

    Raises:
        ValueError: if `up_axis` is not one of the six.
        MeshError: if there is no face, a vertex that is not finite, a face that names a vertex
            that is not there, or no face with an area.
    """
    if up_axis not in _Z_UP_FROM:
        raise ValueError(
            f"up_axis={up_axis!r} is not an axis; use one of {', '.join(sorted(_Z_UP_FROM))}"
        )
    surface = _merge_surfaces([surface_from_trimesh(m, t) for m, t in _parts(loaded)])
    _check_surface(surface)
    surface = _share_vertices(_drop_flat_faces(surface))

    rotation = _Z_UP_FROM[up_axis]
    turned = surface.vertices @ rotation.T
    center = _surface_centroid(turned, surface.faces)
    radius = float(np.percentile(np.linalg.norm(turned - center, axis=1), RADIUS_PERCENTILE))
    if not radius > 0:
        raise MeshError("the mesh has no extent: its vertices all lie in one point")
    object_from_mesh = np.eye(4)
    object_from_mesh[:3, :3] = rotation / radius
    object_from_mesh[:3, 3] = -center / radius
    return RenderMesh(
        vertices=(turned - center) / radius,
        faces=surface.faces,
        face_material=surface.face_material,
        corner_uv=surface.corner_uv,
        corner_color=surface.corner_color,
        materials=surface.materials,
        object_from_mesh=object_from_mesh,
    )


def _parts(
    loaded: trimesh.Trimesh | trimesh.Scene,
) -> list[tuple[trimesh.Trimesh, NDArray[np.float64]]]:
    """The triangle meshes in a loaded file, each with its 4x4 matrix to the file's frame."""
    if isinstance(loaded, trimesh.Trimesh):
        parts = [(loaded, np.eye(4))]
    elif isinstance(loaded, trimesh.Scene):
        parts = []
        # Sorted: a scene's nodes come in an order that is not promised to stay.
        for node in sorted(loaded.graph.nodes_geometry):
            transform, name = loaded.graph[node]
            geometry = loaded.geometry[name]
            if isinstance(geometry, trimesh.Trimesh):  # lines and point clouds have no surface
                parts.append((geometry, np.asarray(transform, dtype=np.float64)))
    else:
        raise MeshError(
            f"expected a trimesh.Trimesh or trimesh.Scene, got {type(loaded).__name__}: "
            "the file holds no triangle mesh (a point cloud or lines?)"
        )
    parts = [(mesh, transform) for mesh, transform in parts if len(mesh.faces)]
    if not parts:
        raise MeshError("the mesh has no faces: the file is empty, truncated or holds only points")
    return parts


def _merge_surfaces(surfaces: list[Surface]) -> Surface:
    """One surface from several; missing colours become white, missing coordinates zero."""
    if len(surfaces) == 1:
        return surfaces[0]
    any_uv = any(s.corner_uv is not None for s in surfaces)
    any_color = any(s.corner_color is not None for s in surfaces)
    vertex_start = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    material_start = np.cumsum([0] + [len(s.materials) for s in surfaces])

    def uv(s: Surface) -> NDArray[np.float64]:
        return np.zeros((len(s.faces), 3, 2)) if s.corner_uv is None else s.corner_uv

    def color(s: Surface) -> NDArray[np.uint8]:
        white = np.full((len(s.faces), 3, 3), 255, dtype=np.uint8)
        return white if s.corner_color is None else s.corner_color

    return Surface(
        vertices=np.concatenate([s.vertices for s in surfaces]),
        faces=np.concatenate([s.faces + vertex_start[i] for i, s in enumerate(surfaces)]),
        face_material=np.concatenate(
            [s.face_material + material_start[i] for i, s in enumerate(surfaces)]
        ),
        corner_uv=np.concatenate([uv(s) for s in surfaces]) if any_uv else None,
        corner_color=np.concatenate([color(s) for s in surfaces]) if any_color else None,
        materials=tuple(m for s in surfaces for m in s.materials),
    )


def _check_surface(surface: Surface) -> None:
    """Raise MeshError with the reason if the surface cannot be drawn."""
    count = len(surface.vertices)
    if surface.faces.min() < 0 or surface.faces.max() >= count:
        raise MeshError(
            f"a face names vertex {surface.faces.max()} but the mesh has only {count} vertices"
        )
    bad = ~np.isfinite(surface.vertices).all(axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise MeshError(
            f"{int(bad.sum())} of {count} vertices are not finite numbers (the first is number "
            f"{first}: {surface.vertices[first].tolist()})"
        )


def _drop_flat_faces(surface: Surface) -> Surface:
    """Without the faces that have no area: they have no normal and cannot be seen."""
    area = _doubled_area(surface.vertices, surface.faces)
    # Relative to the mesh: files come in millimetres and in kilometres.
    scale = float(np.ptp(surface.vertices, axis=0).max())
    keep = area > 1e-14 * scale * scale
    if not keep.any():
        raise MeshError(f"none of the {len(area)} faces has an area")
    return surface if keep.all() else surface.select(keep)


def _share_vertices(surface: Surface) -> Surface:
    """Vertices shared by position; those that no face uses are dropped.

    Loaders split vertices where texture coordinates differ. Sharing them again makes the percentile
    of the vertex norms independent of the texturing, and smooth shading continuous.
    """
    used = np.unique(surface.faces)
    extent = float(np.ptp(surface.vertices, axis=0).max())
    rounded = np.round((surface.vertices[used] - surface.vertices[used[0]]) * (1e8 / extent))
    _, first, inverse = np.unique(
        rounded.astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    renumber = np.zeros(len(surface.vertices), dtype=np.int64)
    renumber[used] = inverse.reshape(-1)
    return Surface(
        vertices=surface.vertices[used[first]],
        faces=renumber[surface.faces],
        face_material=surface.face_material,
        corner_uv=surface.corner_uv,
        corner_color=surface.corner_color,
        materials=surface.materials,
    )


def _doubled_area(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Twice the area of each face, shape (F,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    doubled: NDArray[np.float64] = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return doubled


def _surface_centroid(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Area-weighted mean of the surface, shape (3,); holes and mixed winding do not matter."""
    area = _doubled_area(vertices, faces)
    centers = vertices[faces].mean(axis=1)
    centroid: NDArray[np.float64] = (area[:, None] * centers).sum(axis=0) / area.sum()
    return centroid
