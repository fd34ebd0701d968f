"""From a feature map to a signal on the visible half of the icosahedron, or on the group."""

from typing import Any

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import MeshAxis, icosahedron
from i2i.nn.group_conv_variants import READINGS, support_elements
from i2i.nn.native.products import Linear, product

SIGMA_UNITS = ("cell", "halfwidth")
_NEGLIGIBLE = torch.finfo(torch.float32).eps ** 2  # of weights that sum to 1
PROJECTOR_AXES = ("raster", "published")
POOLINGS = ("average", "cells")


def sampling_positions(
    points: Tensor, map_size: int, *, coverage: float, projector_axes: str = "raster"
) -> Tensor:
    """Where points of the camera frame land on the map: (V, 2) as (row, column), centres at i + ½.

    Args:
        points: (V, 2), x right and y up; the projection is orthographic, so z does not matter.
        map_size: Side S of the map.
        coverage: Diameter of the unit sphere's picture as a fraction of the map's width.
        projector_axes: `"raster"`: x along columns and y up the rows. `"published"`: x along rows
            and y along columns, which fits only the published depth pictures (an offset of 90°).
    """
    if projector_axes not in PROJECTOR_AXES:
        raise ValueError(
            f"projector_axes={projector_axes!r} is not known: "
            f"choose one of {', '.join(PROJECTOR_AXES)}"
        )
    x, y = points[:, 0], points[:, 1]
    row, column = (-y, x) if projector_axes == "raster" else (x, y)
    return map_size / 2 + 0.5 * map_size * coverage * torch.stack([row, column], dim=1)


def sampling_weights(positions: Tensor, map_size: int, sigma_cells: float) -> Tensor:
    """Gaussian weights of all cells for each position, each row summing to 1: (V, S·S).

    Args:
        positions: (V, 2) as (row, column), cell centres at i + ½.
        map_size: Side S of the map.
        sigma_cells: Standard deviation in cells.
    """
    centres = torch.arange(map_size, dtype=torch.float64) + 0.5
    row, column = positions.double().unbind(dim=1)
    squared = (centres[None, :, None] - row[:, None, None]) ** 2 + (
        centres[None, None, :] - column[:, None, None]
    ) ** 2
    # Softmax of the exponents: a narrow sigma cannot underflow to 0/0.
    weights = torch.softmax(-squared.flatten(1) / (2 * sigma_cells**2), dim=1)
    # The far tail is below any rounding, but as denormal numbers it makes a CPU's products many
    # times slower.
    return weights.masked_fill(weights < _NEGLIGIBLE, 0.0)


class SamplingProjector(nn.Module):
    """Gaussian sampling of a map at given points, then a 1×1 convolution and ReLU.

    The weights of a point sum to 1, so sampling and the 1×1 convolution commute: sampling the
    narrower map first does the same with a quarter of the products (paper §4.2).

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal, usually the group convolution's `filter_channels`.
        points: (P, 2), camera frame, x right and y up, the unit sphere having radius 1.
        map_size: Side S of the encoder's map.
        sigma: Width of the Gaussian sampling (paper: 0.2).
        sigma_unit: What `sigma` is measured in: `"cell"` of the map, or `"halfwidth"` of the map.
        coverage: Diameter of the projected unit sphere as a fraction of the map's width (paper:
            0.9). On the 9×9 map of 129 px images, 0.8 covers the same pixels.
        projector_axes: `"raster"` or `"published"`, see `sampling_positions`.
        relu: Whether the signal ends with a ReLU.

    Attributes:
        num_vertices: Number of points P.

    Shape:
        (B, in_channels, S, S) -> (B, P, out_channels).

    Raises:
        ValueError: If a choice is unknown or a number is not positive.
    """

    sampling: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        points: Tensor,
        map_size: int,
        sigma: float = 0.2,
        sigma_unit: str = "cell",
        coverage: float = 0.9,
        projector_axes: str = "raster",
        relu: bool = True,
    ) -> None:
        super().__init__()
        if sigma_unit not in SIGMA_UNITS:
            raise ValueError(
                f"sigma_unit={sigma_unit!r} is not known: choose one of {', '.join(SIGMA_UNITS)}"
            )
        if sigma <= 0 or coverage <= 0:
            raise ValueError(f"sigma={sigma} and coverage={coverage} must be positive")
        positions = sampling_positions(
            points, map_size, coverage=coverage, projector_axes=projector_axes
        )
        self.sigma_cells = sigma * map_size / 2 if sigma_unit == "halfwidth" else sigma
        weights = sampling_weights(positions, map_size, self.sigma_cells)
        self.register_buffer("sampling", weights.float(), persistent=False)
        self.num_vertices, self.map_size, self.coverage = len(points), map_size, coverage
        self.linear = Linear(in_channels, out_channels, relu=relu)

    def sample(self, features: Tensor) -> Tensor:
        """Sample a map at the points: (B, C, S, S) -> (B, P, C)."""
        check_map(features, self.map_size)
        return product(self.sampling, features.flatten(2).mT)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, P, out_channels)."""
        signal: Tensor = self.linear(self.sample(features))
        return signal

    def extra_repr(self) -> str:
        """`8×8 -> V16, σ = 0.2 cells, coverage 0.9`."""
        side, sigma = self.map_size, self.sigma_cells
        return f"{side}×{side} -> V{self.num_vertices}, σ = {sigma:g} cells, {self.coverage:.0%}"


class IcosahedralProjector(SamplingProjector):
    """Orthographic sampling of a map at the visible vertices, then a 1×1 convolution and ReLU.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal, usually the group convolution's `filter_channels`.
        map_size: Side S of the encoder's map.
        mesh_level: 0 has 6 visible vertices ("sparse"), 1 has 16.
        mesh_axis: What of the mesh points to the viewer, see `icosahedron`.
        normalize_midpoints: Push the edge midpoints onto the unit sphere (the paper does not).
        **sampling: `sigma`, `sigma_unit`, `coverage`, `projector_axes`, `relu` of
            `SamplingProjector`.

    Attributes:
        num_vertices: Number of visible vertices.

    Shape:
        (B, in_channels, S, S) -> (B, num_vertices, out_channels).

    Raises:
        ValueError: If a choice is unknown or a number is not positive.

    Example:
        >>> projector = IcosahedralProjector(4, 10, map_size=8)
        >>> projector(torch.ones(2, 4, 8, 8)).shape
        torch.Size([2, 16, 10])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        map_size: int,
        mesh_level: int = 1,
        mesh_axis: MeshAxis = "vertex",
        normalize_midpoints: bool = False,
        **sampling: Any,  # noqa: ANN401  passed on as they are
    ) -> None:
        mesh = icosahedron(mesh_level, normalize_midpoints=normalize_midpoints, mesh_axis=mesh_axis)
        super().__init__(
            in_channels, out_channels, points=mesh.visible_xy, map_size=map_size, **sampling
        )
        self.mesh_axis = mesh_axis


class GroupElementProjector(SamplingProjector):
    """Sampling of a map at the marks of group elements, one point for each element of a support.

    The 60 elements are the 60 corners of a football, two thirds of the way along each edge from
    its one end or the other (`Icosahedron.marks`). Element h is where it takes the mark of the
    identity, which is beside the viewing axis; those of the 12 turns by 72° are all on the visible
    side.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal, usually the group convolution's `filter_channels`.
        map_size: Side S of the encoder's map.
        support: Whose elements, see `i2i.nn.group_conv_variants.FullGroupConv`.
        mesh_axis: What of the icosahedron points to the viewer, see `icosahedron`.
        **sampling: `sigma`, `sigma_unit`, `coverage`, `projector_axes`, `relu` of
            `SamplingProjector`.

    Attributes:
        num_vertices: Number of elements in the support.

    Shape:
        (B, in_channels, S, S) -> (B, num_vertices, out_channels).

    Raises:
        ValueError: If a choice is unknown or a number is not positive.

    Example:
        >>> projector = GroupElementProjector(4, 10, map_size=8)
        >>> projector(torch.ones(2, 4, 8, 8)).shape
        torch.Size([2, 13, 10])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        map_size: int,
        support: str = "local13",
        mesh_axis: MeshAxis = "vertex",
        **sampling: Any,  # noqa: ANN401  passed on as they are
    ) -> None:
        mesh = icosahedron(mesh_axis=mesh_axis)
        points = mesh.marks[support_elements(mesh, support), :2]
        super().__init__(in_channels, out_channels, points=points, map_size=map_size, **sampling)
        self.mesh_axis = mesh_axis


class PooledProjector(nn.Module):
    """One feature vector for the whole map, then a 1×1 convolution and ReLU.

    The average of a map that turns with the image does not change when the image is turned by 90°:
    with an exactly C4-equivariant encoder, nothing after it can tell the four quarter turns apart.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal.
        map_size: Side S of the encoder's map.
        pooling: `"average"` over the cells, or `"cells"`: a learned weight for each channel and
            cell, equal at the start (C · S² more parameters, and no longer blind to turns).
        linear: False hands out the feature vector itself, without ReLU; `out_channels` must then
            be `in_channels`.
        relu: Whether the signal ends with a ReLU.

    Attributes:
        num_vertices: 1.

    Shape:
        (B, in_channels, S, S) -> (B, 1, out_channels).

    Raises:
        ValueError: If the pooling is unknown or the channels do not fit.

    Example:
        >>> PooledProjector(4, 10, map_size=8)(torch.ones(2, 4, 8, 8)).shape
        torch.Size([2, 1, 10])
    """

    num_vertices = 1

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        map_size: int,
        pooling: str = "average",
        linear: bool = True,
        relu: bool = True,
    ) -> None:
        super().__init__()
        if pooling not in POOLINGS:
            raise ValueError(
                f"pooling={pooling!r} is not known: choose one of {', '.join(POOLINGS)}"
            )
        if not linear and in_channels != out_channels:
            raise ValueError(
                f"the pooled map has {in_channels} channels and {out_channels} are wanted of it: "
                "give linear=true, or with model/group_conv=none set model.reading=pooled"
            )
        self.map_size, self.pooling, self.relu = map_size, pooling, relu and linear
        self.weight: nn.Parameter | None = None
        if pooling == "cells":
            self.weight = nn.Parameter(torch.full((in_channels, map_size**2), map_size**-2.0))
        self.linear = nn.Linear(in_channels, out_channels) if linear else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, 1, out_channels)."""
        check_map(features, self.map_size)
        cells = features.flatten(2)
        pooled = cells.mean(dim=2) if self.weight is None else (cells * self.weight).sum(dim=2)
        signal = self.linear(pooled[:, None])
        return torch.relu(signal) if self.relu else signal

    def extra_repr(self) -> str:
        """`8×8 -> 1, average`."""
        return f"{self.map_size}×{self.map_size} -> 1, {self.pooling}"


def full_group_projector(
    in_channels: int,
    out_channels: int,
    *,
    map_size: int,
    support: str = "identity",
    pooling: str = "average",
    **sampling: Any,  # noqa: ANN401  passed on as they are
) -> nn.Module:
    """The projector of `FullGroupConv`: a pooled vector for the identity, samples otherwise.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal.
        map_size: Side S of the encoder's map.
        support: `"identity"` or `"local13"`.
        pooling: Of `PooledProjector`, for the identity.
        **sampling: Of `SamplingProjector`, for the other support.

    Raises:
        ValueError: If a choice is unknown.
    """
    if support == "identity":
        return PooledProjector(in_channels, out_channels, map_size=map_size, pooling=pooling)
    return GroupElementProjector(
        in_channels, out_channels, map_size=map_size, support=support, **sampling
    )


def unconstrained_projector(
    in_channels: int,
    out_channels: int,
    *,
    map_size: int,
    reading: str = "sampled",
    pooling: str = "average",
    **sampling: Any,  # noqa: ANN401  passed on as they are
) -> nn.Module:
    """The projector of `UnconstrainedMap` in either of its readings.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal.
        map_size: Side S of the encoder's map.
        reading: `"sampled"` at the visible vertices, or `"pooled"`, without a 1×1 convolution.
        pooling: Of `PooledProjector`, for the second.
        **sampling: Of `IcosahedralProjector`, for the first.

    Raises:
        ValueError: If a choice is unknown or the channels do not fit.
    """
    if reading not in READINGS:
        raise ValueError(f"reading={reading!r} is not known: choose one of {', '.join(READINGS)}")
    if reading == "pooled":
        return PooledProjector(
            in_channels, out_channels, map_size=map_size, pooling=pooling, linear=False
        )
    return IcosahedralProjector(in_channels, out_channels, map_size=map_size, **sampling)


def check_map(features: Tensor, map_size: int) -> None:
    """Refuse a map of another size.

    Raises:
        ValueError: Saying what was expected.
    """
    if features.shape[-2:] != (map_size, map_size):
        raise ValueError(
            f"built for maps of {map_size}×{map_size} cells, got {tuple(features.shape)}"
        )
