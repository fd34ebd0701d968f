"""PointNet++: features of growing neighbourhoods, each by a shared MLP and a maximum."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from i2i.geometry.points import ball_query, farthest_point_sample, gather_points
from i2i.nn.batch_norm import JointBatchNorm1d
from i2i.nn.processes import num_processes


class RowNorm(JointBatchNorm1d):
    """Batch norm of rows (N, C) which takes a single one too, even in training.

    One row has no variance of its own; the running statistics stand in for it.
    """

    def forward(self, rows: Tensor) -> Tensor:
        """(N, C) -> (N, C)."""
        if self.training and len(rows) == 1 and num_processes() == 1:
            return nn.functional.batch_norm(
                rows, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        return super().forward(rows)


class SharedMLP(nn.Sequential):
    """Linear layers with batch norm and ReLU, the same for all points: (..., C) -> (..., W).

    Args:
        in_channels: C.
        widths: Outputs of the layers; the last is W.
        dropout: After each layer.
    """

    def __init__(self, in_channels: int, widths: Sequence[int], *, dropout: float = 0.0) -> None:
        layers: list[nn.Module] = []
        for width in widths:
            layers += [nn.Linear(in_channels, width), RowNorm(width), nn.ReLU(inplace=True)]
            layers += [nn.Dropout(dropout)] if dropout else []
            in_channels = width
        super().__init__(*layers)

    def forward(self, features: Tensor) -> Tensor:
        """Apply to every row."""
        rows: Tensor = super().forward(features.flatten(0, -2))
        return rows.view(*features.shape[:-1], -1)


class SetAbstraction(nn.Module):
    """Fewer points, each with a feature of its neighbourhood.

    Farthest points become centres. The MLP sees each neighbour's feature and its place relative to
    the centre; the largest response of a channel is the centre's.

    Args:
        in_channels: Features C of a point beside its coordinates; 0 for none.
        widths: Of the MLP; the last is W.
        centres: How many points M remain.
        radius: Of a neighbourhood.
        neighbours: How many points of it are looked at.
        nearest: Of more, look at the nearest, and not at the first in the order of the cloud: then
            the result depends on that order only by rounding.
        random_start: In training the first centre is any point, and not the one farthest from the
            mean, which it always is in evaluation.
    """

    def __init__(
        self,
        in_channels: int,
        widths: Sequence[int],
        *,
        centres: int,
        radius: float,
        neighbours: int,
        nearest: bool = False,
        random_start: bool = True,
    ) -> None:
        super().__init__()
        self.centres, self.radius = centres, radius
        self.neighbours, self.nearest, self.random_start = neighbours, nearest, random_start
        self.mlp = SharedMLP(3 + in_channels, widths)

    def forward(self, points: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """Centres (B, M, 3) and features (B, M, W) of points (B, N, 3) and features (B, N, C).

        Raises:
            ValueError: If there are fewer points than centres.
        """
        start = None
        if self.training and self.random_start:
            start = torch.randint(points.shape[1], (len(points),), device=points.device)
        centres = gather_points(points, farthest_point_sample(points, self.centres, start=start))
        index = ball_query(
            centres, points, radius=self.radius, count=self.neighbours, nearest=self.nearest
        )
        inputs = gather_points(points, index) - centres[:, :, None]  # (B, M, neighbours, 3)
        if features is not None:
            inputs = torch.cat([inputs, gather_points(features, index).to(inputs)], dim=-1)
        return centres, self.mlp(inputs).max(dim=2).values

    def extra_repr(self) -> str:
        """What a neighbourhood is."""
        which = "nearest" if self.nearest else "first"
        return f"{self.centres} centres, the {which} {self.neighbours} within {self.radius:g}"
