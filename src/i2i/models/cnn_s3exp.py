"""CNN+S3exp: the size of a quaternion's components by regression, their signs by classification."""

import torch
from torch import Tensor, nn

from i2i.geometry.rotations import quaternion_wxyz_from_rotation
from i2i.models.pooled import Batch, Component, known_class, make_encoder, pool
from i2i.models.prediction import PosePrediction
from i2i.nn.rotation_heads import (
    SphericalHead,
    quaternion_sign_class,
    quaternion_size,
    rotation_from_size_and_sign,
)


class SphericalPose(nn.Module):
    """Pose baseline CNN+S3exp of the paper (Table 1); Liao et al. 2019.

    Of the quaternions q and −q the one with w >= 0 is taken. What is left are the sizes of four
    components, on the positive part of the 3-sphere, and eight patterns of signs of (x, y, z).

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready;
            ResNet-50 in the paper.
        channels: Channels of the image.
        num_classes: Classes of the data; each has its own slice of both heads, chosen by
            `class_id`.
        image_size: Side of the image in pixels.
        hidden: Hidden units of each head; 996 give the paper's parameter count.
        size_weight: Weight of the sizes' term beside the signs' cross-entropy.
        head_std: Standard deviation of the heads' initial weights.

    Raises:
        TypeError: If the encoder lacks an attribute.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        hidden: int = 996,
        size_weight: float = 10.0,
        head_std: float = 0.005,
    ) -> None:
        super().__init__()
        self.num_classes, self.size_weight = num_classes, size_weight
        self.encoder, size = make_encoder(encoder, channels=channels, image_size=image_size)
        self.head = SphericalHead(size, hidden=hidden, num_classes=num_classes, std=head_std)

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `image` (B, C, S, S), and `class_id` (B,) where there are several classes.

        `extras` has `quaternion_size` (B, 4), in the order (w, x, y, z), and `sign_logits` (B, 8).
        """
        class_id = known_class(batch, self.num_classes)
        scores, sign_logits = self.head(pool(self.encoder(batch["image"])), class_id)
        size = quaternion_size(scores)
        return PosePrediction(
            rotation=rotation_from_size_and_sign(size, sign_logits.argmax(dim=1)),
            extras={"quaternion_size": size, "sign_logits": sign_logits},
        )

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`size`: weight · mean(1 − cos) of the sizes; `sign`: cross-entropy of the pattern."""
        target = quaternion_wxyz_from_rotation(batch["rotation"])
        size = prediction.extras["quaternion_size"]
        cosine = torch.cosine_similarity(size, target.abs().to(size.dtype), dim=1)
        sign = nn.functional.cross_entropy(
            prediction.extras["sign_logits"], quaternion_sign_class(target)
        )
        return {"size": self.size_weight * (1 - cosine).mean(), "sign": sign}

    def extra_repr(self) -> str:
        """The weight of the sizes' term."""
        return f"size_weight={self.size_weight:g}"
