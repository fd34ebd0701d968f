"""E2CNN-Eq: an in-plane angle that turns with the image times a rotation that does not."""

from torch import Tensor, nn

from i2i.models.pooled import (
    Batch,
    Component,
    RotationLoss,
    append_class,
    check_regular,
    class_size,
    known_class,
    make_encoder,
    pool_regular,
)
from i2i.models.prediction import PosePrediction
from i2i.nn.precision import full_precision
from i2i.nn.rotation_heads import GramSchmidtHead, InPlaneHead


class InPlanePose(nn.Module):
    """Pose baseline E2CNN-Eq of the paper (Table 1).

    From the regular fields of a C4 encoder one branch reads an angle about the camera's axis that
    grows by 90° when the image turns by 90°, the other a rotation that stays. The prediction is
    `in_plane @ out_of_plane`, so it turns with the image, exactly where the encoder does (every
    `stem_mode` but `ref`).

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready;
            it must have `regular_map`, as `C4ResNet18` has.
        channels: Channels of the image.
        num_classes: Classes K of the data. With several, the invariant branch sees the known class
            as a one-hot vector and the other has its own weights for each.
        image_size: Side of the image in pixels.
        loss: `"frobenius"` or `"mse"`.

    Raises:
        TypeError: If the encoder lacks an attribute or gives no regular fields.
        ValueError: If the loss is unknown.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        loss: str = "frobenius",
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.criterion = RotationLoss(loss)
        self.encoder, fields = make_encoder(encoder, channels=channels, image_size=image_size)
        check_regular(self.encoder)
        self.in_plane = InPlaneHead(fields, num_classes=num_classes)
        self.out_of_plane = GramSchmidtHead(fields + class_size(num_classes))

    def claims(self) -> list[tuple[str, str, str]]:
        """The whole network turns with the image, for `python -m i2i.check`."""
        return [("", "map", "rotation")]

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `image` (B, C, S, S), and `class_id` (B,) where there are several classes.

        `extras` has the factors `in_plane` and `out_of_plane`, (B, 3, 3) each.
        """
        class_id = known_class(batch, self.num_classes)
        pooled = pool_regular(self.encoder.regular_map(batch["image"]))  # type: ignore[operator]
        in_plane = self.in_plane(pooled, class_id)
        # The largest of the four turns does not change when they change places.
        invariant = append_class(pooled.amax(dim=2), class_id, self.num_classes)
        out_of_plane = self.out_of_plane(invariant)
        with full_precision(in_plane):
            rotation = in_plane @ out_of_plane
        return PosePrediction(
            rotation=rotation, extras={"in_plane": in_plane, "out_of_plane": out_of_plane}
        )

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`regression`: the distance of the rotations."""
        return {"regression": self.criterion(prediction.rotation, batch["rotation"])}
