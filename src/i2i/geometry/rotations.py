"""Rotations: maps onto SO(3), distances, conversions and z-symmetric labels. Thin over roma.

Matrices act on columns: ``x_camera = rotation @ x_object``. Angles are radians where the name ends
in ``_rad`` and degrees where it ends in ``_deg``; quaternions say their order in the name.
"""

import math

import roma
import torch
from torch import Tensor

_SMALLEST_NORM = 1e-8  # below it a vector has no direction that float32 arithmetic could trust
_AXES = ("x", "y", "z")


def gram_schmidt(six: Tensor) -> Tensor:
    """Orthonormalise two 3-vectors into a rotation; always a rotation, always a finite gradient.

    ``b1 = a1/|a1|``, ``b2`` the normalised part of ``a2`` orthogonal to ``b1``, ``b3 = b1 × b2``.
    A zero ``a1`` is read as +x. A zero ``a2``, or one parallel to ``a1``, is read as the coordinate
    axis farthest from ``b1``. What was replaced receives no gradient.

    Args:
        six: ``(a1, a2)`` in one vector, shape (..., 6).

    Returns:
        Rotations with the columns b1, b2, b3, shape (..., 3, 3), float32 for half precision.

    Raises:
        ValueError: If the last dimension is not 6.

    Reference:
        Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks".
    """
    if six.shape[-1] != 6:
        raise ValueError(f"gram_schmidt wants shape (..., 6), got {tuple(six.shape)}")
    six = _at_least_float32(six)
    a1, a2 = six[..., :3], six[..., 3:]
    first = _unit_or(a1, torch.eye(3, dtype=six.dtype, device=six.device)[0].expand_as(a1))
    spare = torch.nn.functional.one_hot(first.detach().abs().argmin(-1), 3).to(six.dtype)
    rest = _reject(a2, first)
    # Parallel input leaves rounding noise instead of zero, so the test is relative to |a2|.
    noise = 16 * torch.finfo(six.dtype).eps * a2.detach().norm(dim=-1, keepdim=True)
    rest = torch.where(
        rest.detach().norm(dim=-1, keepdim=True) > noise, rest, _reject(spare, first)
    )
    second = _unit_or(rest, _reject(spare, first))
    # Nearly parallel input loses orthogonality by cancellation; a second pass restores it.
    second = _unit_or(_reject(second, first), second)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)


def _reject(vector: Tensor, unit: Tensor) -> Tensor:
    """Part of ``vector`` orthogonal to ``unit``, shapes (..., 3)."""
    return vector - (vector * unit).sum(-1, keepdim=True) * unit


def _unit_or(vector: Tensor, fallback: Tensor) -> Tensor:
    """Normalise, with ``fallback`` in place of vectors too short to have a direction."""
    usable = vector.detach().norm(dim=-1, keepdim=True) > _SMALLEST_NORM
    vector = torch.where(usable, vector, fallback)
    return vector / vector.norm(dim=-1, keepdim=True)


def procrustes(matrix: Tensor, *, regularization: float = 0.0) -> Tensor:
    """Nearest rotation in the Frobenius norm.

    The gradient is roma's closed form, not that of the SVD, whose derivative is NaN where singular
    values coincide (as at M = I) although the map is smooth there. Where the map itself is singular
    (det M <= 0 with the two smallest singular values equal, as at M = 0) the unbounded terms
    are damped to at most 1/(2·1e-5), so every gradient is finite.

    Args:
        matrix: Any 3×3 matrices, shape (..., 3, 3).
        regularization: Weight μ; adds ``μ (M − R)`` to the gradient, as a loss ``μ/2 |M − R|²``
            would.

    Returns:
        Rotations, shape (..., 3, 3), float32 for half precision.

    Raises:
        ValueError: If the last two dimensions are not (3, 3).

    Reference:
        Brégier 2021, "Deep Regression on Manifolds: A 3D Rotation Case Study".
    """
    _check_matrices(matrix, "procrustes")
    # There is no half-precision SVD.
    return roma.special_procrustes(_at_least_float32(matrix), regularization=regularization)


def geodesic_angle_rad(a: Tensor, b: Tensor) -> Tensor:
    """Angle of the rotation that takes one rotation to the other.

    ``atan2(sin, cos)`` of the relative rotation, in float64 inside: acos of the trace loses
    everything below 3e-4 rad in float32, asin of the chord everything close to π. The gradient is
    finite everywhere and zero at 0 and π, where the distance has a kink.

    Args:
        a: Rotations, shape (..., 3, 3).
        b: Rotations that broadcast with ``a``.

    Returns:
        Angles in [0, π], shape (...), of the promoted dtype of the inputs.
    """
    _check_matrices(a, "geodesic_angle_rad")
    _check_matrices(b, "geodesic_angle_rad")
    dtype = torch.promote_types(_at_least_float32(a).dtype, _at_least_float32(b).dtype)
    wide = torch.float32 if a.device.type == "mps" else torch.float64  # that device has no float64
    relative = a.to(wide) @ b.to(wide).mT
    skew = _vee(relative - relative.mT)  # 2 sin(angle) · axis
    trace = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(skew.norm(dim=-1), trace - 1).to(dtype)


def _vee(skew: Tensor) -> Tensor:
    """Axial vector of a skew-symmetric matrix, (..., 3, 3) -> (..., 3)."""
    return torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), dim=-1)


def random_rotations(
    n: int,
    generator: torch.Generator | None = None,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Rotations uniform with respect to the Haar measure.

    A normalised Gaussian 4-vector is uniform on the unit quaternions. roma's own function is not
    used: some of its releases draw two of three numbers without the generator.

    Args:
        n: How many.
        generator: Source of randomness, on ``device``; the global one by default.
        dtype: Type of the result.
        device: Where it lives.

    Returns:
        Rotations, shape (n, 3, 3).
    """
    quaternion = torch.randn(n, 4, generator=generator, dtype=dtype, device=device)
    return rotation_from_quaternion_xyzw(quaternion)


def rotation_from_quaternion_xyzw(quaternion: Tensor) -> Tensor:
    """Rotation of a quaternion in the order (x, y, z, w); any non-zero length.

    Args:
        quaternion: Shape (..., 4).

    Returns:
        Rotations, shape (..., 3, 3).

    Raises:
        ValueError: If the shape is wrong or a quaternion is zero or not finite.
    """
    if quaternion.shape[-1] != 4:
        raise ValueError(f"a quaternion has shape (..., 4), got {tuple(quaternion.shape)}")
    quaternion = _at_least_float32(quaternion)
    norm = quaternion.norm(dim=-1, keepdim=True)
    if not bool(((norm > 0) & torch.isfinite(norm)).all()):
        raise ValueError("a quaternion is zero or not finite; a rotation needs four finite numbers")
    return roma.unitquat_to_rotmat(quaternion / norm)


def rotation_from_quaternion_wxyz(quaternion: Tensor) -> Tensor:
    """Rotation of a quaternion in the order (w, x, y, z). See `rotation_from_quaternion_xyzw`."""
    return rotation_from_quaternion_xyzw(quaternion.roll(-1, dims=-1))


def quaternion_xyzw_from_rotation(rotation: Tensor) -> Tensor:
    """Unit quaternion in the order (x, y, z, w) with w >= 0 (of the two, q and −q, that one).

    Args:
        rotation: Rotations, shape (..., 3, 3).

    Returns:
        Unit quaternions, shape (..., 4).
    """
    _check_matrices(rotation, "quaternion_xyzw_from_rotation")
    quaternion = roma.rotmat_to_unitquat(_at_least_float32(rotation))
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def quaternion_wxyz_from_rotation(rotation: Tensor) -> Tensor:
    """Unit quaternion in the order (w, x, y, z) with w >= 0, shape (..., 4)."""
    return quaternion_xyzw_from_rotation(rotation).roll(1, dims=-1)


def axis_rotation(axis: str, angle_deg: float | Tensor) -> Tensor:
    """Counter-clockwise rotation about a coordinate axis (right hand, seen from its tip).

    Args:
        axis: "x", "y" or "z".
        angle_deg: Angle in degrees, a number or a tensor of shape (...).

    Returns:
        Rotations, shape (..., 3, 3); float64 for a number. Quarter turns of a number are exact.

    Raises:
        ValueError: If the axis is another.
    """
    if axis not in _AXES:
        raise ValueError(f"axis {axis!r} is not one of {', '.join(_AXES)}")
    if isinstance(angle_deg, Tensor):
        angle = torch.deg2rad(_at_least_float32(angle_deg))
        cos, sin = torch.cos(angle), torch.sin(angle)
    else:
        quarters, rest = divmod(float(angle_deg), 90.0)
        c, s = math.cos(math.radians(rest)), math.sin(math.radians(rest))
        c, s = ((c, s), (-s, c), (-c, -s), (s, -c))[int(quarters) % 4]
        cos, sin = torch.tensor(c, dtype=torch.float64), torch.tensor(s, dtype=torch.float64)
    i = _AXES.index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rows = [[torch.zeros_like(cos) for _ in range(3)] for _ in range(3)]
    rows[i][i] = torch.ones_like(cos)
    rows[j][j], rows[j][k], rows[k][j], rows[k][k] = cos, -sin, sin, cos
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rotation_from_euler_deg(angles_deg: Tensor) -> Tensor:
    """``Rz(c) @ Ry(b) @ Rx(a)`` of (a, b, c): turns about the fixed x, then y, then z axis.

    This is scipy's ``Rotation.from_euler("xyz", ...)`` (lower case: extrinsic).

    Args:
        angles_deg: (a, b, c) in degrees, shape (..., 3).

    Returns:
        Rotations, shape (..., 3, 3).
    """
    a, b, c = angles_deg.unbind(-1)
    return axis_rotation("z", c) @ axis_rotation("y", b) @ axis_rotation("x", a)


def euler_deg_from_rotation(rotation: Tensor) -> Tensor:
    """Angles (a, b, c) with ``rotation = Rz(c) @ Ry(b) @ Rx(a)``.

    At b = ±90° only a ∓ c is determined; c = 0 is returned.

    Args:
        rotation: Rotations, shape (..., 3, 3).

    Returns:
        (a, b, c) in degrees, a and c in [−180, 180], b in [−90, 90], shape (..., 3).
    """
    _check_matrices(rotation, "euler_deg_from_rotation")
    r = _at_least_float32(rotation)
    cos_b = torch.hypot(r[..., 0, 0], r[..., 1, 0])
    locked = cos_b < 8 * torch.finfo(r.dtype).eps
    a = torch.where(
        locked,
        torch.atan2(-r[..., 1, 2], r[..., 1, 1]),
        torch.atan2(r[..., 2, 1], r[..., 2, 2]),
    )
    b = torch.atan2(-r[..., 2, 0], cos_b)
    c = torch.where(locked, torch.zeros_like(a), torch.atan2(r[..., 1, 0], r[..., 0, 0]))
    return torch.rad2deg(torch.stack((a, b, c), dim=-1))


def strip_z_symmetry(rotation: Tensor) -> Tensor:
    """Label of an object that looks the same when it is turned about its own z axis.

    With ``view = rotation.T = Rz(c) Ry(b) Rx(a)`` the factor Rz(c), a turn of the object about its
    axis, is dropped. What is left depends only on where the object's z axis points in the camera
    frame, (−sin b, cos b sin a, cos b cos a), and is computed from it; so two rotations that differ
    by the symmetry get the same label to the last bits. It jumps where the axis points along the
    camera's x axis (b = ±90°), where a = 0 is taken: no continuous choice exists.

    Args:
        rotation: Object→camera rotations, shape (..., 3, 3).

    Returns:
        Object→camera rotations, shape (..., 3, 3).
    """
    _check_matrices(rotation, "strip_z_symmetry")
    axis = rotation[..., :, 2]
    axis = axis / axis.norm(dim=-1, keepdim=True)
    sin_b = -axis[..., 0]
    cos_b = torch.hypot(axis[..., 1], axis[..., 2])
    locked = cos_b < 8 * torch.finfo(rotation.dtype).eps
    divisor = torch.where(locked, torch.ones_like(cos_b), cos_b)
    sin_a = torch.where(locked, torch.zeros_like(cos_b), axis[..., 1] / divisor)
    cos_a = torch.where(locked, torch.ones_like(cos_b), axis[..., 2] / divisor)
    columns = (  # the rows of Ry(b) Rx(a) are the columns of the object→camera rotation
        torch.stack((cos_b, sin_b * sin_a, sin_b * cos_a), dim=-1),
        torch.stack((torch.zeros_like(cos_b), cos_a, -sin_a), dim=-1),
        torch.stack((-sin_b, cos_b * sin_a, cos_b * cos_a), dim=-1),
    )
    return torch.stack(columns, dim=-1)


def z_axis_angle_rad(a: Tensor, b: Tensor) -> Tensor:
    """Angle between the object's z axes in the camera frame: the error of a z-symmetric object.

    Args:
        a: Object→camera rotations, shape (..., 3, 3).
        b: The same, broadcasting with ``a``.

    Returns:
        Angles in [0, π], shape (...).
    """
    _check_matrices(a, "z_axis_angle_rad")
    _check_matrices(b, "z_axis_angle_rad")
    u, v = torch.broadcast_tensors(a[..., :, 2], b[..., :, 2])
    return torch.atan2(torch.linalg.cross(u, v).norm(dim=-1), (u * v).sum(-1))


def _at_least_float32(x: Tensor) -> Tensor:
    return x if x.dtype in (torch.float32, torch.float64) else x.float()


def _check_matrices(x: Tensor, name: str) -> None:
    if x.shape[-2:] != (3, 3):
        raise ValueError(f"{name} wants shape (..., 3, 3), got {tuple(x.shape)}")
