"""EMVN: group convolutions over the views of an object."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from i2i.models.pooled import Component
from i2i.models.prediction import ClassPrediction
from i2i.models.views import ViewFeatures, camera_set_of
from i2i.nn.batch_norm import JointBatchNorm1d
from i2i.nn.precision import at_least_float32
from i2i.nn.view_convs import GroupConv, TappedConv, ViewsToGroup

POOLINGS = ("max", "mean")


class EMVN(nn.Module):
    """Multi-view classification baseline EMVN of the paper (Table 3).

    A ResNet for each view and a linear layer, group convolutions with batch norm and ReLU, the
    first from the cameras to the 60 rotations, and the largest value over the rotations, which is
    the descriptor. A permutation of the views by the group changes neither descriptor nor logits.
    The views of a turned object are such a permutation up to camera rolls; those are shifts of
    log-polar pictures, to which the average over the map is blind: exactly where they are by whole
    cells of the map, roughly where the trunk's strides put them in between. With 60 views the rolls
    are among the cameras, the permutation is exact, and pictures may stay as they are.

    The biases before a batch norm (of the linear layer and of the convolutions) have no effect;
    they are there because the published network has them, and start at zero.

    Args:
        trunk: See `ViewFeatures`; a ResNet-18 in the original.
        channels: Channels of a view, 1 or 3.
        num_classes: Number of classes.
        image_size: Side of a view in pixels.
        num_views: 12, 20 or 60; says which cameras they are.
        features: Width of the linear layer and of the group convolutions (original: 512).
        layers: Group convolutions, at least 1.
        log_polar: Whether views are in log-polar coordinates.
        pooling: Over the rotations: `"max"` or `"mean"`.
        pretrained: A weight file for the trunk; None starts from scratch.

    Raises:
        ValueError: If the pooling or the number of views or layers is another, or the weights do
            not fit.

    Reference:
        Esteves et al. 2019, "Equivariant Multi-View Networks".
    """

    def __init__(
        self,
        trunk: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        num_views: int,
        features: int = 512,
        layers: int = 3,
        log_polar: bool = True,
        pooling: str = "max",
        pretrained: str | Path | None = None,
    ) -> None:
        super().__init__()
        if pooling not in POOLINGS:
            raise ValueError(f"pooling={pooling!r} is not known: choose one of max, mean")
        if layers < 1:
            raise ValueError(f"layers={layers}: views reach the rotations by at least 1 layer")
        self.pooling = pooling
        cameras = camera_set_of(num_views)
        self.views = ViewFeatures(
            trunk, channels=channels, image_size=image_size, num_views=num_views,
            log_polar=log_polar, pretrained=pretrained,
        )  # fmt: skip
        self.embed = nn.Linear(self.views.out_channels, features)
        nn.init.zeros_(self.embed.bias)
        first: TappedConv
        if cameras == "group_60":
            first = GroupConv(features, features)
        else:
            first = ViewsToGroup(features, features, camera_set=cameras)
        others = (GroupConv(features, features) for _ in range(layers - 1))
        self.convs = nn.ModuleList([first, *others])
        self.norms = nn.ModuleList(JointBatchNorm1d(features) for _ in range(layers))
        self.classifier = nn.Linear(features, num_classes)

    def descriptor(self, feature: Tensor) -> Tensor:
        """From the trunk's features of the views to one vector: (B, V, F) -> (B, features)."""
        x = self.embed(feature)
        for conv, norm in zip(self.convs, self.norms, strict=True):
            # (B, 60, C): batch and rotations share the statistics of a channel.
            x = torch.relu(norm(conv(x).transpose(1, 2)).transpose(1, 2))
        x = at_least_float32(x)
        return x.amax(dim=1) if self.pooling == "max" else x.mean(dim=1)

    def forward(self, batch: Mapping[str, Tensor]) -> ClassPrediction:
        """Logits (B, K) and descriptor (B, features) for `views` (B, V, C, S, S)."""
        descriptor = self.descriptor(self.views(batch["views"]))
        logits = at_least_float32(self.classifier(descriptor))
        return ClassPrediction(logits=logits, descriptor=descriptor)

    def loss(self, prediction: ClassPrediction, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Cross-entropy with `class_id` (B,)."""
        loss = nn.functional.cross_entropy(prediction.logits, batch["class_id"])
        return {"classification": loss}

    def extra_repr(self) -> str:
        """The pooling."""
        return f"{self.pooling} over I60"
