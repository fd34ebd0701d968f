"""CNN+IER: CNN+GS whose six numbers are corrected twice before Gram-Schmidt."""

from functools import partial

from torch import nn

from i2i.models.pooled import Component, PooledPose
from i2i.nn.rotation_heads import RefinementHead


class RefinementPose(PooledPose):
    """Pose baseline CNN+IER of the paper (Table 1), after EfficientPose.

    Args:
        encoder: See `PooledPose`; ResNet-18 in the paper.
        channels: Channels of the image.
        num_classes: Classes of the data, see `PooledPose`.
        image_size: Side of the image in pixels.
        loss: `"frobenius"` or `"mse"`, of the last rotation only.
        hidden: Hidden units of a correction; 256 give the paper's parameter count.
        iterations: Number of corrections.

    Raises:
        TypeError: If the encoder lacks an attribute.
        ValueError: If the loss is unknown, or `hidden` or `iterations` is less than 1.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        loss: str = "frobenius",
        hidden: int = 256,
        iterations: int = 2,
    ) -> None:
        super().__init__(
            encoder,
            partial(RefinementHead, hidden=hidden, iterations=iterations),
            channels=channels,
            num_classes=num_classes,
            image_size=image_size,
            loss=loss,
        )
