"""The icosahedron with a vertex or an edge towards the viewer, and its 60 rotations as tables.

Orders are part of the checkpoint format, and a test pins them by checksum:

- Vertices: the 12 corners, then the 30 midpoints of level 1, then the 120 of level 2; inside each
  batch by falling z, then by rising azimuth in [0, 2π), both compared after rounding to 1e-6. So
  with a vertex towards the viewer, vertex 0 is on +z, and vertices 1–5 are the upper ring, vertex 1
  at azimuth 0; with an edge towards the viewer, corner 0 is its upper end and corner 1 its lower.
- Rotations: by the number of the corner to which corner 0 goes, then of that to which corner 1 goes
  (two adjacent corners fix a rotation). So element 0 is the identity; with a vertex towards the
  viewer, elements 0–4 are the turns about the viewing axis by 0°, 72°, ..., 288°.
"""

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from i2i.geometry.rotations import geodesic_angle_rad

Frame = Literal["conjugated", "standard"]
MeshAxis = Literal["vertex", "twofold"]

_GOLDEN_RATIO = (1 + math.sqrt(5)) / 2
_ROUND = 6  # decimals in comparisons: far above float noise, far below any real difference (> 0.1)
_MAX_LEVEL = 2


@dataclass(frozen=True, eq=False)
class Icosahedron:
    """Vertices, group and action tables; made by `icosahedron`, shared, never to be written to.

    V = 12, 42, 162 vertices and V_half = 6, 16, 71 visible ones at level 0, 1, 2, or with the edge
    towards the viewer V_half = 4, 17, 73.

    Attributes:
        level: Number of subdivisions.
        frame: Which matrices the 60 elements have, see `icosahedron`.
        normalize_midpoints: Whether midpoints are pushed out to the unit sphere.
        mesh_axis: What is towards the viewer, see `icosahedron`.
        vertices: Positions, shape (V, 3), float64.
        vertex_level: Subdivision that made each vertex, shape (V,), int64.
        faces: Triangles, counter-clockwise seen from outside, shape (20·4^level, 3), int64.
        tilt: Rotation A from the standard orientation, with corners (0, ±1, ±φ) and their cyclic
            permutations, to that of ``vertices``, shape (3, 3), float64; the identity for twofold.
        rotations: The 60 matrices, shape (60, 3, 3), float64.
        multiplication: ``rotations[multiplication[g, h]] = rotations[g] @ rotations[h]``, shape
            (60, 60), int64.
        inverse: ``rotations[inverse[g]] = rotations[g].T``, shape (60,), int64.
        action: Number of the vertex to which element g takes vertex j, shape (60, V), int64:
            ``rotations[g] @ vertices[j] = vertices[action[g, j]]`` in the conjugated frame, the
            same with ``vertices @ tilt`` for ``vertices`` in the standard frame.
        visible: Vertices with z > 1e-6, rising, shape (V_half,), int64.
        identity: Number of the identity: 0.
    """

    level: int
    frame: Frame
    normalize_midpoints: bool
    mesh_axis: MeshAxis
    vertices: Tensor
    vertex_level: Tensor
    faces: Tensor
    tilt: Tensor
    rotations: Tensor
    multiplication: Tensor
    inverse: Tensor
    action: Tensor
    visible: Tensor
    identity: int = 0

    @cached_property
    def directions(self) -> Tensor:
        """Unit vectors towards the vertices, shape (V, 3), float64."""
        return self.vertices / self.vertices.norm(dim=-1, keepdim=True)

    @cached_property
    def visible_xy(self) -> Tensor:
        """In-plane coordinates (a, b) of the visible vertices, x right, y up, (V_half, 2).

        On a raster of S cells, (a, b) is sampled at column ``S/2 + ½·S·coverage·a`` and row
        ``S/2 − ½·S·coverage·b``, where cell i has its centre at i + ½.
        """
        return self.vertices[self.visible, :2].clone()

    @cached_property
    def marks(self) -> Tensor:
        """Where each element takes a mark on the first edge, shape (60, 3), float64.

        The mark of the identity is on the edge from corner 0 to corner 1, a third of the way. No
        other rotation keeps it, so the marks stand for the elements; they are the corners of a
        football (truncated icosahedron). ``rotations[g] @ marks[h] = marks[multiplication[g, h]]``
        in the conjugated frame.
        """
        first, second = (self.vertices[self.action[:, corner]] for corner in (0, 1))
        return (2 * first + second) / 3

    @cached_property
    def viewing_turns(self) -> Tensor:
        """Elements that take the half mesh to itself, rising, identity first, int64.

        They are the turns about the viewing axis: 5 by multiples of 72°, or 2 by 0° and 180°.
        """
        position = self._position_in_half
        return torch.nonzero((position[self.action[:, self.visible]] >= 0).all(dim=1)).flatten()

    @cached_property
    def visible_permutation(self) -> Tensor:
        """How the turns about the viewing axis permute the half mesh, (5 or 2, V_half), int64.

        Entry [k, i] is the position in ``visible`` of the vertex to which the turn by 72°·k (or
        180°·k) takes ``visible[i]``.
        """
        return self._position_in_half[self.action[self.viewing_turns][:, self.visible]]

    @cached_property
    def _position_in_half(self) -> Tensor:
        """Position of each vertex in ``visible``, −1 for the others, shape (V,)."""
        position = torch.full((len(self.vertices),), -1)
        position[self.visible] = torch.arange(len(self.visible))
        return position

    @cached_property
    def angles_rad(self) -> Tensor:
        """Rotation angle of each element, shape (60,), float64."""
        return geodesic_angle_rad(self.rotations, self.rotations[self.identity])

    def elements_within(self, angle_deg: float) -> Tensor:
        """Elements whose angle is at most ``angle_deg`` (± 1e-6°), rising, identity first."""
        return torch.nonzero(torch.rad2deg(self.angles_rad) <= angle_deg + 1e-6).flatten()

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the orders: rounded vertices and matrices, and the tables."""
        digest = hashlib.sha256()
        for coordinates in (self.vertices, self.rotations):
            # int64 has no negative zero and the same bytes on every platform that torch runs on
            digest.update(
                torch.round(coordinates * 1e4).to(torch.int64).numpy().astype("<i8").tobytes()
            )
        for table in (self.multiplication, self.inverse, self.action, self.visible):
            digest.update(table.numpy().astype("<i8").tobytes())
        return digest.hexdigest()

    def __repr__(self) -> str:
        midpoints = "normalised" if self.normalize_midpoints else "as cut"
        axis = "" if self.mesh_axis == "vertex" else f", {self.mesh_axis} axis to the viewer"
        return (
            f"Icosahedron(level={self.level}: V{len(self.vertices)}, "
            f"half mesh {len(self.visible)}, I60 {self.frame}, midpoints {midpoints}{axis})"
        )


def icosahedron(
    level: int = 1,
    frame: Frame = "conjugated",
    *,
    normalize_midpoints: bool = False,
    mesh_axis: MeshAxis = "vertex",
) -> Icosahedron:
    """The icosahedron at a subdivision level; built once per process and shared.

    Args:
        level: 0 (12 vertices), 1 (42, the paper's) or 2 (162).
        frame: "conjugated": vertices and matrices are both turned so that vertex 0 is on the
            viewing axis (z is a 5-fold axis of the group); then the element with the largest
            response is the one nearest to the camera→object rotation. "standard": the vertices are
            turned for the sampling but the matrices are those of the standard orientation (z is a
            2-fold axis), as in the published code. Element g of the one is element g of the other
            conjugated by ``tilt``, so ``multiplication``, ``inverse`` and ``action`` are the same
            in both. The published turn about the viewing axis is arbitrary; ours puts a ring vertex
            at azimuth 0.
        normalize_midpoints: Push midpoints out to the unit sphere, after each subdivision. Off:
            they stay on the edges (radius 0.8507 at level 1), as in the paper. The numbering is the
            same.
        mesh_axis: What points to the viewer. "vertex": a corner, as in the paper; the half mesh has
            the five turns about it, of which the pixel grid has none but the identity. "twofold":
            the middle of an edge, upright in the picture (the standard orientation itself); the
            half mesh and the pixel grid then share the half turn. Numbers of vertices and elements
            mean other things than with "vertex": weights fit one of them only.

    Returns:
        The icosahedron.

    Raises:
        ValueError: If the level, the frame or the axis is another.

    Example:
        >>> icosahedron(1)
        Icosahedron(level=1: V42, half mesh 16, I60 conjugated, midpoints as cut)
    """
    if level not in range(_MAX_LEVEL + 1):
        raise ValueError(f"icosahedron level {level!r} is not one of 0, 1, 2")
    if frame not in get_args(Frame):
        raise ValueError(f"frame {frame!r} is not one of {', '.join(get_args(Frame))}")
    if mesh_axis not in get_args(MeshAxis):
        raise ValueError(f"mesh_axis {mesh_axis!r} is not one of {', '.join(get_args(MeshAxis))}")
    return _build(level, frame, bool(normalize_midpoints), mesh_axis)


def nearest_element(target: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """The group element nearest to each rotation.

    Args:
        target: Rotations, shape (..., 3, 3).
        rotations: The elements, shape (G, 3, 3); cast to the type and device of ``target``.

    Returns:
        Number of the nearest element, shape (...), int64, and its angle to the target in radians,
        shape (...); at most 44.48° for the 60 rotations of the icosahedron.
    """
    elements = rotations.to(target)
    index = torch.einsum("...ij,gij->...g", target, elements).argmax(dim=-1)
    return index, geodesic_angle_rad(target, elements[index])


def residual(target: Tensor, element: Tensor) -> Tensor:
    """Left residual: ``target = residual @ element``. Shapes (..., 3, 3), broadcasting."""
    return target @ element.mT


def compose(residual: Tensor, element: Tensor) -> Tensor:
    """Inverse of `residual`: ``residual @ element``. Shapes (..., 3, 3), broadcasting."""
    return residual @ element


@lru_cache(maxsize=24)  # every combination there is
def _build(level: int, frame: Frame, normalize_midpoints: bool, mesh_axis: MeshAxis) -> Icosahedron:
    tilt = _tilt() if mesh_axis == "vertex" else np.eye(3)
    corners = _standard_corners() @ tilt.T
    corners = corners[_order(corners)]
    as_cut, faces, batch = _subdivide(corners, level, normalize=False)
    vertices = _subdivide(corners, level, normalize=True)[0] if normalize_midpoints else as_cut
    conjugated = _rotations_of(corners)
    action = _action_table(conjugated, as_cut)
    # The images of corners 0 and 1 name an element, so products need no floating point.
    element_of = {(int(a), int(b)): g for g, (a, b) in enumerate(action[:, :2])}
    composed = action[:, action[:, :2]]  # [g, h, j] = where g takes the place to which h takes j
    product = np.array([[element_of[int(a), int(b)] for a, b in row] for row in composed])
    matrices = conjugated if frame == "conjugated" else tilt.T @ conjugated @ tilt
    return Icosahedron(
        level=level,
        frame=frame,
        normalize_midpoints=normalize_midpoints,
        mesh_axis=mesh_axis,
        vertices=torch.from_numpy(vertices),
        vertex_level=torch.from_numpy(batch),
        faces=torch.from_numpy(_outward(faces, as_cut)),
        tilt=torch.from_numpy(tilt),
        rotations=torch.from_numpy(matrices),
        multiplication=torch.from_numpy(product),
        inverse=torch.from_numpy(np.argmin(product, axis=1)),  # the identity is element 0
        action=torch.from_numpy(action),
        visible=torch.from_numpy(np.flatnonzero(vertices[:, 2] > 1e-6)),
    )


def _standard_corners() -> NDArray[np.float64]:
    """Cyclic permutations of (0, ±1, ±φ), normalised; the first two are (0, ±1, φ). (12, 3)."""
    one, phi = np.array([1.0, _GOLDEN_RATIO]) / math.hypot(1.0, _GOLDEN_RATIO)
    base = np.array([[0, s * one, t * phi] for t in (1, -1) for s in (1, -1)])
    return np.concatenate([np.roll(base, shift, axis=1) for shift in range(3)])


def _tilt() -> NDArray[np.float64]:
    """Rotation that takes (0, 1, φ) to +z and its neighbour (0, −1, φ) to azimuth 0. (3, 3)."""
    up, ring = _standard_corners()[:2]
    x = ring - (ring @ up) * up
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(up, x), up))


def _order(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Falling z, then rising azimuth in [0, 2π), both rounded so that float noise cannot decide."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * math.pi)
    on_axis = np.hypot(points[:, 0], points[:, 1]) < 10.0**-_ROUND
    azimuth[on_axis | (azimuth > 2 * math.pi - 10.0**-_ROUND)] = 0.0
    return np.lexsort((azimuth.round(_ROUND), -points[:, 2].round(_ROUND)))


def _corner_faces(corners: NDArray[np.float64]) -> NDArray[np.int64]:
    """The 20 triples of mutually adjacent corners."""
    near = corners @ corners.T > 0.4  # neighbours have cosine 0.447, the others −0.447 or less
    n = len(corners)
    triples = [
        (i, j, k)
        for i in range(n)
        for j in range(i + 1, n)
        for k in range(j + 1, n)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    return np.array(triples)


def _subdivide(
    corners: NDArray[np.float64], level: int, *, normalize: bool
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Cut every edge in two, ``level`` times.

    Midpoints are numbered by where they lie when they are not normalised, so that both variants
    agree.

    Returns:
        Vertices (V, 3), faces (F, 3) and the subdivision that made each vertex (V,).
    """
    points, plain = corners, corners
    faces = _corner_faces(corners)
    batch = np.zeros(len(corners), dtype=np.int64)
    for step in range(1, level + 1):
        pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)  # (F, 3, 2)
        edges, edge_of = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
        order = _order(plain[edges].mean(axis=1))
        edges = edges[order]
        middle = len(points) + np.argsort(order)[edge_of].reshape(-1, 3)  # (F, 3): of ab, bc, ca
        plain = np.concatenate((plain, plain[edges].mean(axis=1)))
        middles = points[edges].mean(axis=1)
        if normalize:
            middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        points = np.concatenate((points, middles))
        batch = np.concatenate((batch, np.full(len(edges), step)))
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        triangles = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.concatenate([np.stack(triangle, axis=1) for triangle in triangles])
    return points, faces, batch


def _outward(faces: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Turn triangles so that they run counter-clockwise seen from outside."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0
    faces = faces.copy()
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return faces


def _rotations_of(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 60 rotations, ordered by the images of corners 0 and 1. (60, 3, 3)."""

    def basis(i: int, j: int) -> NDArray[np.float64]:
        """Orthonormal axes, in columns, that a pair of adjacent corners spans."""
        first = corners[i]
        second = corners[j] - (corners[j] @ first) * first
        second = second / np.linalg.norm(second)
        return np.stack((first, second, np.cross(first, second)), axis=1)

    start = basis(0, 1)
    near = corners @ corners.T > 0.4
    pairs = [(i, j) for i in range(12) for j in range(12) if i != j and near[i, j]]
    return np.stack([basis(i, j) @ start.T for i, j in pairs])


def _action_table(
    rotations: NDArray[np.float64], vertices: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Number of the vertex on which each rotation puts each vertex. (60, V)."""
    turned = np.einsum("gij,vj->gvi", rotations, vertices)
    distance = np.linalg.norm(turned[:, :, None] - vertices[None, None], axis=-1)  # (60, V, V)
    assert distance.min(axis=-1).max() < 1e-9, "a rotation does not map the mesh to itself"
    return distance.argmin(axis=-1)
