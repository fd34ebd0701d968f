"""Heads of the pose baselines: from one feature vector to one rotation.

All of them run in float32 or wider whatever the autocast mode: rounding a quaternion or a 3×3
matrix to half precision costs half a degree.
"""

import roma
import torch
from torch import Tensor, nn

from i2i.geometry.rotations import gram_schmidt, procrustes
from i2i.nn.precision import at_least_float32, full_precision

SIGN_CLASSES = 8
_IDENTITY_SIX = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_IDENTITY_QUATERNION = (0.0, 0.0, 0.0, 1.0)
_IDENTITY_NINE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_SMALLEST_NORM = 1e-8


def _identity_biased(in_features: int, identity: tuple[float, ...]) -> nn.Linear:
    """A linear layer whose outputs start around a rotation, not around 0, where there is none."""
    linear = nn.Linear(in_features, len(identity))
    with torch.no_grad():
        linear.bias.copy_(torch.tensor(identity))
    return linear


class GramSchmidtHead(nn.Module):
    """A linear layer to six numbers, orthonormalised.

    Args:
        in_features: Length of the feature vector F.

    Shape:
        (B, F) -> (B, 3, 3); the numbers are the first two columns before Gram-Schmidt.

    Reference:
        Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks".

    Example:
        >>> GramSchmidtHead(5)(torch.zeros(2, 5))[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]], grad_fn=<SelectBackward0>)
    """

    def __init__(self, in_features: int) -> None:
        super().__init__()
        self.linear = _identity_biased(in_features, _IDENTITY_SIX)

    def forward(self, feature: Tensor) -> Tensor:
        """Rotations (B, 3, 3) of features (B, F)."""
        feature = at_least_float32(feature)
        with full_precision(feature):
            return gram_schmidt(self.linear(feature))


class QuaternionHead(nn.Module):
    """A linear layer to a quaternion (x, y, z, w), normalised.

    Args:
        in_features: Length of the feature vector F.

    Shape:
        (..., F) -> (..., 3, 3); a zero quaternion is read as the identity.

    Example:
        >>> QuaternionHead(5)(torch.zeros(2, 5))[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]], grad_fn=<SelectBackward0>)
    """

    def __init__(self, in_features: int) -> None:
        super().__init__()
        self.linear = _identity_biased(in_features, _IDENTITY_QUATERNION)

    def forward(self, feature: Tensor) -> Tensor:
        """Rotations (..., 3, 3) of features (..., F)."""
        feature = at_least_float32(feature)
        with full_precision(feature):
            numbers = self.linear(feature)
            norm = numbers.norm(dim=-1, keepdim=True)
            unit = numbers / norm.clamp(min=_SMALLEST_NORM)
            identity = numbers.new_tensor(_IDENTITY_QUATERNION)
            return roma.unitquat_to_rotmat(torch.where(norm > _SMALLEST_NORM, unit, identity))


class ProcrustesHead(nn.Module):
    """A linear layer to nine numbers, and the rotation nearest to that matrix.

    Args:
        in_features: Length of the feature vector F.
        regularization: μ; adds μ (M − R) to the gradient of the matrix M, which keeps it near the
            rotations. The baseline has none.

    Shape:
        (B, F) -> (B, 3, 3).

    Reference:
        Brégier 2021, "Deep Regression on Manifolds: A 3D Rotation Case Study".
    """

    def __init__(self, in_features: int, *, regularization: float = 0.0) -> None:
        super().__init__()
        self.linear = _identity_biased(in_features, _IDENTITY_NINE)
        self.regularization = regularization

    def forward(self, feature: Tensor) -> Tensor:
        """Rotations (B, 3, 3) of features (B, F)."""
        feature = at_least_float32(feature)
        with full_precision(feature):
            matrix = self.linear(feature).unflatten(-1, (3, 3))
            return procrustes(matrix, regularization=self.regularization)

    def extra_repr(self) -> str:
        """The regulariser."""
        return f"regularization={self.regularization:g}"


class RefinementHead(nn.Module):
    """Six numbers, corrected several times from the feature and the numbers so far.

    `r_0` is linear in the feature h and `r_i = r_(i−1) + head_i([h, r_(i−1)])`; only the last is
    made a rotation. Each `head_i` has one hidden layer: with 256 units and two of them the network
    has the 11.4 M parameters of the paper's table, which plain linear corrections (11.18 M) do not
    have. Their last layers start at 0, so the head starts as `GramSchmidtHead`.

    Args:
        in_features: Length of the feature vector F.
        hidden: Hidden units of a correction.
        iterations: Number of corrections (paper: 2).

    Shape:
        (B, F) -> (B, 3, 3).

    Raises:
        ValueError: If `hidden` or `iterations` is less than 1.

    Reference:
        Bukschat and Vetter 2020, "EfficientPose"; the paper's baseline CNN+IER.
    """

    def __init__(self, in_features: int, *, hidden: int = 256, iterations: int = 2) -> None:
        super().__init__()
        for name, value in (("hidden", hidden), ("iterations", iterations)):
            if value < 1:
                raise ValueError(f"{name}={value}: give a whole number of at least 1")
        self.linear = _identity_biased(in_features, _IDENTITY_SIX)
        self.corrections = nn.ModuleList()
        for _ in range(iterations):
            last = nn.Linear(hidden, 6)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            correction = nn.Sequential(nn.Linear(in_features + 6, hidden), nn.ReLU(), last)
            self.corrections.append(correction)

    def forward(self, feature: Tensor) -> Tensor:
        """Rotations (B, 3, 3) of features (B, F)."""
        feature = at_least_float32(feature)
        with full_precision(feature):
            six = self.linear(feature)
            for correction in self.corrections:
                six = six + correction(torch.cat([feature, six], dim=-1))
            return gram_schmidt(six)


class SphericalHead(nn.Module):
    """Two heads with a hidden layer: size of the quaternion's components, and their signs.

    Args:
        in_features: Length of the feature vector F.
        hidden: Hidden units of each head (996 in the original).
        num_classes: Classes K of objects; each has its own slice of the outputs.
        std: Standard deviation of the initial weights (0.005 in the original).

    Shape:
        (B, F) and class indices (B,) or None -> (B, 4) and (B, 8).

    Reference:
        Liao et al. 2019, "Spherical Regression: Learning Viewpoints, Surface Normals and 3D
        Rotations on n-Spheres".
    """

    def __init__(
        self, in_features: int, *, hidden: int = 996, num_classes: int = 1, std: float = 0.005
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.size = self._make(in_features, hidden, 4 * num_classes)
        self.sign = self._make(in_features, hidden, SIGN_CLASSES * num_classes)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=std)
                nn.init.zeros_(module.bias)

    @staticmethod
    def _make(in_features: int, hidden: int, out_features: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(in_features, hidden), nn.ReLU(), nn.Linear(hidden, out_features)
        )

    def forward(self, feature: Tensor, class_id: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Scores of the four squared components (B, 4) and of the sign patterns (B, 8).

        Raises:
            ValueError: If there are several classes and no `class_id`.
        """
        feature = at_least_float32(feature)
        with full_precision(feature):
            size, sign = self.size(feature), self.sign(feature)
        return self._slice(size, class_id), self._slice(sign, class_id)

    def _slice(self, output: Tensor, class_id: Tensor | None) -> Tensor:
        if self.num_classes == 1:
            return output
        if class_id is None:
            raise ValueError(
                f"this head serves {self.num_classes} classes: give the index of each image's class"
            )
        rows = torch.arange(output.shape[0], device=output.device)
        return output.unflatten(1, (self.num_classes, -1))[rows, class_id]


def quaternion_size(scores: Tensor) -> Tensor:
    """|q| = √softmax of the scores: four numbers >= 0 with squares that sum to 1, (..., 4)."""
    # The small number keeps the root's gradient finite where a probability underflows.
    return (torch.softmax(scores, dim=-1) + 1e-12).sqrt()


def quaternion_sign_class(quaternion: Tensor) -> Tensor:
    """Number of the sign pattern of unit quaternions in the order (w, x, y, z) with w >= 0: (...,).

    Binary counting over (x, y, z), x first; a digit is 1 where the component is not negative. So 0
    stands for (−, −, −) and 7 for (+, +, +).
    """
    digits = (quaternion[..., 1:] >= 0).long()
    return 4 * digits[..., 0] + 2 * digits[..., 1] + digits[..., 2]


def quaternion_signs(sign_class: Tensor) -> Tensor:
    """Signs ±1 of (w, x, y, z) of pattern numbers (...,), w always +1: (..., 4), float32."""
    digits = torch.stack([sign_class // 4 % 2, sign_class // 2 % 2, sign_class % 2], dim=-1)
    return torch.nn.functional.pad(2.0 * digits - 1.0, (1, 0), value=1.0)


def rotation_from_size_and_sign(size: Tensor, sign_class: Tensor) -> Tensor:
    """The rotation of |q| (..., 4), order (w, x, y, z), and a sign pattern (...,): (..., 3, 3).

    `size` must have length 1. A number that is not finite gives a rotation that is not, as in the
    other heads; nothing waits for the device to look.
    """
    quaternion = size * quaternion_signs(sign_class).to(size.dtype)
    return roma.unitquat_to_rotmat(quaternion.roll(-1, dims=-1))


class InPlaneHead(nn.Module):
    """Turn about the camera's axis that follows the image when that is turned by 90°.

    A learned map from the spatial mean of the regular fields to the plane on which a quarter turn
    acts as one. With `z_c = (h_c0 − h_c2) + i (h_c1 − h_c3)` for field c, every such map is
    `u = Σ_c w_c z_c` with complex weights: two numbers for each field and no bias. The direction of
    u is the angle.

    Args:
        num_fields: Regular fields F.
        num_classes: Classes K; each has its own weights. A constant such as the index of the class
            cannot be added to u: it does not turn.

    Shape:
        (B, F, 4) and class indices (B,) or None -> (B, 3, 3).
    """

    def __init__(self, num_fields: int, *, num_classes: int = 1) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.weight = nn.Parameter(torch.empty(num_classes, num_fields, 2))
        # |w_c|² sums to 1 in expectation. Only the direction of u counts, so larger weights would
        # only learn more slowly.
        nn.init.normal_(self.weight, std=(2 * num_fields) ** -0.5)

    def forward(self, pooled: Tensor, class_id: Tensor | None = None) -> Tensor:
        """Rotations about z (B, 3, 3) of pooled regular fields (B, F, 4).

        Raises:
            ValueError: If there are several classes and no `class_id`.
        """
        if self.num_classes > 1 and class_id is None:
            raise ValueError(
                f"this head serves {self.num_classes} classes: give the index of each image's class"
            )
        pooled = at_least_float32(pooled)
        with full_precision(pooled):
            real, imaginary = pooled[..., 0] - pooled[..., 2], pooled[..., 1] - pooled[..., 3]
            weight = self.weight if self.num_classes == 1 else self.weight[class_id]
            a, b = weight[..., 0], weight[..., 1]
            u = torch.stack(
                [(a * real - b * imaginary).sum(-1), (a * imaginary + b * real).sum(-1)], dim=-1
            )
            return _turn_about_z(u)

    def extra_repr(self) -> str:
        """`38 fields, 1 class(es)`."""
        return f"{self.weight.shape[1]} fields, {self.num_classes} class(es)"


def _turn_about_z(u: Tensor) -> Tensor:
    """The turn that takes x to the direction of u (B, 2): (B, 3, 3); the identity where u is 0."""
    usable = u.detach().norm(dim=-1, keepdim=True) > _SMALLEST_NORM
    u = torch.where(usable, u, u.new_tensor([1.0, 0.0]))
    cos, sin = (u / u.norm(dim=-1, keepdim=True)).unbind(-1)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = [(cos, -sin, zero), (sin, cos, zero), (zero, zero, one)]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


ROTATION_HEADS = {"quaternion": QuaternionHead, "six": GramSchmidtHead}


def rotation_head(in_features: int, kind: str) -> nn.Module:
    """The last layer, from features to rotations, of a kind of `ROTATION_HEADS`.

    Raises:
        ValueError: If the kind is unknown.
    """
    if kind not in ROTATION_HEADS:
        known = ", ".join(ROTATION_HEADS)
        raise ValueError(f"representation={kind!r} is not known: choose one of {known}")
    return ROTATION_HEADS[kind](in_features)
