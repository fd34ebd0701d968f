"""CNN+GS: a plain ResNet regresses six numbers, Gram-Schmidt makes them a rotation."""

from torch import nn

from i2i.models.pooled import Component, PooledPose
from i2i.nn.rotation_heads import GramSchmidtHead


class GramSchmidtPose(PooledPose):
    """Pose baseline CNN+GS of the paper (Table 1); Zhou et al. 2019.

    Args:
        encoder: See `PooledPose`; ResNet-18 in the paper.
        channels: Channels of the image.
        num_classes: Classes of the data, see `PooledPose`.
        image_size: Side of the image in pixels.
        loss: `"frobenius"` or `"mse"`.

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
    ) -> None:
        super().__init__(
            encoder,
            GramSchmidtHead,
            channels=channels,
            num_classes=num_classes,
            image_size=image_size,
            loss=loss,
        )
