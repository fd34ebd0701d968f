"""EPN, the Equivariant Point Network: features on points × the 60 rotations of the icosahedron."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron, nearest_element
from i2i.models.pooled import append_class, class_size, known_class
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.nn.anchor_conv import AnchorNorm
from i2i.nn.anchor_trunk import (
    CLASS_WIDTHS,
    POSE_WIDTHS,
    AnchorTrunk,
    check_cloud_size,
    pose_layers,
)
from i2i.nn.heads import candidate_rotations, pose_target
from i2i.nn.losses import ClassifyThenRegressLoss, GroupTarget, group_target
from i2i.nn.precision import at_least_float32, full_precision
from i2i.nn.rotation_heads import rotation_head

SHARPNESS = 3.0  # the anchors' probabilities are softmax(3 · score)

Batch = Mapping[str, Tensor]


class EPNPose(nn.Module):
    """Rotation of a partial point cloud: a score and a residual for each of 60 anchors.

    Anchor R_a stands for the rotation `R_a @ Δ`, with the residual on the right. Of the view, its
    inverse, that is `Δᵀ @ R_aᵀ`: a residual on the left of group element g = a⁻¹, the convention of
    all networks here. So anchors are put into the order of their inverses and labels, losses and
    predictions are those of `I2IPose`.

    Args:
        num_points: Points of a cloud; others than these are taken as well.
        num_classes: Classes of the data; where there are several, the known one is appended to the
            feature before the last layers.
        width: Channels of the first layer.
        neighbours: See `AnchorTrunk`.
        representation: Of the residual: `"quaternion"`, or `"six"` numbers for Gram-Schmidt.
        regression_weight: λ of the residual term.
        reg_on: Which residuals are trained, see `ClassifyThenRegressLoss`.
        labels: `"hard"` or `"soft"`.
        squared: Square the residual's norm.
        checkpointing: See `AnchorPointConv`.

    Raises:
        ValueError: If a choice is unknown.

    Reference:
        Chen et al. 2021, "Equivariant Point Network for 3D Point Cloud Analysis".
    """

    elements: Tensor
    inverse: Tensor

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 32,
        neighbours: int = 64,
        representation: str = "quaternion",
        regression_weight: float = 10.0,
        reg_on: str = "sum_within_57deg",
        labels: str = "hard",
        squared: bool = True,
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        check_cloud_size(num_points)
        self.num_classes = num_classes
        self.trunk = AnchorTrunk(
            tuple(width * factor for factor in POSE_WIDTHS),
            neighbours=neighbours,
            checkpointing=checkpointing,
        )
        self.layers, features = pose_layers(8 * width)
        features += class_size(num_classes)
        self.score = nn.Linear(features, 1)
        self.residual = rotation_head(features, representation)
        # Of the sum 10·Σ over the anchors within 1 rad, three on average, `within_57deg` would take
        # the mean: 30 times that is as much.
        self.criterion = ClassifyThenRegressLoss(
            regression_weight=regression_weight, reg_on=reg_on, labels=labels, squared=squared
        )
        mesh = icosahedron(0)
        self.register_buffer("elements", mesh.rotations.float(), persistent=False)
        self.register_buffer("inverse", mesh.inverse, persistent=False)

    def anchor_features(self, points: Tensor) -> Tensor:
        """Features of each anchor: (B, N, 3) -> (B, 60, F), permuted when the cloud is turned."""
        features, _ = self.trunk(points)
        return at_least_float32(self.layers(features)).mean(dim=2)

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `points` (B, N, 3), and `class_id` (B,) where there are several classes."""
        features = self.anchor_features(batch["points"])[:, self.inverse]
        class_id = known_class(batch, self.num_classes)
        if class_id is not None:
            each = class_id.repeat_interleave(features.shape[1])
            flat = append_class(features.flatten(0, 1), each, self.num_classes)
            features = flat.unflatten(0, features.shape[:2])
        with full_precision(features):
            logits = SHARPNESS * self.score(features)[..., 0]
        residual = self.residual(features).mT
        candidates = candidate_rotations(residual, self.elements, "view")
        return PosePrediction.of_candidates(logits, candidates, residual=residual)

    def group_target(self, batch: Batch) -> GroupTarget:
        """The label of each sample: nearest element, angles and residuals of the view."""
        return group_target(pose_target(batch["rotation"], "view"), self.elements)

    def group_correct(self, prediction: PosePrediction, batch: Batch) -> Tensor:
        """Whether the best element is the one nearest to the view: (B,) bool."""
        assert prediction.logits is not None
        return prediction.logits.argmax(dim=1) == self.group_target(batch).element

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`classification` and `regression`, weighted, to be added up."""
        assert prediction.logits is not None
        return self.criterion(
            prediction.logits, prediction.extras["residual"], self.group_target(batch)
        )


@dataclass
class AttentionPrediction(ClassPrediction):
    """Class scores, and which anchor they were read from.

    Attributes:
        attention_logits: (B, 60), of the anchors in the order of the group.
    """

    attention_logits: Tensor


class EPNClassifier(nn.Module):
    """Class of a whole point cloud in any orientation.

    Each anchor has the maximum over the points of a feature that knows where they lie in its frame;
    the class is read from the mean of the anchors, weighted by an attention that learns to look at
    the anchor nearest to the cloud's rotation. For the 60 rotations of the group the result is
    invariant.

    Args:
        num_points: Points of a cloud; others than these are taken as well.
        num_classes: Classes of the data.
        width: Half the channels of the first layer.
        neighbours: See `AnchorTrunk`.
        attention_weight: Factor of the attention's cross-entropy.
        checkpointing: See `AnchorPointConv`.

    Reference:
        Chen et al. 2021, "Equivariant Point Network for 3D Point Cloud Analysis".
    """

    elements: Tensor

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 32,
        neighbours: int = 32,
        attention_weight: float = 1.0,
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        check_cloud_size(num_points)
        self.num_classes = num_classes
        self.attention_weight = attention_weight
        self.trunk = AnchorTrunk(
            tuple(width * factor for factor in CLASS_WIDTHS),
            neighbours=neighbours,
            norm="batch",
            checkpointing=checkpointing,
        )
        size = 8 * width
        self.layers = nn.Sequential(nn.Linear(size, size), AnchorNorm(size, "batch"), nn.ReLU())
        self.placed = nn.Linear(size + 3, size)
        self.norm = AnchorNorm(size, "batch")
        self.attention = nn.Linear(size, 1)
        self.classifier = nn.Linear(size, num_classes)
        elements = icosahedron(0).rotations.float()
        self.register_buffer("elements", elements, persistent=False)

    def anchor_features(self, points: Tensor) -> Tensor:
        """Features of each anchor: (B, N, 3) -> (B, 60, F), permuted when the cloud is turned."""
        features, centres = self.trunk(points)
        features = self.layers(features)
        with full_precision(centres):
            centred = centres - centres.mean(dim=1, keepdim=True)
            # (B, 60, P, 3): R_aᵀ x, where x stands on the left as a row.
            seen = centred[:, None] @ self.elements.to(centred.dtype)
        features = self.placed(torch.cat([features, seen.to(features.dtype)], dim=-1))
        features = features.amax(dim=2, keepdim=True)
        return at_least_float32(torch.relu(self.norm(features)))[:, :, 0]

    def forward(self, batch: Batch) -> AttentionPrediction:
        """Logits (B, C), descriptor (B, F) and attention for `points` (B, N, 3)."""
        features = self.anchor_features(batch["points"])
        with full_precision(features):
            attention = SHARPNESS * self.attention(features)[..., 0]
            descriptor = (attention.softmax(dim=1)[:, None] @ features)[:, 0]
            logits = self.classifier(descriptor)
        return AttentionPrediction(logits, descriptor, attention)

    def loss(self, prediction: AttentionPrediction, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropies with `class_id` (B,), and with the anchor nearest to `rotation`."""
        anchor, _ = nearest_element(batch["rotation"], self.elements)
        attention = nn.functional.cross_entropy(prediction.attention_logits, anchor)
        return {
            "classification": nn.functional.cross_entropy(prediction.logits, batch["class_id"]),
            "attention": self.attention_weight * attention,
        }
