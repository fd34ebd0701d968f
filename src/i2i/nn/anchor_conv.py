"""Convolutions of point clouds whose features live on points × rotations ("anchors").

Features are (B, A, P, C): each of the A anchors sees the cloud with its kernel turned by its own
rotation. With the 60 rotations of the icosahedron as anchors the layers commute with them: for h of
the group, a cloud turned by h has the features `f'(h·x, h·g) = f(x, g)`.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.points import ball_query, gather_points
from i2i.nn.batch_norm import JointBatchNorm1d
from i2i.nn.kernel_points import kernel_points
from i2i.nn.precision import at_least_float32, full_precision

NORMS = ("instance", "batch")
SLOPE = 0.01  # of the leaky ReLU
KERNEL_POINTS = 24
_SHELL = 0.7  # radius of the kernel's sphere, of the ball's
_EPS = 1e-5  # of the norms
_CHUNK = 1 << 22  # numbers that a chunk holds at a time: a few MB, which stay in the cache
_KEPT = 1 << 26  # numbers of a layer, 256 MB, that are kept for the backward pass if nobody says


def neighbourhood(
    points: Tensor, centres: int, *, radius: float, count: int
) -> tuple[Tensor, Tensor]:
    """The neighbours of the first points of clouds (B, N, 3), among all of them.

    Args:
        points: Shape (B, N, 3).
        centres: How many points P, from the first on, are centres.
        radius: Of the ball.
        count: How many neighbours J, see `ball_query`; at most the N there are.

    Returns:
        Indices (B, P, J) and offsets from the centre (B, P, J, 3), both without gradient.
    """
    with torch.no_grad(), full_precision(points):
        middle = points[:, :centres]
        index = ball_query(middle, points, radius=radius, count=min(count, points.shape[1]))
        return index, gather_points(points, index) - middle[:, :, None]


class AnchorPointConv(nn.Module):
    """Kernel-point convolution, with the kernel turned by each anchor.

    `out(x, a) = Σ_k W_k Σ_j relu(1 − |x_j − x − R_a κ_k|² / σ) f(x_j, a)`, j over the neighbours of
    x, σ = radius² / 2, κ one point at the centre and the others at 0.7 radii. There is no bias and
    no division by the number of neighbours.

    Weights and gathered features of all anchors at once would be 60 times those of a plain
    point convolution, so anchors are done in chunks, of which nothing needs to be kept for the
    backward pass: it can compute them again.

    Args:
        in_channels: C of the features; a network's first layer has 1.
        out_channels: O.
        radius: Of the ball in which the neighbours lie.
        anchors: Rotations (A, 3, 3).
        kernel_size: Kernel points K.
        checkpointing: Keep nothing for the backward pass; None: where it would be 256 MB or more.

    Shape:
        Features (B, A, N, C), or None for all 1; index (B, P, J) and offset (B, P, J, 3) from
        `neighbourhood` -> (B, A, P, O).

    Reference:
        Chen et al. 2021, "Equivariant Point Network for 3D Point Cloud Analysis".

    Example:
        >>> conv = AnchorPointConv(1, 4, radius=0.5, anchors=torch.eye(3)[None])
        >>> conv(None, *neighbourhood(torch.rand(2, 9, 3), 5, radius=0.5, count=3)).shape
        torch.Size([2, 1, 5, 4])
    """

    kernel: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        radius: float,
        anchors: Tensor,
        kernel_size: int = KERNEL_POINTS,
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        self.radius, self.checkpointing = radius, checkpointing
        kernel = turned_kernel(anchors, radius=radius, size=kernel_size).float()
        self.register_buffer("kernel", kernel, persistent=False)
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, kernel_size))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Xavier's normal rule with the gain of a ReLU."""
        nn.init.xavier_normal_(self.weight, gain=math.sqrt(2))

    def forward(self, features: Tensor | None, index: Tensor, offset: Tensor) -> Tensor:
        """Convolve, see the class.

        Raises:
            ValueError: If features are missing and the layer wants more than one channel.
        """
        matrix = self.weight.permute(2, 1, 0).flatten(0, 1)  # (K·C, O)
        offset = at_least_float32(offset)
        ones = torch.ones_like(offset[..., :1])
        moments = torch.cat([offset, offset.square().sum(dim=-1, keepdim=True), ones], dim=-1)
        per_anchor = offset[..., 0].numel() * max(self.weight.shape[1:])
        kernels = self.kernel.to(offset.dtype).split(max(1, _CHUNK // per_anchor))
        if features is None:
            if self.weight.shape[1] != 1:
                raise ValueError(f"a layer of {self.weight.shape[1]} channels needs features")
            # Nothing before this layer is learned: the sums over neighbours are constants.
            with torch.no_grad():
                sums = [influence(moments, kernel).sum(dim=3) for kernel in kernels]
            return torch.cat(sums, dim=1).to(matrix.dtype) @ matrix
        parts = features.split([len(kernel) for kernel in kernels], dim=1)
        run = _runner(self.checkpointing, per_anchor * len(self.kernel))
        chunks = [
            run(_convolve, part, index, moments, kernel, matrix)
            for part, kernel in zip(parts, kernels, strict=True)
        ]
        return torch.cat(chunks, dim=1)

    def extra_repr(self) -> str:
        """Channels, radius, anchors."""
        out_channels, in_channels, size = self.weight.shape
        return (
            f"{in_channels}, {out_channels}, radius={self.radius:.3g}, "
            f"kernel_size={size}, anchors={len(self.kernel)}"
        )


def turned_kernel(anchors: Tensor, *, radius: float, size: int = KERNEL_POINTS) -> Tensor:
    """What `influence` multiplies the moments of offsets with, for each anchor: (A, 5, K), float64.

    With the moments (x, |x|², 1) of an offset the product is `1 − |x − R_a κ_k|² / σ`.
    """
    points, sigma = kernel_points(size, _SHELL * radius), radius**2 / 2
    last = (1 - points.square().sum(dim=1) / sigma).expand(len(anchors), 1, -1)
    turned = anchors.double() @ points.T
    return torch.cat([2 / sigma * turned, torch.full_like(last, -1 / sigma), last], dim=1)


def influence(moments: Tensor, kernel: Tensor) -> Tensor:
    """Weight of each neighbour for each kernel point: (B, P, J, 5), (S, 5, K) -> (B, S, P, J, K).

    The moments are (x, |x|², 1) of an offset x.
    """
    with full_precision(moments):
        weights = moments.flatten(1, 2)[:, None] @ kernel
    return weights.relu_().unflatten(2, moments.shape[1:3])


def _convolve(
    features: Tensor, index: Tensor, moments: Tensor, kernel: Tensor, matrix: Tensor
) -> Tensor:
    """`AnchorPointConv` for some of the anchors: (B, S, N, C) -> (B, S, P, O)."""
    batch, anchors = features.shape[:2]
    with torch.no_grad():
        weights = influence(moments, kernel).to(features.dtype)
    tiled = index[:, None].expand(-1, anchors, -1, -1).flatten(0, 1)  # (B·S, P, J)
    gathered = gather_points(features.flatten(0, 1), tiled)
    mixed = weights.flatten(0, 1).mT @ gathered  # (B·S, P, K, C)
    return (mixed.flatten(2) @ matrix).unflatten(0, (batch, anchors))


class AnchorGroupConv(nn.Module):
    """Convolution over the icosahedral group at each point.

    `out(x, g) = Σ_k W_k f(x, g·r_k)` with the 12 elements r_k of `group_taps`, no bias. They stand
    on the right, where they do not meet a rotation of the cloud, which multiplies from the left.

    Args:
        channels: C of the features and of the output.
        checkpointing: See `AnchorPointConv`; of 12 copies of the features.

    Shape:
        (B, 60, P, C) -> (B, 60, P, C).

    Reference:
        Chen et al. 2021, "Equivariant Point Network for 3D Point Cloud Analysis".
    """

    table: Tensor

    def __init__(self, channels: int, *, checkpointing: bool | None = None) -> None:
        super().__init__()
        self.checkpointing = checkpointing
        table = icosahedron(0).multiplication[:, group_taps()]
        self.register_buffer("table", table, persistent=False)  # (60, 12)
        self.weight = nn.Parameter(torch.empty(channels, channels, table.shape[1]))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Xavier's normal rule with the gain of a ReLU."""
        nn.init.xavier_normal_(self.weight, gain=math.sqrt(2))

    def forward(self, features: Tensor) -> Tensor:
        """Convolve, see the class."""
        matrix = self.weight.permute(2, 1, 0).flatten(0, 1)  # (12·C, C)
        per_point = features[:, :, 0].numel() * self.table.shape[1]
        run = _runner(self.checkpointing, per_point * features.shape[2])
        chunks = [
            run(_convolve_group, part, self.table, matrix)
            for part in features.split(max(1, _CHUNK // per_point), dim=2)
        ]
        return torch.cat(chunks, dim=2)

    def extra_repr(self) -> str:
        """Channels and taps."""
        return f"{self.weight.shape[0]}, taps={self.table.shape[1]}"


def _convolve_group(features: Tensor, table: Tensor, matrix: Tensor) -> Tensor:
    """`AnchorGroupConv` for some of the points: (B, 60, p, C) -> (B, 60, p, C)."""
    # (B, p, 60·12, C): the taps of an element stand behind each other, so one product takes them.
    taps = features.transpose(1, 2).index_select(2, table.flatten())
    return (taps.unflatten(2, table.shape).flatten(3) @ matrix).transpose(1, 2)


def group_taps() -> Tensor:
    """Elements that leave a face where it is or take it to one of its three neighbours: (12,).

    They are the identity, two turns by 120°, three by 180° and six by 72°, in rising order.
    """
    mesh = icosahedron(0)
    face = mesh.faces[0]
    kept = torch.isin(mesh.action[:, face], face).sum(dim=1)
    return torch.nonzero(kept >= 2).flatten()


class AnchorNorm(nn.Module):
    """Normalise each channel over points and anchors together, so that anchors stay alike.

    Args:
        channels: C.
        kind: `"instance"`: for each cloud, without parameters; `"batch"`: over the batch, with
            running statistics, scale and shift.

    Shape:
        (B, A, P, C) -> (B, A, P, C).

    Raises:
        ValueError: If the kind is unknown.
    """

    def __init__(self, channels: int, kind: str) -> None:
        super().__init__()
        if kind not in NORMS:
            raise ValueError(f"norm={kind!r} is not known: choose one of {', '.join(NORMS)}")
        self.batch = JointBatchNorm1d(channels, eps=_EPS) if kind == "batch" else None

    def forward(self, features: Tensor) -> Tensor:
        """Normalise, see the class; statistics in float32 or wider."""
        if self.batch is not None:
            flat: Tensor = self.batch(features.flatten(0, 2))
            return flat.view(features.shape)
        wide = at_least_float32(features)
        centred = wide - wide.mean(dim=(1, 2), keepdim=True)
        variance = centred.square().mean(dim=(1, 2), keepdim=True)
        return (centred * torch.rsqrt(variance + _EPS)).to(features.dtype)

    def extra_repr(self) -> str:
        """The kind."""
        return "" if self.batch is not None else "instance"


class SeparableLayer(nn.Module):
    """Point convolution, then group convolution, and a shortcut around both.

    Args:
        in_channels: C.
        out_channels: O.
        radius: Of the ball.
        stride: The first 1/stride of the points become the centres.
        anchors: Rotations (A, 3, 3): the 60 of the icosahedron, in its order, for the whole layer;
            any others for the point convolution alone.
        norm: See `AnchorNorm`; that of the group convolution is always `"instance"`.
        separable: False leaves out the group convolution and the shortcut.
        checkpointing: See `AnchorPointConv`.

    Shape:
        Features (B, A, N, C), or None for all 1, points (B, N, 3) and how many neighbours count
        -> (B, A, P, O), of the first P = N // stride points.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        radius: float,
        stride: int,
        anchors: Tensor,
        norm: str = "instance",
        separable: bool = True,
        checkpointing: bool | None = None,
    ) -> None:
        super().__init__()
        self.radius, self.stride, self.separable = radius, stride, separable
        self.point_conv = AnchorPointConv(
            in_channels, out_channels, radius=radius, anchors=anchors, checkpointing=checkpointing
        )
        self.point_norm = AnchorNorm(out_channels, norm)
        if separable:
            self.group_conv = AnchorGroupConv(out_channels, checkpointing=checkpointing)
            self.group_norm = AnchorNorm(out_channels, "instance")
            self.shortcut = nn.Linear(in_channels, out_channels)
            self.shortcut_norm = AnchorNorm(out_channels, norm)

    def forward(self, features: Tensor | None, points: Tensor, neighbours: int) -> Tensor:
        """Convolve, see the class."""
        centres = points.shape[1] // self.stride
        index, offset = neighbourhood(points, centres, radius=self.radius, count=neighbours)
        out = _activate(self.point_norm(self.point_conv(features, index, offset)))
        if not self.separable:
            return out
        out = _activate(self.group_norm(self.group_conv(out)))
        if features is None:  # the same for all anchors
            features = self.shortcut.weight.new_ones(len(points), 1, centres, 1)
        past = self.shortcut(features[:, :, :centres])
        return out + _activate(self.shortcut_norm(past))

    def extra_repr(self) -> str:
        """The stride."""
        return f"stride={self.stride}"


def _activate(features: Tensor) -> Tensor:
    return nn.functional.leaky_relu(features, SLOPE, inplace=True)


def _runner(checkpointing: bool | None, numbers: int) -> Callable[..., Tensor]:
    """How to call a function of tensors: with or without keeping what its gradient needs."""
    wanted = numbers >= _KEPT if checkpointing is None else checkpointing
    if not (wanted and torch.is_grad_enabled()):
        return lambda function, *tensors: function(*tensors)
    return partial(checkpoint, use_reentrant=False, preserve_rng_state=False)
