"""From a feature map to a signal on the visible half of the icosahedron."""

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron

SIGMA_UNITS = ("cell", "halfwidth")
PROJECTOR_AXES = ("raster", "published")


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
    return torch.softmax(-squared.flatten(1) / (2 * sigma_cells**2), dim=1)


class IcosahedralProjector(nn.Module):
    """Orthographic sampling of a map at the visible vertices, then a 1×1 convolution and ReLU.

    The weights of a vertex sum to 1, so sampling and the 1×1 convolution commute: sampling the
    narrower map first does the same with a quarter of the products (paper §4.2).

    Args:
        in_channels: C of the encoder's map.
        out_channels: Channels of the signal, usually the group convolution's `filter_channels`.
        map_size: Side S of the encoder's map.
        mesh_level: 0 has 6 visible vertices ("sparse"), 1 has 16.
        sigma: Width of the Gaussian sampling (paper: 0.2).
        sigma_unit: What `sigma` is measured in: `"cell"` of the map, or `"halfwidth"` of the map.
        coverage: Diameter of the projected unit sphere as a fraction of the map's width (paper:
            0.9). On the 9×9 map of 129 px images, 0.8 covers the same pixels.
        normalize_midpoints: Push the edge midpoints onto the unit sphere (the paper does not).
        projector_axes: `"raster"` or `"published"`, see `sampling_positions`.
        relu: Whether the signal ends with a ReLU.

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

    sampling: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        map_size: int,
        mesh_level: int = 1,
        sigma: float = 0.2,
        sigma_unit: str = "cell",
        coverage: float = 0.9,
        normalize_midpoints: bool = False,
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
        mesh = icosahedron(mesh_level, normalize_midpoints=normalize_midpoints)
        positions = sampling_positions(
            mesh.visible_xy, map_size, coverage=coverage, projector_axes=projector_axes
        )
        self.sigma_cells = sigma * map_size / 2 if sigma_unit == "halfwidth" else sigma
        weights = sampling_weights(positions, map_size, self.sigma_cells)
        self.register_buffer("sampling", weights.float(), persistent=False)
        self.num_vertices, self.map_size, self.coverage = len(mesh.visible), map_size, coverage
        self.linear = nn.Linear(in_channels, out_channels)
        self.relu = relu

    def sample(self, features: Tensor) -> Tensor:
        """Sample a map at the visible vertices: (B, C, S, S) -> (B, V, C)."""
        if features.shape[-2:] != (self.map_size, self.map_size):
            raise ValueError(
                f"built for maps of {self.map_size}×{self.map_size} cells, "
                f"got {tuple(features.shape)}"
            )
        return torch.einsum("bcs,vs->bvc", features.flatten(2), self.sampling)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, V, out_channels)."""
        signal = self.linear(self.sample(features))
        return torch.relu(signal) if self.relu else signal

    def extra_repr(self) -> str:
        """`8×8 -> V16, σ = 0.2 cells, coverage 0.9`."""
        side, sigma = self.map_size, self.sigma_cells
        return f"{side}×{side} -> V{self.num_vertices}, σ = {sigma:g} cells, {self.coverage:.0%}"
