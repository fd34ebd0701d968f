"""Rotations against scipy, closed forms, automatic differentiation and their own properties."""

import math

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2i.geometry.rotations import (
    axis_rotation,
    euler_deg_from_rotation,
    geodesic_angle_rad,
    gram_schmidt,
    procrustes,
    quaternion_wxyz_from_rotation,
    quaternion_xyzw_from_rotation,
    random_rotations,
    rotation_from_euler_deg,
    rotation_from_quaternion_wxyz,
    rotation_from_quaternion_xyzw,
    strip_z_symmetry,
    z_axis_angle_rad,
)

EYE = torch.eye(3, dtype=torch.float64)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def assert_rotations(r, atol=1e-6):
    eye = torch.eye(3, dtype=r.dtype).expand_as(r)
    torch.testing.assert_close(r.mT @ r, eye, atol=atol, rtol=0)
    torch.testing.assert_close(
        torch.det(r), torch.ones(r.shape[:-2], dtype=r.dtype), atol=atol, rtol=0
    )


def matrix(rows):
    return torch.tensor(rows, dtype=torch.float64)


# --- Gram-Schmidt -------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gram_schmidt_gives_rotations_and_keeps_them(dtype):
    six = torch.randn(1000, 6, generator=seeded(), dtype=dtype)
    assert_rotations(gram_schmidt(six), 1e-6)
    r = random_rotations(50, seeded(1), dtype=dtype)
    columns = torch.cat((r[..., 0], r[..., 1]), dim=-1)
    torch.testing.assert_close(gram_schmidt(3.7 * columns), r)


def test_gram_schmidt_is_the_qr_decomposition():
    six = torch.randn(100, 6, generator=seeded(), dtype=torch.float64)
    q, upper = torch.linalg.qr(torch.stack((six[:, :3], six[:, 3:]), dim=-1))
    q = q * torch.sign(upper.diagonal(dim1=-2, dim2=-1))[:, None, :]
    torch.testing.assert_close(gram_schmidt(six)[..., :2], q)


DEGENERATE = {
    "zero": [0, 0, 0, 0, 0, 0],
    "first zero": [0, 0, 0, 1, 2, 3],
    "second zero": [1, 2, 3, 0, 0, 0],
    "parallel": [1, 2, 3, 2, 4, 6],
    "opposite": [0.3, -0.1, 0.7, -0.6, 0.2, -1.4],
    "long and parallel": [0.1, 0.2, 0.3, 1e4, 2e4, 3e4],
    "tiny": [1e-20, 0, 0, 0, 1e-20, 0],
    "first zero, second on the spare axis": [0, 0, 0, 1, 0, 0],
    "nearly parallel": [1, 2, 3, 1.00001, 2, 3],
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", DEGENERATE)
def test_gram_schmidt_survives_degenerate_input(name, dtype):
    six = torch.tensor(DEGENERATE[name], dtype=dtype, requires_grad=True)
    r = gram_schmidt(six)
    assert_rotations(r.detach(), 1e-5)
    (r * torch.arange(9.0, dtype=dtype).reshape(3, 3)).sum().backward()
    assert torch.isfinite(six.grad).all()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3, width=32), min_size=6, max_size=6))
def test_gram_schmidt_of_anything_is_a_rotation(values):
    assert_rotations(gram_schmidt(torch.tensor(values, dtype=torch.float32)), 2e-5)


def test_gram_schmidt_gradient():
    six = torch.randn(4, 6, generator=seeded(), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(gram_schmidt, (six,))


# --- Procrustes ---------------------------------------------------------------------------------


def test_procrustes_is_the_nearest_rotation():
    m = torch.randn(20, 3, 3, generator=seeded(), dtype=torch.float64)
    best = procrustes(m)
    assert_rotations(best, 1e-10)
    others = random_rotations(5000, seeded(1))
    distance = (m[:, None] - others).flatten(2).norm(dim=-1).min(dim=1).values
    assert ((m - best).flatten(1).norm(dim=-1) <= distance).all()


SMOOTH = {
    "identity": EYE,
    "three equal": 2.5 * axis_rotation("x", 33.0),
    "two equal, large": torch.diag(matrix([2.0, 2.0, 1.0])),
    "two equal, small": torch.diag(matrix([2.0, 1.0, 1.0])),
    "rank two": torch.diag(matrix([2.0, 1.0, 0.0])),
    "reflected": torch.diag(matrix([3.0, 2.0, -1.0])),
}
SINGULAR = {
    "zero": torch.zeros(3, 3, dtype=torch.float64),
    "rank one": torch.diag(matrix([1.0, 0.0, 0.0])),
    "reflection": torch.diag(matrix([1.0, 1.0, -1.0])),
    "minus identity": -EYE,
}


@pytest.mark.parametrize("name", SMOOTH)
def test_procrustes_gradient_where_the_map_is_smooth(name):
    m = SMOOTH[name].clone().requires_grad_()
    assert torch.autograd.gradcheck(procrustes, (m,), atol=1e-6)


def test_procrustes_gradient_at_random_matrices_and_against_the_svd():
    m = torch.randn(5, 3, 3, generator=seeded(), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(procrustes, (m,), atol=1e-6)
    weight = torch.randn(5, 3, 3, generator=seeded(1), dtype=torch.float64)
    (ours,) = torch.autograd.grad((procrustes(m) * weight).sum(), m)
    (theirs,) = torch.autograd.grad(
        (roma.procrustes_naive(m, force_rotation=True) * weight).sum(), m
    )
    torch.testing.assert_close(ours, theirs, atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SINGULAR)
def test_procrustes_gradient_is_finite_where_it_does_not_exist(name, dtype):
    m = SINGULAR[name].to(dtype).requires_grad_()
    r = procrustes(m)
    assert_rotations(r.detach())
    (r * torch.arange(9.0, dtype=dtype).reshape(3, 3)).sum().backward()
    assert torch.isfinite(m.grad).all()


def test_plain_svd_fails_where_ours_does_not():
    """Negative control: the reason why procrustes is not three lines of torch."""
    m = EYE.clone().requires_grad_()
    u, _, vh = torch.linalg.svd(m)
    ((u @ vh) * torch.arange(9.0).reshape(3, 3)).sum().backward()
    assert not torch.isfinite(m.grad).all()


def test_procrustes_regularization_adds_its_gradient():
    m = torch.randn(3, 3, generator=seeded(), dtype=torch.float64, requires_grad=True)
    (plain,) = torch.autograd.grad(procrustes(m)[0, 1], m)
    (regular,) = torch.autograd.grad(procrustes(m, regularization=0.3)[0, 1], m)
    torch.testing.assert_close(regular - plain, 0.3 * (m - procrustes(m)).detach())


def test_procrustes_takes_half_precision():
    assert procrustes(torch.eye(3, dtype=torch.bfloat16)).dtype == torch.float32


# --- Geodesic angle -----------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 3e-7), (torch.float64, 1e-14)])
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 1.0, math.pi - 1e-4, math.pi - 1e-6, math.pi])
def test_geodesic_angle_is_accurate_from_zero_to_pi(angle, dtype, atol):
    axes = torch.randn(50, 3, generator=seeded(), dtype=torch.float64)
    axes = axes / axes.norm(dim=-1, keepdim=True)
    relative = torch.from_numpy(Rotation.from_rotvec(angle * axes.numpy()).as_matrix())
    base = random_rotations(50, seeded(1))
    # without a base, rounding of the float32 entries does not hide the formula's own error
    alone = geodesic_angle_rad(relative.to(dtype), torch.eye(3, dtype=dtype))
    torch.testing.assert_close(alone, torch.full_like(alone, angle), atol=atol, rtol=0)
    both = geodesic_angle_rad((relative @ base).to(dtype), base.to(dtype))
    torch.testing.assert_close(both, torch.full_like(both, angle), atol=4 * atol, rtol=0)
    assert both.dtype == dtype


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_geodesic_angle_at_1e_minus_6_is_right_to_ten_per_cent(dtype):
    small = axis_rotation("y", math.degrees(1e-6)).to(dtype)
    assert geodesic_angle_rad(small, EYE.to(dtype)).item() == pytest.approx(1e-6, rel=1e-4)
    base = random_rotations(100, seeded())
    turned = (axis_rotation("y", math.degrees(1e-6)) @ base).to(torch.float64)
    torch.testing.assert_close(
        geodesic_angle_rad(turned, base), torch.full((100,), 1e-6).double(), rtol=1e-6, atol=0
    )


def test_geodesic_angle_is_scipys():
    a, b = random_rotations(200, seeded()), random_rotations(200, seeded(1))
    expected = (Rotation.from_matrix(a) * Rotation.from_matrix(b).inv()).magnitude()
    np.testing.assert_allclose(geodesic_angle_rad(a, b), expected, atol=1e-12)
    torch.testing.assert_close(geodesic_angle_rad(a.mT, b.mT), geodesic_angle_rad(b, a))
    torch.testing.assert_close(geodesic_angle_rad(a[:, None], b[:3]).shape, torch.Size((200, 3)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle_deg", [0.0, 1e-5, 90.0, 179.99999, 180.0])
def test_geodesic_gradient_is_finite(angle_deg, dtype):
    a = axis_rotation("x", angle_deg).to(dtype).requires_grad_()
    geodesic_angle_rad(a, EYE.to(dtype)).backward()
    assert torch.isfinite(a.grad).all()


def test_geodesic_gradient_is_right_between():
    a = random_rotations(3, seeded()).requires_grad_()
    b = random_rotations(3, seeded(1))
    assert torch.autograd.gradcheck(geodesic_angle_rad, (a, b))


# --- Random rotations ---------------------------------------------------------------------------


def test_random_rotations_are_haar():
    n = 40_000
    r = random_rotations(n, seeded())
    assert_rotations(r, 1e-12)
    flat = r.flatten(1)
    # By Schur orthogonality E[R] = 0, E[R_ij R_kl] = δ_ik δ_jl / 3, and E[tr² R] = 1.
    tolerance = 5 / math.sqrt(n)
    torch.testing.assert_close(flat.mean(0), torch.zeros(9).double(), atol=tolerance, rtol=0)
    second = flat.T @ flat / n
    torch.testing.assert_close(second, torch.eye(9).double() / 3, atol=tolerance, rtol=0)
    trace = flat[:, ::4].sum(1)
    assert (trace**2).mean().item() == pytest.approx(1, abs=0.04)
    # left translation does not change the distribution of angles: CDF (θ − sin θ)/π
    fixed = random_rotations(1, seeded(7))
    for angles in (geodesic_angle_rad(r, EYE), geodesic_angle_rad(r, fixed)):
        expected = torch.sort(angles).values
        cdf = (expected - expected.sin()) / math.pi
        ranks = (torch.arange(n).double() + 0.5) / n
        assert (cdf - ranks).abs().max() < 1.95 / math.sqrt(n)  # Kolmogorov-Smirnov, p = 0.001


def test_chance_levels_of_a_random_guess():
    a, b = random_rotations(60_000, seeded(2)), random_rotations(60_000, seeded(3))
    degrees = torch.rad2deg(geodesic_angle_rad(a, b))
    assert degrees.mean().item() == pytest.approx(126.5, abs=0.7)
    assert degrees.median().item() == pytest.approx(132.3, abs=0.9)
    assert (degrees < 30).double().mean().item() == pytest.approx(0.0075, abs=0.0015)


def test_random_rotations_obey_their_generator():
    assert torch.equal(random_rotations(5, seeded(3)), random_rotations(5, seeded(3)))
    assert not torch.equal(random_rotations(5, seeded(3)), random_rotations(5, seeded(4)))


# --- Quaternions and angles ---------------------------------------------------------------------


def test_quaternions_are_scipys_in_both_orders():
    r = random_rotations(500, seeded())
    xyzw = Rotation.from_matrix(r).as_quat()
    xyzw *= np.where(xyzw[:, 3:] < 0, -1, 1)
    np.testing.assert_allclose(quaternion_xyzw_from_rotation(r), xyzw, atol=1e-12)
    np.testing.assert_allclose(quaternion_wxyz_from_rotation(r), xyzw[:, [3, 0, 1, 2]], atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, -1.0, 1e-3, 1e3])
def test_quaternion_round_trip_whatever_its_length_and_sign(scale):
    r = random_rotations(200, seeded())
    xyzw, wxyz = quaternion_xyzw_from_rotation(r), quaternion_wxyz_from_rotation(r)
    torch.testing.assert_close(rotation_from_quaternion_xyzw(scale * xyzw), r)
    torch.testing.assert_close(rotation_from_quaternion_wxyz(scale * wxyz), r)


@pytest.mark.parametrize("axis", "xyz")
def test_half_turns_have_quaternions(axis):
    r = axis_rotation(axis, 180.0)
    torch.testing.assert_close(rotation_from_quaternion_xyzw(quaternion_xyzw_from_rotation(r)), r)


@pytest.mark.parametrize("bad", [[0.0, 0, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 1]])
def test_a_quaternion_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match="zero or not finite"):
        rotation_from_quaternion_xyzw(torch.tensor(bad))


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("angle", [-200.0, -90.0, 0.0, 12.5, 180.0, 450.0])
def test_axis_rotation_is_scipys(axis, angle):
    expected = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    np.testing.assert_allclose(axis_rotation(axis, angle), expected, atol=1e-14)
    batched = axis_rotation(axis, torch.tensor([angle, 0.0], dtype=torch.float64))
    np.testing.assert_allclose(batched[0], expected, atol=1e-14)


def test_quarter_turns_are_exact():
    assert axis_rotation("z", 90).tolist() == [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert axis_rotation("z", -90).tolist() == [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]


def test_euler_angles_are_scipys_extrinsic_xyz():
    r = random_rotations(300, seeded())
    expected = Rotation.from_matrix(r).as_euler("xyz", degrees=True)
    np.testing.assert_allclose(euler_deg_from_rotation(r), expected, atol=1e-9)
    torch.testing.assert_close(rotation_from_euler_deg(euler_deg_from_rotation(r)), r)


@pytest.mark.parametrize("b", [90.0, -90.0])
def test_euler_angles_at_gimbal_lock(b):
    r = rotation_from_euler_deg(matrix([20.0, b, 50.0]))
    angles = euler_deg_from_rotation(r)
    assert angles[2] == 0
    torch.testing.assert_close(rotation_from_euler_deg(angles), r, atol=1e-12, rtol=0)


@settings(max_examples=100, deadline=None)
@given(st.tuples(st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180)))
def test_euler_round_trip_of_anything(angles):
    r = rotation_from_euler_deg(matrix(angles))
    torch.testing.assert_close(
        rotation_from_euler_deg(euler_deg_from_rotation(r)), r, atol=1e-7, rtol=0
    )


# --- z symmetry ---------------------------------------------------------------------------------


def test_strip_is_the_rule_in_euler_angles():
    rotation = random_rotations(300, seeded())
    angles = Rotation.from_matrix(rotation.mT).as_euler("xyz")  # view = Rz(c) Ry(b) Rx(a)
    angles[:, 2] = 0
    expected = Rotation.from_euler("xyz", angles).as_matrix().transpose(0, 2, 1)
    np.testing.assert_allclose(strip_z_symmetry(rotation), expected, atol=1e-12)


@pytest.mark.parametrize("angle", [1.0, 90.0, 137.0, 180.0])
def test_strip_forgets_turns_of_the_object_about_its_axis(angle):
    rotation = random_rotations(300, seeded())
    turned = rotation @ axis_rotation("z", angle)  # view' = Rz(−angle) view
    torch.testing.assert_close(
        strip_z_symmetry(turned), strip_z_symmetry(rotation), atol=4e-15, rtol=0
    )


def test_strip_keeps_the_axis_and_is_idempotent():
    rotation = random_rotations(300, seeded())
    stripped = strip_z_symmetry(rotation)
    assert_rotations(stripped, 1e-12)
    torch.testing.assert_close(stripped[..., 2], rotation[..., 2])
    torch.testing.assert_close(strip_z_symmetry(stripped), stripped)
    assert z_axis_angle_rad(stripped, rotation).max() < 1e-12


def test_strip_at_the_discontinuity_is_still_a_rotation():
    for b in (90.0, -90.0):
        view = rotation_from_euler_deg(matrix([20.0, b, 50.0]))
        stripped = strip_z_symmetry(view.mT)
        assert_rotations(stripped, 1e-12)
        torch.testing.assert_close(stripped, axis_rotation("y", b).mT, atol=1e-12, rtol=0)


def test_quarter_turn_of_the_image_needs_a_new_strip():
    """strip(Rz R) can be computed from strip(R), but it is not Rz strip(R)."""
    rotation = random_rotations(100, seeded())
    quarter = axis_rotation("z", 90)
    again = strip_z_symmetry(quarter @ rotation)
    torch.testing.assert_close(strip_z_symmetry(quarter @ strip_z_symmetry(rotation)), again)
    assert geodesic_angle_rad(quarter @ strip_z_symmetry(rotation), again).median() > 0.1


def test_z_axis_angle_is_that_of_the_vectors():
    a, b = random_rotations(200, seeded()), random_rotations(200, seeded(1))
    cosine = (a[..., 2] * b[..., 2]).sum(-1)
    torch.testing.assert_close(z_axis_angle_rad(a, b), torch.acos(cosine))
    assert z_axis_angle_rad(a, a @ axis_rotation("z", 77)).max() < 1e-12
    assert z_axis_angle_rad(EYE, axis_rotation("x", 180)).item() == pytest.approx(math.pi)


@pytest.mark.parametrize("function", [procrustes, strip_z_symmetry, quaternion_xyzw_from_rotation])
def test_wrong_shapes_are_refused(function):
    with pytest.raises(ValueError, match=r"\(\.\.\., 3, 3\), got \(4, 3\)"):
        function(torch.zeros(4, 3))
