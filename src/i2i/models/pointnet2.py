"""PointNet++: a class from a point cloud, with single-scale grouping."""

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor, nn

from i2i.models.prediction import ClassPrediction
from i2i.nn.point_sets import SetAbstraction, SharedMLP
from i2i.nn.precision import at_least_float32


class PointNet2Classifier(nn.Module):
    """Point-cloud classification baseline PointNet++ of the paper (Table 3).

    Two set abstractions to a half and an eighth of the points, a maximum over all, a classifier of
    three layers. The descriptor is what the last layer sees.

    Args:
        num_points: Points N of a cloud; larger clouds are thinned to the same N/2 centres.
        num_classes: Number of classes C.
        width: Channels of the first layer.
        radii: Of the neighbourhoods of both abstractions, in radii of the cloud.
        neighbours: How many points of a neighbourhood are looked at.
        nearest: See `SetAbstraction`; False as in the original.
        random_start: See `SetAbstraction`; True as in the original.
        dropout: After both hidden layers of the classifier.

    Raises:
        ValueError: If there are fewer than 8 points.

    Reference:
        Qi et al. 2017, "PointNet++: Deep Hierarchical Feature Learning on Point Sets in a Metric
        Space".
    """

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 64,
        radii: tuple[float, float] = (0.2, 0.4),
        neighbours: tuple[int, int] = (32, 64),
        nearest: bool = False,
        random_start: bool = True,
        dropout: float = 0.4,
    ) -> None:
        super().__init__()
        if num_points < 8:
            raise ValueError(f"num_points={num_points}: PointNet++ needs at least 8 points")
        w, layer = width, partial(SetAbstraction, nearest=nearest, random_start=random_start)
        self.fine = layer(
            0, (w, w, 2 * w), centres=num_points // 2, radius=radii[0], neighbours=neighbours[0]
        )
        self.coarse = layer(
            2 * w, (2 * w, 2 * w, 4 * w), centres=num_points // 8, radius=radii[1],
            neighbours=neighbours[1],
        )  # fmt: skip
        self.whole = SharedMLP(3 + 4 * w, (4 * w, 8 * w, 16 * w))
        self.hidden = SharedMLP(16 * w, (8 * w, 4 * w), dropout=dropout)
        self.classifier = nn.Linear(4 * w, num_classes)

    def forward(self, batch: Mapping[str, Tensor]) -> ClassPrediction:
        """Logits (B, C) and descriptor (B, F) for `points` (B, N, 3)."""
        points, feature = self.fine(batch["points"], None)
        points, feature = self.coarse(points, feature)
        whole = self.whole(torch.cat([points, feature.to(points)], dim=-1)).max(dim=1).values
        descriptor = self.hidden(whole)
        logits = self.classifier(descriptor)
        return ClassPrediction(
            logits=at_least_float32(logits), descriptor=at_least_float32(descriptor)
        )

    def loss(self, prediction: ClassPrediction, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Cross-entropy with `class_id` (B,)."""
        loss = nn.functional.cross_entropy(prediction.logits, batch["class_id"])
        return {"classification": loss}
