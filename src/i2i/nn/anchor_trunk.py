"""The trunk of EPN, from points to features of anchors, and the ends of its pose networks."""

from itertools import pairwise

from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.points import farthest_point_sample, gather_points
from i2i.nn.anchor_conv import SeparableLayer
from i2i.nn.precision import at_least_float32

POSE_WIDTHS = (1, 1, 2, 2, 4, 4, 8)  # times the width
CLASS_WIDTHS = (2, 2, 4, 4, 8, 8, 8)
RADII = tuple(0.2 * 2 ** (k / 2) for k in (0, 1, 2, 2, 3, 3, 4))
STRIDES = (2, 1, 2, 1, 2, 1, 2)

_TABLE_POINTS = 1024  # of the clouds for which the original's numbers of neighbours are meant
_LEAST_NEIGHBOURS = 8
_LEAST_POINTS = 2**5  # two are left of them after the four strides
_LEAST_CHANNELS = 16


class AnchorTrunk(nn.Module):
    """Seven layers from points to features on 1/16 of them × anchors.

    The points are first put into the order of farthest-point sampling: each layer's centres are the
    first half of its points, the neighbours that count are well spread ones, and the result does
    not depend on the order in which the points came.

    Args:
        widths: Channels of the seven layers.
        neighbours: Of a strided layer's ball, in clouds of 1,024 points; the others have half.
            Smaller clouds have fewer in proportion, but 8 at least where there are so many.
        separable: False: a single anchor, the identity, no group convolution and no shortcut.
        norm: See `SeparableLayer`.
        checkpointing: See `AnchorPointConv`.

    Shape:
        (B, N, 3), N >= 32 -> features (B, A, N // 16, C) and the points they belong to
        (B, N // 16, 3).
    """

    def __init__(
        self,
        widths: tuple[int, ...],
        *,
        neighbours: int,
        separable: bool = True,
        norm: str = "instance",
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        rotations = icosahedron(0).rotations
        self.layers = nn.ModuleList(
            SeparableLayer(
                in_channels,
                out_channels,
                radius=radius,
                stride=stride,
                anchors=rotations if separable else rotations[:1],
                norm=norm,
                separable=separable,
                checkpointing=checkpointing,
            )
            for in_channels, out_channels, radius, stride in zip(
                (1, *widths[:-1]), widths, RADII, STRIDES, strict=True
            )
        )
        self.neighbours = neighbours

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Features and points, see the class.

        Raises:
            ValueError: If the cloud is too small.
        """
        size = points.shape[1]
        check_cloud_size(size)
        points = at_least_float32(points)
        points = gather_points(points, farthest_point_sample(points, size))
        features = None
        for layer in self.layers:
            share = self.neighbours * size // (_TABLE_POINTS * (2 if layer.stride == 1 else 1))
            features = layer(features, points, max(_LEAST_NEIGHBOURS, share))
            points = points[:, : features.shape[2]]
        assert features is not None
        return features, points


def check_cloud_size(num_points: int) -> None:
    """Refuse clouds of which the strides would leave nothing.

    Raises:
        ValueError: with the setting and the least number.
    """
    if num_points < _LEAST_POINTS:
        raise ValueError(f"data.num_points={num_points}: this network needs {_LEAST_POINTS}")


def pose_layers(width: int) -> tuple[nn.Sequential, int]:
    """Three 1×1 convolutions with ReLU, from C to C, C/2 and C/4 channels, and that last number.

    None has fewer than 16 outputs: so few may all be silenced by the ReLU.
    """
    layers, sizes = nn.Sequential(), [max(_LEAST_CHANNELS, width // k) for k in (1, 2, 4)]
    for size, following in pairwise([width, *sizes]):
        layers.extend([nn.Linear(size, following), nn.ReLU()])
    return layers, sizes[-1]
