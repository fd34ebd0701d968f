"""KPConv for pose, candidate (A): EPN's network with a single anchor.

The paper does not say which network its KPConv row of Table 1 is. EPN's own project makes one by
leaving out the rotations, so the row most likely comes from there.
"""

from collections.abc import Mapping

from torch import Tensor, nn

from i2i.models.pooled import RotationLoss, append_class, class_size, known_class
from i2i.models.prediction import PosePrediction
from i2i.nn.anchor_trunk import (
    POSE_WIDTHS,
    AnchorTrunk,
    check_cloud_size,
    pose_layers,
)
from i2i.nn.precision import at_least_float32
from i2i.nn.rotation_heads import rotation_head

Batch = Mapping[str, Tensor]


class SingleAnchorPose(nn.Module):
    """Pose baseline KPConv (A): EPN's pose network with one anchor, which knows no rotations.

    The kernel points stay where they are, there is no group convolution and no shortcut; the mean
    over the points goes to one rotation.

    Args:
        num_points: Points of a cloud; others than these are taken as well.
        num_classes: See `EPNPose`.
        width: Channels of the first layer.
        neighbours: See `AnchorTrunk`.
        representation: `"quaternion"`, or `"six"` numbers for Gram-Schmidt.
        loss: `"mse"` or `"frobenius"`, see `RotationLoss`.
        loss_weight: Factor of the loss.
        checkpointing: See `AnchorPointConv`.

    Raises:
        ValueError: If a choice is unknown.
    """

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 32,
        neighbours: int = 64,
        representation: str = "quaternion",
        loss: str = "mse",
        loss_weight: float = 10.0,
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        check_cloud_size(num_points)
        self.num_classes = num_classes
        self.trunk = AnchorTrunk(
            tuple(width * factor for factor in POSE_WIDTHS),
            neighbours=neighbours,
            separable=False,
            checkpointing=checkpointing,
        )
        self.layers, features = pose_layers(8 * width)
        self.head = rotation_head(features + class_size(num_classes), representation)
        self.criterion, self.loss_weight = RotationLoss(loss), loss_weight

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `points` (B, N, 3), and `class_id` (B,) where there are several classes."""
        class_id = known_class(batch, self.num_classes)
        features, _ = self.trunk(batch["points"])
        pooled = at_least_float32(self.layers(features)).mean(dim=(1, 2))
        return PosePrediction(rotation=self.head(append_class(pooled, class_id, self.num_classes)))

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`regression`: the weighted distance of the rotations."""
        distance = self.criterion(prediction.rotation, batch["rotation"])
        return {"regression": self.loss_weight * distance}
