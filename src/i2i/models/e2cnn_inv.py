"""E2CNN-Inv: a C4-equivariant ResNet, made invariant to quarter turns, with a linear classifier."""

from torch import Tensor, nn

from i2i.models.pooled import Component, FeatureClassifier, check_regular, pool, pool_regular
from i2i.nn.c4 import group_max_pool

ORDERS = ("mean_then_max", "max_then_mean")


class InvariantClassifier(FeatureClassifier):
    """Classification baseline E2CNN-Inv of the paper (Table 3).

    A turn of the image by 90° changes neither logits nor descriptor, exactly where the encoder is
    exactly equivariant (every `stem_mode` but `ref`).

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready;
            it must have `regular_map`, as `C4ResNet18` has.
        channels: Channels of the image.
        num_classes: Number of classes.
        image_size: Side of the image in pixels.
        order: `"mean_then_max"`: the spatial mean, then the largest of the four turns (one turn
            for the whole image); `"max_then_mean"`: the largest at every place, then the mean.

    Raises:
        TypeError: If the encoder lacks an attribute or gives no regular fields.
        ValueError: If the order is unknown.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        order: str = "mean_then_max",
    ) -> None:
        if order not in ORDERS:
            raise ValueError(f"order={order!r} is not known: choose one of {', '.join(ORDERS)}")
        super().__init__(encoder, channels=channels, num_classes=num_classes, image_size=image_size)
        check_regular(self.encoder)
        self.order = order

    def claims(self) -> list[tuple[str, str, str]]:
        """The whole network ignores quarter turns, for `python -m i2i.check`."""
        return [("", "map", "invariant")]

    def feature(self, image: Tensor) -> Tensor:
        """One invariant number for each field: (B, channels, S, S) -> (B, F)."""
        regular = self.encoder.regular_map(image)  # type: ignore[operator]
        if self.order == "mean_then_max":
            return pool_regular(regular).amax(dim=2)
        return pool(group_max_pool(regular))

    def extra_repr(self) -> str:
        """The order."""
        return self.order
