"""Loss functions: classification over group elements, then regression of the residual rotation."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from i2i.nn.precision import full_precision

REG_ON = ("auto", "correct_only", "gt_always", "within_57deg", "sum_within_57deg")
LABELS = ("hard", "soft")
WITHIN_RAD = 1.0  # 57.3°: an element's neighbours are 72° away


@dataclass(frozen=True)
class GroupTarget:
    """A target rotation seen from every group element.

    Attributes:
        element: (B,) index of the nearest element.
        angle_rad: (B, K) angle to each element in radians.
        residual: (B, K, 3, 3): target = residual[:, k] @ elements[k].
    """

    element: Tensor
    angle_rad: Tensor
    residual: Tensor


def group_target(target: Tensor, elements: Tensor) -> GroupTarget:
    """Label `target` (B, 3, 3) by the elements (K, 3, 3): nearest, angles, residuals."""
    with full_precision(target):
        residual = target[:, None] @ elements.to(target).mT
    # ‖R − 1‖_F = 2√2 sin(angle/2): no cancellation at small angles.
    identity = torch.eye(3, dtype=target.dtype, device=target.device)
    chord = torch.linalg.vector_norm(residual - identity, dim=(-2, -1))
    angle = 2 * torch.asin((chord / 8**0.5).clamp(max=1.0))
    return GroupTarget(element=chord.argmin(dim=1), angle_rad=angle, residual=residual)


def rotation_distance(a: Tensor, b: Tensor, *, squared: bool = False) -> Tensor:
    """Frobenius norm of a − b over the last two axes, or its square: (...,)."""
    difference = a - b
    if squared:
        return difference.square().sum(dim=(-2, -1))
    return torch.linalg.vector_norm(difference, dim=(-2, -1))


class ClassifyThenRegressLoss(nn.Module):
    """Cross-entropy over the elements plus the distance of the residual rotation (paper §4.4).

    Args:
        regression_weight: λ (paper: 100).
        reg_on: Which elements' residuals are trained. `"correct_only"`: the predicted one where it
            is the nearest to the target; others count as 0 in the mean (paper). `"gt_always"`: the
            nearest one. `"within_57deg"`: all within 1 rad of the target, in equal parts, or
            weighted by the soft labels. `"sum_within_57deg"`: the same ones, each in full whatever
            the labels (EPN). `"auto"`: `correct_only` with hard labels, `within_57deg` with soft
            ones.
        labels: `"hard"`: the nearest element. `"soft"`: softmax(−(angle / soft_width_rad)²).
        soft_width_rad: Width of the soft labels in radians.
        squared: Square the norm (the paper does not).

    Raises:
        ValueError: If a choice is unknown.
    """

    def __init__(
        self,
        *,
        regression_weight: float = 100.0,
        reg_on: str = "auto",
        labels: str = "hard",
        soft_width_rad: float = 0.35,
        squared: bool = False,
    ) -> None:
        super().__init__()
        for name, value, allowed in (("reg_on", reg_on, REG_ON), ("labels", labels, LABELS)):
            if value not in allowed:
                raise ValueError(
                    f"{name}={value!r} is not known: choose one of {', '.join(allowed)}"
                )
        if reg_on == "auto":
            reg_on = "correct_only" if labels == "hard" else "within_57deg"
        self.regression_weight, self.reg_on, self.labels = regression_weight, reg_on, labels
        self.soft_width_rad, self.squared = soft_width_rad, squared

    def soft_labels(self, target: GroupTarget) -> Tensor:
        """Probabilities (B, K) that fall off with the angle."""
        return torch.softmax(-((target.angle_rad / self.soft_width_rad) ** 2), dim=1)

    def residual_weights(self, logits: Tensor, target: GroupTarget) -> Tensor:
        """How much each element's residual counts for each sample: (B, K)."""
        if self.reg_on in ("within_57deg", "sum_within_57deg"):
            near = (target.angle_rad < WITHIN_RAD).to(logits.dtype)
            if self.reg_on == "sum_within_57deg":
                return near
            if self.labels == "soft":
                return near * self.soft_labels(target).to(logits.dtype)
            # Every rotation is within 44.5° of an element, so the sum is never 0.
            return near / near.sum(dim=1, keepdim=True)
        chosen = nn.functional.one_hot(target.element, logits.shape[1]).to(logits.dtype)
        if self.reg_on == "gt_always":
            return chosen
        # A product instead of a selection: nothing waits for the device.
        correct = logits.argmax(dim=1) == target.element
        return chosen * correct[:, None]

    def forward(self, logits: Tensor, residual: Tensor, target: GroupTarget) -> dict[str, Tensor]:
        """The two terms, already weighted.

        Args:
            logits: (B, K).
            residual: (B, K, 3, 3) predicted residual rotations.
            target: From `group_target`.

        Returns:
            `classification` and `regression`, scalars.
        """
        labels = target.element if self.labels == "hard" else self.soft_labels(target)
        distance = rotation_distance(residual, target.residual, squared=self.squared)
        weighted = self.residual_weights(logits, target).detach() * distance
        return {
            "classification": nn.functional.cross_entropy(logits, labels),
            "regression": self.regression_weight * weighted.sum(dim=1).mean(),
        }

    def extra_repr(self) -> str:
        """The settings."""
        return f"λ={self.regression_weight:g}, reg_on={self.reg_on}, labels={self.labels}"
