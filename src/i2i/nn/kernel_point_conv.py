"""Rigid kernel-point convolutions of stacked clouds of different sizes, and their residual network.

Clouds lie one behind the other: points (N, 3) and features (N, C), with the number of the cloud of
each point in (N,).
"""

import math
from dataclasses import dataclass
from functools import partial
from itertools import count

import torch
from torch import Tensor, nn

from i2i.geometry.points import grid_subsample, radius_neighbours
from i2i.geometry.rotations import axis_rotation
from i2i.nn.kernel_points import kernel_points
from i2i.nn.point_sets import RowNorm
from i2i.nn.precision import at_least_float32, full_precision

KERNEL_POINTS = 15
RADIUS = 2.5  # of a neighbourhood, in cells of the grid
_EXTENT = 1.2  # how far a kernel point reaches, in cells
_SHELL = 0.66  # radius of the kernel's sphere, of the neighbourhood's
_JITTER = 0.01  # of the kernel points, of the neighbourhood's radius
_MOMENTUM = 0.05
_SLOPE = 0.1
_FAR = 1e3  # in cells: where a missing neighbour is put, beyond the reach of every kernel point


@dataclass(frozen=True)
class Neighbours:
    """Which of N points lie around each of M places.

    Attributes:
        index: Shape (M, H), valid everywhere: a missing neighbour is the first one once more.
        offset: From the place to the neighbour, in cells, shape (M, H, 3); far away for a missing
            one.
    """

    index: Tensor
    offset: Tensor


def find_neighbours(
    places: Tensor,
    place_batch: Tensor,
    points: Tensor,
    point_batch: Tensor,
    *,
    cell: float,
    limit: int,
) -> Neighbours:
    """The points within 2.5 cells of each place, of its own cloud, the nearest `limit` at most.

    Args:
        places: Shape (M, 3), each with at least one point of its cloud in reach.
        place_batch: Shape (M,).
        points: Shape (N, 3).
        point_batch: Shape (N,).
        cell: Side of a cell of the grid of the points.
        limit: Largest H; no more columns than the fullest neighbourhood needs are returned.

    Returns:
        Indices and offsets, without gradient.
    """
    with torch.no_grad(), full_precision(points):
        index = radius_neighbours(
            places, place_batch, points, point_batch, radius=RADIUS * cell, limit=limit
        )
        missing = index == len(points)
        index = index[:, : max(1, int((~missing).sum(dim=1).max()))]
        missing = missing[:, : index.shape[1]]
        index = torch.where(missing, index[:, :1], index)
        offset = (points[index] - places[:, None]) / cell
        return Neighbours(index, offset.masked_fill(missing[..., None], _FAR))


class KernelPointConv(nn.Module):
    """Convolution whose weights sit on points in space.

    `out(x) = Σ_k W_kᵀ Σ_j max(0, 1 − |x_j − x − κ_k| / extent) f(x_j)`, j over the neighbours of x.
    There is no bias and no division by the number of neighbours. Of the kernel points κ one is at
    the centre and the others near a sphere; they are turned about z and moved a little at random,
    and are kept in the checkpoint.

    Args:
        in_channels: C.
        out_channels: O.
        kernel_size: Kernel points K.
        seed: Of the randomness of the kernel points.

    Shape:
        Features (N, C) and `Neighbours` of M places -> (M, O).

    Reference:
        Thomas et al. 2019, "KPConv: Flexible and Deformable Convolution for Point Clouds".
    """

    kernel: Tensor

    def __init__(
        self, in_channels: int, out_channels: int, *, kernel_size: int = KERNEL_POINTS, seed: int
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        turn = axis_rotation("z", 360 * float(torch.rand(1, generator=generator)))
        points = kernel_points(kernel_size, _SHELL * RADIUS) @ turn.T
        noise = torch.randn(kernel_size, 3, generator=generator, dtype=torch.float64)
        self.register_buffer("kernel", (points + _JITTER * RADIUS * noise).float())
        self.weight = nn.Parameter(torch.empty(kernel_size, in_channels, out_channels))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """As a linear layer of K·C inputs."""
        bound = 1 / math.sqrt(self.weight.shape[0] * self.weight.shape[1])
        nn.init.uniform_(self.weight, -bound, bound)

    def influence(self, offset: Tensor) -> Tensor:
        """Weight of each neighbour for each kernel point, from offsets in cells.

        (M, H, 3) -> (M, H, K), without gradient.
        """
        with torch.no_grad(), full_precision(offset):
            kernel = self.kernel.to(offset.dtype)
            flat = offset.flatten(0, 1)
            # |x − κ|² by a product: a few cells long, so cancellation costs 1e-6 cells² at most.
            squared = torch.addmm(kernel.square().sum(dim=1), flat, kernel.T, alpha=-2)
            squared += flat.square().sum(dim=1, keepdim=True)
            distance = squared.clamp_(min=0).sqrt_()
            return distance.mul_(-1 / _EXTENT).add_(1).relu_().view(*offset.shape[:2], -1)

    def forward(self, features: Tensor, neighbours: Neighbours) -> Tensor:
        """Convolve, see the class."""
        influence = self.influence(neighbours.offset)
        index = neighbours.index
        gathered = features.index_select(0, index.flatten()).view(*index.shape, -1)
        mixed = influence.mT.to(features.dtype) @ gathered  # (M, K, C)
        return mixed.flatten(1) @ self.weight.flatten(0, 1)

    def extra_repr(self) -> str:
        """Channels and kernel points."""
        size, in_channels, out_channels = self.weight.shape
        return f"{in_channels}, {out_channels}, kernel_size={size}"


def unary(in_channels: int, out_channels: int, *, activate: bool = True) -> nn.Sequential:
    """Linear layer without bias, batch norm, and leaky ReLU if asked: (N, C) -> (N, O)."""
    layers = [
        nn.Linear(in_channels, out_channels, bias=False),
        RowNorm(out_channels, momentum=_MOMENTUM),
    ]
    return nn.Sequential(*layers, *([nn.LeakyReLU(_SLOPE)] if activate else []))


class SimpleBlock(nn.Module):
    """Kernel-point convolution, batch norm, leaky ReLU.

    Args:
        in_channels: C.
        out_channels: O.
        seed: See `KernelPointConv`.

    Shape:
        Features (N, C) and `Neighbours` of M places -> (M, O).
    """

    def __init__(self, in_channels: int, out_channels: int, *, seed: int) -> None:
        super().__init__()
        self.conv = KernelPointConv(in_channels, out_channels, seed=seed)
        self.norm = RowNorm(out_channels, momentum=_MOMENTUM)

    def forward(self, features: Tensor, neighbours: Neighbours) -> Tensor:
        """Apply, see the class."""
        return nn.functional.leaky_relu(self.norm(self.conv(features, neighbours)), _SLOPE)


class BottleneckBlock(nn.Module):
    """Residual block: to a quarter of the width, kernel-point convolution, to the full width.

    Args:
        in_channels: C.
        out_channels: O.
        strided: The places are not the points: the short cut is the largest of the neighbours.
        seed: See `KernelPointConv`.

    Shape:
        Features (N, C) and `Neighbours` of M places -> (M, O); M = N without stride.
    """

    def __init__(
        self, in_channels: int, out_channels: int, *, strided: bool = False, seed: int
    ) -> None:
        super().__init__()
        self.strided = strided
        middle = out_channels // 4
        self.narrow = nn.Identity() if in_channels == middle else unary(in_channels, middle)
        self.conv = SimpleBlock(middle, middle, seed=seed)
        self.widen = unary(middle, out_channels, activate=False)
        same = in_channels == out_channels
        self.shortcut = nn.Identity() if same else unary(in_channels, out_channels, activate=False)

    def forward(self, features: Tensor, neighbours: Neighbours) -> Tensor:
        """Apply, see the class."""
        residual = self.widen(self.conv(self.narrow(features), neighbours))
        if self.strided:
            index = neighbours.index
            gathered = features.index_select(0, index.flatten()).view(*index.shape, -1)
            features = gathered.max(dim=1).values
        return nn.functional.leaky_relu(residual + self.shortcut(features), _SLOPE)


class KernelPointTrunk(nn.Module):
    """One feature vector for each cloud, by rigid kernel-point convolutions on five grids.

    The points are thinned by a grid, and from level to level by one of twice the cell. Each point
    carries the number 1 at first. Everything depends on differences of places only, and not on the
    order of the points.

    Args:
        width: Channels w of the first block.
        cell: Side of a cell of the first grid, in the units of the points.
        levels: Grids L.
        neighbours: How many of a neighbourhood are looked at, the nearest first. Those of 8,192
            points on a mesh, in cells of 0.02, have up to 75; 48 cut a tenth of the third grid's.
        seed: Of the randomness of the kernel points.

    Attributes:
        out_channels: 2^L · w.

    Raises:
        ValueError: If a number is impossible.

    Shape:
        (B, P, 3) -> (B, out_channels), float32 for half precision.
    """

    def __init__(
        self, *, width: int, cell: float, levels: int = 5, neighbours: int = 48, seed: int = 0
    ) -> None:
        super().__init__()
        if width % 2 or not cell > 0 or levels < 1:
            raise ValueError(
                f"width={width}, cell={cell}, levels={levels}: the width must be even, all positive"
            )
        self.cell, self.neighbours = cell, neighbours
        self.out_channels = width << levels
        seeds = count(1000 * seed)
        self.levels, self.strides = nn.ModuleList(), nn.ModuleList()
        for level in range(levels):
            narrow, wide = width << level, 2 * width << level
            blocks: list[nn.Module] = [BottleneckBlock(narrow, wide, seed=next(seeds))]
            if level == 0:
                blocks.insert(0, SimpleBlock(1, width, seed=next(seeds)))
            else:
                blocks.append(BottleneckBlock(wide, wide, seed=next(seeds)))
            self.levels.append(nn.ModuleList(blocks))
            if level < levels - 1:
                self.strides.append(BottleneckBlock(wide, wide, strided=True, seed=next(seeds)))

    def forward(self, points: Tensor) -> Tensor:
        """Apply, see the class."""
        clouds, size = points.shape[:2]
        with torch.no_grad():
            batch = torch.arange(clouds, device=points.device).repeat_interleave(size)
            places = at_least_float32(points).flatten(0, 1)
            places, batch = grid_subsample(places, batch, self.cell)
        features = places.new_ones(len(places), 1)
        for level, blocks in enumerate(self.levels):
            cell = self.cell * 2**level
            find = partial(
                find_neighbours, points=places, point_batch=batch, cell=cell, limit=self.neighbours
            )
            around = find(places, batch)
            assert isinstance(blocks, nn.ModuleList)
            for block in blocks:
                features = block(features, around)
            if level < len(self.strides):
                places, batch = grid_subsample(places, batch, 2 * cell)
                features = self.strides[level](features, find(places, batch))
        parts = at_least_float32(features).split(batch.bincount(minlength=clouds).tolist())
        return torch.stack([part.mean(dim=0) for part in parts])

    def extra_repr(self) -> str:
        """The grids."""
        cells = ", ".join(f"{self.cell * 2**level:g}" for level in range(len(self.levels)))
        return f"cells {cells}; {self.neighbours} neighbours"
