"""CNN+Proc: a plain ResNet regresses a 3×3 matrix, and the nearest rotation is taken."""

from functools import partial

from torch import nn

from i2i.models.pooled import Component, PooledPose
from i2i.nn.rotation_heads import ProcrustesHead


class ProcrustesPose(PooledPose):
    """Pose baseline CNN+Proc of the paper (Table 1); Brégier 2021.

    Args:
        encoder: See `PooledPose`; ResNet-18 in the paper.
        channels: Channels of the image.
        num_classes: Classes of the data, see `PooledPose`.
        image_size: Side of the image in pixels.
        loss: `"frobenius"` or `"mse"`.
        regularization: See `ProcrustesHead`.

    Raises:
        TypeError: If the encoder lacks an attribute.
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
        regularization: float = 0.0,
    ) -> None:
        super().__init__(
            encoder,
            partial(ProcrustesHead, regularization=regularization),
            channels=channels,
            num_classes=num_classes,
            image_size=image_size,
            loss=loss,
        )
