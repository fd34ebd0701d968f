"""The heads of the pose baselines, each against its definition."""

import itertools

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from i2i.geometry.rotations import (
    axis_rotation,
    geodesic_angle_rad,
    gram_schmidt,
    procrustes,
    quaternion_wxyz_from_rotation,
    random_rotations,
)
from i2i.nn.rotation_heads import (
    GramSchmidtHead,
    InPlaneHead,
    ProcrustesHead,
    RefinementHead,
    SphericalHead,
    quaternion_sign_class,
    quaternion_signs,
    quaternion_size,
    rotation_from_size_and_sign,
)

WIDE = torch.float64


def assert_rotations(matrix, *, tolerance=1e-6):
    identity = torch.eye(3, dtype=matrix.dtype).expand_as(matrix)
    torch.testing.assert_close(matrix.mT @ matrix, identity, atol=tolerance, rtol=0)
    ones = torch.ones(len(matrix), dtype=matrix.dtype)
    torch.testing.assert_close(torch.linalg.det(matrix), ones, atol=tolerance, rtol=0)


@pytest.mark.parametrize(
    "head", [GramSchmidtHead(6), ProcrustesHead(6), RefinementHead(6, hidden=4), InPlaneHead(6)]
)
def test_random_features_give_rotations(head):
    torch.manual_seed(0)
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=3.0)
    shape = (1000, 6, 4) if isinstance(head, InPlaneHead) else (1000, 6)
    assert_rotations(head(torch.randn(shape)), tolerance=5e-6)


@pytest.mark.parametrize(
    "make", [GramSchmidtHead, ProcrustesHead, lambda n: RefinementHead(n, hidden=4)]
)
def test_heads_start_at_the_identity(make):
    head = make(7)
    torch.testing.assert_close(head(torch.zeros(2, 7)), torch.eye(3).expand(2, 3, 3))
    feature = torch.randn(3, 7, requires_grad=True)
    head(feature).sum().backward()
    assert torch.isfinite(feature.grad).all()
    assert feature.grad.abs().sum() > 0


def test_gram_schmidt_head_is_the_classical_algorithm():
    """b3 = normalise(b1 × a2), b2 = b3 × b1 on the numbers of the linear layer."""
    torch.manual_seed(0)
    head, feature = GramSchmidtHead(5).double(), torch.randn(50, 5, dtype=WIDE)
    six = (feature @ head.linear.weight.T + head.linear.bias).detach().numpy()
    b1 = six[:, :3] / np.linalg.norm(six[:, :3], axis=1, keepdims=True)
    b3 = np.cross(b1, six[:, 3:])
    b3 /= np.linalg.norm(b3, axis=1, keepdims=True)
    expected = np.stack([b1, np.cross(b3, b1), b3], axis=2)
    torch.testing.assert_close(head(feature).detach(), torch.tensor(expected))


def test_gram_schmidt_head_gradient():
    torch.manual_seed(0)
    head = GramSchmidtHead(4).double()
    assert torch.autograd.gradcheck(head, torch.randn(3, 4, dtype=WIDE, requires_grad=True))


def test_procrustes_head_gives_the_nearest_rotation():
    """scipy solves the same problem (Wahba's) with an SVD of its own."""
    torch.manual_seed(0)
    head, feature = ProcrustesHead(5).double(), torch.randn(40, 5, dtype=WIDE)
    torch.nn.init.normal_(head.linear.weight)  # of both signs of the determinant
    matrices = (feature @ head.linear.weight.T + head.linear.bias).view(-1, 3, 3).detach()
    assert 5 < (torch.linalg.det(matrices) < 0).sum() < 35
    for matrix, rotation in zip(matrices, head(feature).detach(), strict=True):
        best, _ = Rotation.align_vectors(matrix.T.numpy(), np.eye(3))
        torch.testing.assert_close(rotation, torch.tensor(best.as_matrix()))


def _procrustes_points():
    generator = torch.Generator().manual_seed(0)
    rotation = random_rotations(1, generator)[0]
    other = random_rotations(1, generator)[0]
    return {
        "identity": torch.eye(3, dtype=WIDE),
        "near the identity": torch.eye(3, dtype=WIDE) + 1e-9 * other,
        "a rotation": rotation,
        "two equal singular values": rotation @ torch.diag(torch.tensor([2.0, 2, 1.0])).double(),
        "the smaller two equal": rotation @ torch.diag(torch.tensor([2.0, 1, 1.0])).double(),
        "generic": torch.randn(3, 3, generator=generator, dtype=WIDE),
        "negative determinant": rotation @ torch.diag(torch.tensor([3.0, 2, -1.0])).double(),
    }


@pytest.mark.parametrize("name", list(_procrustes_points()))
def test_procrustes_gradient(name):
    """Where the map is smooth the gradient is that of finite differences."""
    matrix = _procrustes_points()[name].clone()[None].requires_grad_()
    assert torch.autograd.gradcheck(procrustes, matrix, eps=1e-6, atol=1e-5)


def test_procrustes_gradient_by_svd_is_not_a_number_at_the_identity():
    """The control: what automatic differentiation would give in its place."""
    matrix = torch.eye(3, dtype=WIDE, requires_grad=True)
    u, _, vt = torch.linalg.svd(matrix)
    (u @ vt * torch.arange(9.0).view(3, 3)).sum().backward()
    assert not torch.isfinite(matrix.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("diagonal", [(0, 0, 0), (1, 1, 1), (1, 1, -1), (1, -1, -1), (2, 0, 0)])
def test_procrustes_gradient_is_finite_where_the_map_is_singular(diagonal, dtype):
    matrix = torch.diag(torch.tensor(diagonal, dtype=dtype))[None].requires_grad_()
    rotation = procrustes(matrix)
    assert rotation.dtype == (torch.float32 if dtype == torch.bfloat16 else dtype)
    assert_rotations(rotation.detach())
    (rotation * torch.arange(9.0).view(3, 3)).sum().backward()
    assert torch.isfinite(matrix.grad).all()
    assert matrix.grad.abs().max() < 1e7


def test_procrustes_regularization_pulls_to_the_rotations():
    """μ (M − R) is the gradient of μ/2 |M − R|² with R held fixed."""
    torch.manual_seed(0)
    plain, pulled = ProcrustesHead(3).double(), ProcrustesHead(3, regularization=0.5).double()
    pulled.load_state_dict(plain.state_dict())
    feature = torch.randn(4, 3, dtype=WIDE)
    for head in (plain, pulled):
        head(feature).sum().backward()
    matrix = plain.linear(feature).view(-1, 3, 3)
    expected = 0.5 * (matrix - plain(feature)).sum(dim=0).flatten()
    torch.testing.assert_close(pulled.linear.bias.grad - plain.linear.bias.grad, expected.detach())


@pytest.mark.parametrize("make", [GramSchmidtHead, ProcrustesHead, RefinementHead, SphericalHead])
def test_heads_keep_full_precision_under_autocast(make):
    torch.manual_seed(0)
    head, feature = make(16), torch.randn(4, 16)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = head(feature)
        half = head(feature.bfloat16())
    exact, rounded = head(feature), head(feature.bfloat16().float())
    pairs = [(mixed, exact), (half, rounded)]
    if make is SphericalHead:
        pairs = [pair for one, two in pairs for pair in zip(one, two, strict=True)]
    for one, two in pairs:
        assert one.dtype == torch.float32
        assert torch.equal(one, two)


def test_refinement_starts_as_gram_schmidt_of_its_first_layer():
    torch.manual_seed(0)
    head, feature = RefinementHead(9, hidden=5), torch.randn(20, 9)
    assert torch.equal(head(feature), gram_schmidt(head.linear(feature)))


@pytest.mark.parametrize("iterations", [1, 3])
def test_refinement_adds_corrections_of_feature_and_numbers(iterations):
    torch.manual_seed(0)
    head = RefinementHead(9, hidden=5, iterations=iterations).double()
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter)
    feature = torch.randn(20, 9, dtype=WIDE)
    weights = {name: value.detach().numpy() for name, value in head.named_parameters()}
    h = feature.numpy()
    six = h @ weights["linear.weight"].T + weights["linear.bias"]
    for i in range(iterations):
        first, last = f"corrections.{i}.0", f"corrections.{i}.2"
        hidden = np.hstack([h, six]) @ weights[f"{first}.weight"].T + weights[f"{first}.bias"]
        six = six + np.maximum(hidden, 0) @ weights[f"{last}.weight"].T + weights[f"{last}.bias"]
    torch.testing.assert_close(head(feature), gram_schmidt(torch.tensor(six)))


@pytest.mark.parametrize("options", [{"hidden": 0}, {"iterations": 0}])
def test_refinement_sizes(options):
    with pytest.raises(ValueError, match="at least 1"):
        RefinementHead(4, **options)


def test_quaternion_there_and_back():
    rotation = random_rotations(10_000, torch.Generator().manual_seed(0))
    quaternion = quaternion_wxyz_from_rotation(rotation)
    back = rotation_from_size_and_sign(quaternion.abs(), quaternion_sign_class(quaternion))
    torch.testing.assert_close(back, rotation, atol=1e-12, rtol=0)
    # All eight patterns are equally likely for uniform rotations: 1250 ± 33 of each.
    counts = torch.bincount(quaternion_sign_class(quaternion), minlength=8)
    assert len(counts) == 8
    assert (counts - 1250).abs().max() < 5 * 33


def test_quaternion_seams():
    """Half turns, turns about an axis and the identity have components of 0, of either sign."""
    turns = [axis_rotation(axis, angle) for axis in "xyz" for angle in (0, 90, 180, 270)]
    rotation = torch.stack(turns)
    quaternion = quaternion_wxyz_from_rotation(rotation)
    back = rotation_from_size_and_sign(quaternion.abs(), quaternion_sign_class(quaternion))
    torch.testing.assert_close(back, rotation, atol=1e-12, rtol=0)
    zeros = torch.tensor([[1.0, 0.0, -0.0, 0.0]])
    assert quaternion_sign_class(zeros).item() == 7


def test_sign_patterns_count_in_binary():
    for number, signs in enumerate(itertools.product((-1.0, 1.0), repeat=3)):
        assert quaternion_signs(torch.tensor(number)).tolist() == [1.0, *signs]
        pattern = torch.tensor([0.5, *(0.5 * sign for sign in signs)])
        assert quaternion_sign_class(pattern).item() == number


def test_decoded_rotation_is_scipys():
    generator = torch.Generator().manual_seed(0)
    size = torch.randn(200, 4, generator=generator, dtype=WIDE).abs()
    size = size / size.norm(dim=1, keepdim=True)
    number = torch.randint(8, (200,), generator=generator)
    w, x, y, z = (size * quaternion_signs(number)).T.numpy()
    expected = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    torch.testing.assert_close(rotation_from_size_and_sign(size, number), torch.tensor(expected))


def test_quaternion_size_is_a_point_of_the_sphere_with_a_finite_gradient():
    scores = torch.tensor([[0.0, 0, 0, 0], [200.0, -200, 0, 3], [1e4, -1e4, 0, 0]])
    scores.requires_grad_()
    size = quaternion_size(scores)
    torch.testing.assert_close(size[0], torch.full((4,), 0.5))
    torch.testing.assert_close(size.norm(dim=1), torch.ones(3))
    assert (size > 0).all()
    size.sum().backward()
    assert torch.isfinite(scores.grad).all()
    wide = torch.randn(3, 4, dtype=WIDE, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(quaternion_size, wide.requires_grad_())


def test_spherical_head_slices_by_class():
    torch.manual_seed(0)
    head, feature = SphericalHead(5, hidden=6, num_classes=3), torch.randn(7, 5)
    torch.nn.init.normal_(head.size[2].weight)
    class_id = torch.tensor([0, 1, 2, 2, 1, 0, 1])
    size, sign = head(feature, class_id)
    whole_size, whole_sign = head.size(feature), head.sign(feature)
    for row, k in enumerate(class_id.tolist()):
        assert torch.equal(size[row], whole_size[row, 4 * k : 4 * k + 4])
        assert torch.equal(sign[row], whole_sign[row, 8 * k : 8 * k + 8])
    with pytest.raises(ValueError, match="3 classes"):
        head(feature)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_in_plane_angle_follows_the_shift_of_the_fields(turns):
    torch.manual_seed(0)
    head = InPlaneHead(6).double()
    pooled = torch.rand(50, 6, 4, dtype=WIDE)
    quarter = axis_rotation("z", 90.0 * turns)
    shifted = head(pooled.roll(turns, dims=2))
    torch.testing.assert_close(shifted, quarter @ head(pooled), atol=1e-12, rtol=0)
    # The control: shifting the other way turns back.
    if turns != 2:
        wrong = geodesic_angle_rad(head(pooled.roll(-turns, dims=2)), quarter @ head(pooled))
        assert torch.rad2deg(wrong).min() > 170


def test_in_plane_head_is_every_map_that_turns():
    """The equivariant linear maps from one regular field to the plane: two dimensions, ours."""
    shift = torch.eye(4, dtype=WIDE).roll(1, dims=0)  # of a quarter turn on the four numbers
    turn = axis_rotation("z", 90.0)[:2, :2].contiguous()
    # vec(T A − A S) = (T ⊗ 1 − 1 ⊗ Sᵀ) vec(A), rows first.
    equations = torch.kron(turn, torch.eye(4, dtype=WIDE)) - torch.kron(
        torch.eye(2, dtype=WIDE), shift.T.contiguous()
    )
    assert 8 - torch.linalg.matrix_rank(equations) == 2 == InPlaneHead(1).weight.numel()


def test_in_plane_head_without_a_direction():
    """Fields that are equal in all turns have no angle: still a rotation and a finite gradient."""
    head = InPlaneHead(3)
    pooled = torch.ones(2, 3, 4, requires_grad=True)
    out = head(pooled)
    assert torch.equal(out, torch.eye(3).expand(2, 3, 3))
    out.sum().backward()
    assert torch.isfinite(pooled.grad).all()


def test_in_plane_head_has_weights_for_each_class():
    torch.manual_seed(0)
    head, pooled = InPlaneHead(3, num_classes=2), torch.rand(4, 3, 4)
    class_id = torch.tensor([0, 1, 1, 0])
    out = head(pooled, class_id)
    for k in (0, 1):
        alone = InPlaneHead(3)
        alone.load_state_dict({"weight": head.weight[k : k + 1]})
        torch.testing.assert_close(out[class_id == k], alone(pooled[class_id == k]))
    with pytest.raises(ValueError, match="2 classes"):
        head(pooled)
