"""Light, colour and depth values that all renderers share.

The light is a point at the camera, so the directions to the light, to the viewer and half-way
between them are one, and the metallic-roughness reflection depends only on the cosine between the
normal and the ray, and on the distance. The formulas are those of the glTF 2.0 specification
(appendix B: Lambert diffuse, GGX distribution, Schlick Fresnel), with the Smith-Schlick masking and
the clamps that pyrender's shader has, since the paper's gray images were drawn with pyrender.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

METALLIC = 0.1  # the paper's white material
ROUGHNESS = 0.2
GRAY_LIGHT = 8.0  # the paper's intensity
# Real materials are dark: this lets white that faces the camera on the near side of the unit sphere
# (2.2 units away) just reach full brightness.
COLOR_LIGHT = 20.0
BACKGROUND = 255  # in every modality
DIELECTRIC_REFLECTANCE = 0.04  # reflectance at normal incidence of what is not a metal
DISPLAY_GAMMA = 2.2
_MIN_COSINE = 1e-3
_SPECULAR_GUARD = 1e-3  # keeps the specular quotient finite at grazing angles

# Normals of faces that meet at less than this angle are blended in a vertex.
CREASE_ANGLE_DEG = 40.0

# Depth pictures: ray lengths from (camera distance - 1) to (camera distance + 1), the unit sphere.
DEPTH_HALF_RANGE = 1.0
_BLOCK = 2**16  # pixels whose intermediate values stay in the processor's cache


def linear_from_srgb(value: ArrayLike) -> NDArray[np.float64]:
    """Linear light from sRGB values in [0, 1] (IEC 61966-2-1)."""
    srgb = np.asarray(value, dtype=np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: ArrayLike) -> NDArray[np.float64]:
    """Inverse of `linear_from_srgb`."""
    linear = np.asarray(value, dtype=np.float64)
    return np.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055
    )


def reflected_light(
    cosine: NDArray[np.float32],
    distance: NDArray[np.float32],
    *,
    albedo: NDArray[np.float32] | float,
    intensity: float,
) -> NDArray[np.float32]:
    """Linear light sent back to a camera that carries the light.

    Args:
        cosine: Cosine between the normal and the direction to the camera, shape (N,); negative
            where a blended normal points away.
        distance: Ray length, shape (N,).
        albedo: Linear base colour: a number, or shape (3, N).
        intensity: Of the point light at the camera, falling off with the squared distance.

    Returns:
        Linear light before clipping: shape (N,) for a number, (3, N) for colours.
    """
    lit = _between(cosine, _MIN_COSINE)
    seen = _between(np.abs(cosine), _MIN_COSINE)
    facing = _between(cosine, 0.0)
    alpha2 = np.float32(ROUGHNESS**4)
    spread = facing * facing * (alpha2 - 1) + 1
    distribution = alpha2 / (np.float32(np.pi) * spread * spread)
    k = np.float32((ROUGHNESS + 1) ** 2 / 8)
    masking = (seen / (seen * (1 - k) + k)) * (lit / (lit * (1 - k) + k))
    specular = distribution * masking / (4 * lit * seen + np.float32(_SPECULAR_GUARD))
    radiance = lit * np.float32(intensity) / (distance * distance)

    # With the half vector on the viewer, Schlick's term vanishes: Fresnel is its value at 0.
    fresnel = DIELECTRIC_REFLECTANCE * (1 - METALLIC) + METALLIC * np.asarray(albedo, np.float32)
    diffuse = np.asarray(albedo, np.float32) * np.float32(
        (1 - DIELECTRIC_REFLECTANCE) * (1 - METALLIC) / np.pi
    )
    light: NDArray[np.float32] = radiance * ((1 - fresnel) * diffuse + fresnel * specular)
    return light


def _between(value: NDArray[np.float32], low: float) -> NDArray[np.float32]:
    """`value` from `low` to 1; numpy's own clip is slower on short arrays."""
    result: NDArray[np.float32] = np.maximum(value, np.float32(low))
    return np.minimum(result, np.float32(1.0), out=result)


def display_value(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values of a picture from linear light, same shape, in [0, 255], not rounded: clip, gamma."""
    value = _between(light, 0.0)
    value **= np.float32(1 / DISPLAY_GAMMA)
    value *= 255
    return value


def encode_depth(depth: NDArray[np.float32], *, distance: float) -> NDArray[np.uint8]:
    """Bytes of a depth picture: near is 255, far is 0, background 255.

    `value = (distance + 1 - d) / 2`, for the camera at 3.2: (4.2 - d) / 2 (systems.md section 3.1).

    Args:
        depth: Ray lengths, any shape; 0 is background.
        distance: Distance of the camera from the origin.
    """
    value = np.empty(depth.shape, dtype=np.uint8)
    flat, flat_value = np.ravel(depth), value.reshape(-1)
    for start in range(0, flat.size, _BLOCK):
        part = flat[start : start + _BLOCK]
        unit = (distance + DEPTH_HALF_RANGE) - part
        unit /= 2 * DEPTH_HALF_RANGE
        unit *= 255
        np.rint(unit, out=unit)
        np.clip(unit, 0, 255, out=unit)
        unit[part <= 0] = BACKGROUND
        flat_value[start : start + _BLOCK] = unit
    return value


def face_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals by the winding, shape (F, 3); zero for a face without an area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    normals: NDArray[np.float64] = cross / np.where(length > 0, length, 1.0)
    return normals


def corner_normals(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    *,
    crease_angle_deg: float = CREASE_ANGLE_DEG,
) -> NDArray[np.float64]:
    """Normals for smooth shading: at each corner, of the faces that meet there almost flat.

    A neighbour counts with the angle of its corner if it is turned by less than the crease angle,
    and with the sign that agrees with the corner's own face. Sharp edges stay sharp, and reversing
    the winding of some faces only reverses the sign of their own normals.

    Args:
        vertices: Shared by position, shape (V, 3).
        faces: Shape (F, 3).
        crease_angle_deg: Faces that meet at more than this stay apart.

    Returns:
        Unit normals, shape (F, 3, 3): face, corner, xyz; on the side of the face's own normal.
    """
    own = face_normals(vertices, faces)
    count = len(faces)
    weights = _corner_angles(vertices, faces).reshape(-1)
    corner_vertex = faces.reshape(-1)
    corner_face = np.repeat(np.arange(count), 3)

    # All ordered pairs of corners that share a vertex, from the corners sorted by vertex.
    order = np.argsort(corner_vertex, kind="stable")
    degree = np.bincount(corner_vertex, minlength=len(vertices))
    start = np.cumsum(degree) - degree
    total = np.zeros((3 * count, 3))
    cosine_limit = np.cos(np.radians(crease_angle_deg))
    by_degree = np.argsort(-degree[corner_vertex], kind="stable")
    descending = -degree[corner_vertex][by_degree]
    for rank in range(int(degree.max())):
        # The rank-th neighbour of every corner whose vertex has that many: few, long steps.
        target = by_degree[: np.searchsorted(descending, -rank, side="left")]
        source = order[start[corner_vertex[target]] + rank]
        neighbour = own[corner_face[source]]
        cosine = np.einsum("ij,ij->i", own[corner_face[target]], neighbour)
        scale = np.where(np.abs(cosine) >= cosine_limit, np.sign(cosine) * weights[source], 0.0)
        total[target] += scale[:, None] * neighbour
    length = np.linalg.norm(total, axis=1, keepdims=True)
    flat = np.repeat(own, 3, axis=0)
    smooth = np.where(length > 1e-9, total / np.where(length > 1e-9, length, 1.0), flat)
    return smooth.reshape(count, 3, 3)


def _corner_angles(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Inner angles in radians, shape (F, 3)."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, behind), axis=-1)
    angles: NDArray[np.float64] = np.arctan2(sine, (ahead * behind).sum(axis=-1))
    return angles
