"""From a feature map to a band-limited function on SO(3), its values and its maxima."""

import math

import torch
from torch import Tensor, nn

from i2i.geometry.rotation_grids import healpix_points, rotation_grid
from i2i.nn.precision import at_least_float32, full_precision
from i2i.nn.projectors import SIGMA_UNITS, sampling_positions, sampling_weights
from i2i.nn.spherical import (
    check_lmax,
    float32_tables,
    generator_table,
    num_harmonics,
    num_wigner,
    spherical_harmonics,
    wigner_basis,
)


class HemisphereProjector(nn.Module):
    """Sample a map on the visible hemisphere, 1×1 convolution, ReLU, spherical harmonics.

    All HEALPix points with z > 0 are used, in training and afterwards, so the result is
    deterministic; their weights fall linearly to 0 from `taper_deg` to the rim at 90°, where
    a picture shows surfaces edge on. The weights of a point's Gaussian sum to 1.

    Args:
        in_channels: C of the encoder's map.
        out_channels: Features k on the sphere.
        map_size: Side S of the encoder's map.
        lmax: Highest degree of the harmonics.
        nside: Of the HEALPix points; 4 has 88 of 192 in front.
        taper_deg: Angle to the viewing axis from which the weights fall.
        sigma: Width of the Gaussian sampling.
        sigma_unit: What `sigma` is measured in: `"cell"` or `"halfwidth"` of the map.
        coverage: Diameter of the projected unit sphere as a fraction of the map's width.

    Attributes:
        num_points: Sampled points V.

    Shape:
        (B, in_channels, S, S) -> (B, (lmax+1)², out_channels), `Σ_v w_v Y(v) ψ(v) / √V`.

    Raises:
        ValueError: If a choice is unknown or a number is out of range.

    Reference:
        Klee et al. 2023, "Image to Sphere: Learning Equivariant Features for Efficient Pose
        Prediction", §4.1; there the points are a random subset and the weights are learned.
    """

    sampling: Tensor
    transform: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        map_size: int,
        lmax: int = 6,
        nside: int = 4,
        taper_deg: float = 75.0,
        sigma: float = 0.2,
        sigma_unit: str = "cell",
        coverage: float = 0.9,
    ) -> None:
        super().__init__()
        if sigma_unit not in SIGMA_UNITS:
            raise ValueError(
                f"sigma_unit={sigma_unit!r} is not known: choose one of {', '.join(SIGMA_UNITS)}"
            )
        if sigma <= 0 or coverage <= 0:
            raise ValueError(f"sigma={sigma} and coverage={coverage} must be positive")
        points = healpix_points(nside)
        points = points[points[:, 2] > 1e-9]
        positions = sampling_positions(points[:, :2], map_size, coverage=coverage)
        self.sigma_cells = sigma * map_size / 2 if sigma_unit == "halfwidth" else sigma
        weights = sampling_weights(positions, map_size, self.sigma_cells)
        self.register_buffer("sampling", weights.float(), persistent=False)
        taper = taper_weights(points, taper_deg)[:, None] / math.sqrt(len(points))
        transform = (spherical_harmonics(points, check_lmax(lmax)) * taper).T
        self.register_buffer("transform", transform.contiguous().float(), persistent=False)
        self.num_points, self.map_size, self.lmax = len(points), map_size, lmax
        self.linear = nn.Linear(in_channels, out_channels)

    def sample(self, features: Tensor) -> Tensor:
        """Sample a map at the points: (B, C, S, S) -> (B, V, C)."""
        if features.shape[-2:] != (self.map_size, self.map_size):
            raise ValueError(
                f"built for maps of {self.map_size}×{self.map_size} cells, "
                f"got {tuple(features.shape)}"
            )
        return torch.einsum("bcs,vs->bvc", features.flatten(2), self.sampling)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, (lmax+1)², out_channels), at least float32."""
        signal = at_least_float32(torch.relu(self.linear(self.sample(features))))
        with full_precision(signal):
            return self.transform @ signal

    def extra_repr(self) -> str:
        """`8×8 -> 88 points, σ = 0.2 cells -> l ≤ 6`."""
        side, sigma = self.map_size, self.sigma_cells
        return f"{side}×{side} -> {self.num_points} points, σ = {sigma:g} cells -> l ≤ {self.lmax}"


def taper_weights(points: Tensor, taper_deg: float) -> Tensor:
    """1 up to `taper_deg` from +z, then linearly to 0 at 90°: (V, 3) -> (V,).

    Raises:
        ValueError: If the angle is not in [0, 90).
    """
    if not 0 <= taper_deg < 90:
        raise ValueError(f"taper_deg={taper_deg} is not possible: give an angle from 0 to below 90")
    angle_deg = torch.rad2deg(points[:, 2].clamp(-1, 1).acos())
    return ((90 - angle_deg) / (90 - taper_deg)).clamp(0, 1)


class SphereCorrelation(nn.Module):
    """Correlate a signal on the sphere with a learned, globally supported filter.

    `out(T) = Σ_k ∫ f_k(T u) ψ_k(u) du` for rotations T, in harmonics
    `out[l, n, m] = Σ_k f[l, n, k] ψ[l, m, k]`: the coefficients in the orthonormal basis of
    `i2i.nn.spherical` (the filter's own harmonics are √(2l+1) times the parameter f, which keeps
    high degrees from starting small). If the object turns by Q in the camera's frame, ψ(u) becomes
    ψ(Qᵀ u) and `out(T)` becomes `out(T Q)`. With f the features of the object itself, the largest
    value is at `view`, the rotation from camera to object.

    Under a softmax over all rotations the l = 0 coefficient is a constant without effect.

    Args:
        features: Channels k of the signal.
        lmax: Highest degree.
        out_features: Functions F on SO(3), each with its own filter.
        num_filters: Filters to choose from by index: 1, or one for each class.

    Shape:
        (B, (lmax+1)², k) and an index (B,) -> (B, F, Σ(2l+1)²).

    Raises:
        ValueError: If a shape does not fit, or several filters are given no index.
    """

    blocks: Tensor

    def __init__(
        self, features: int, out_features: int = 1, *, lmax: int = 6, num_filters: int = 1
    ) -> None:
        super().__init__()
        self.features, self.out_features = features, out_features
        self.lmax, self.num_filters = check_lmax(lmax), num_filters
        self.harmonics = num_harmonics(lmax)
        self.filter = nn.Parameter(torch.empty(num_filters, out_features, self.harmonics, features))
        self.register_buffer("blocks", _block_positions(lmax), persistent=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Kaiming-uniform; the fan is the features and the orders that a value is summed from."""
        bound = 1 / math.sqrt(self.features * (2 * self.lmax + 1))
        nn.init.uniform_(self.filter, -bound, bound)

    def forward(self, signal: Tensor, filter_index: Tensor | None = None) -> Tensor:
        """Coefficients (B, F, Σ(2l+1)²) of the correlations, at least float32."""
        if signal.shape[1:] != (self.harmonics, self.features):
            raise ValueError(
                f"expected a signal (B, {self.harmonics}, {self.features}), "
                f"got {tuple(signal.shape)}"
            )
        weights: Tensor = self.filter
        if self.num_filters > 1 and filter_index is None:
            raise ValueError(
                f"{self.num_filters} filters and no index: give the class of each image (class_id)"
            )
        if self.num_filters > 1:
            weights = weights[filter_index]
        signal = at_least_float32(signal)
        with full_precision(signal):
            # All pairs of harmonics in one product, then those of equal degree.
            products = weights.to(signal.dtype) @ signal.mT[:, None]  # (B, F, n, m)
            return products.flatten(2)[..., self.blocks]

    def extra_repr(self) -> str:
        """`384 × l ≤ 6 -> 1 × 455 coefficients`."""
        filters = f"{self.num_filters} filters, " if self.num_filters > 1 else ""
        out = f"{self.out_features} × {num_wigner(self.lmax)} coefficients"
        return f"{filters}{self.features} × l ≤ {self.lmax} -> {out}"


def _block_positions(lmax: int) -> Tensor:
    """Where the coefficients (l, n, m) stand in the flat matrix of all pairs of harmonics."""
    total = num_harmonics(lmax)
    positions = []
    for degree in range(lmax + 1):
        order = torch.arange(degree**2, (degree + 1) ** 2)
        positions.append((order[:, None] * total + order).flatten())
    return torch.cat(positions)


class RotationGridValues(nn.Module):
    """Values of band-limited functions on the 72·8^level rotations of a grid.

    The tables are shared by all networks of a process as long as they stay on one device and in
    float32, and are no part of a checkpoint.

    Args:
        lmax: Highest degree.
        level: Of `i2i.geometry.rotation_grids.rotation_grid`.

    Shape:
        (..., Σ(2l+1)²) -> (..., 72·8^level).
    """

    directions: Tensor
    turns: Tensor

    def __init__(self, lmax: int = 6, level: int = 3) -> None:
        super().__init__()
        self.lmax, self.level = check_lmax(lmax), level
        directions, turns = float32_tables(lmax, level)
        self.register_buffer("directions", directions, persistent=False)
        self.register_buffer("turns", turns, persistent=False)

    def forward(self, coefficients: Tensor) -> Tensor:
        """Values at `rotation_grid(level).rotations`."""
        with full_precision(coefficients):
            series = coefficients @ self.directions.to(coefficients.dtype).T
            series = series.unflatten(-1, (-1, len(self.turns)))
            return (series @ self.turns.to(coefficients.dtype)).flatten(-2)

    def project(self, values: Tensor) -> Tensor:
        """Coefficients of functions given on the grid: (..., 72·8^level) -> (..., Σ(2l+1)²).

        They are the means of the products with the basis, right up to the grid's quadrature error.
        """
        with full_precision(values):
            series = values.unflatten(-1, (-1, self.turns.shape[1])) @ self.turns.to(values.dtype).T
            total = series.flatten(-2) @ self.directions.to(values.dtype)
            return total / values.shape[-1]

    def extra_repr(self) -> str:
        """`l ≤ 6 on 36864 rotations`."""
        return f"l ≤ {self.lmax} on {len(rotation_grid(self.level))} rotations"


class SO3Convolution(nn.Module):
    """ReLU on a rotation grid, then a learned convolution on SO(3) to one function.

    The convolution mixes features and the orders n that belong to the object's frame; the camera's
    orders m stay apart, so a turn Q of the object before the camera still takes `f(T)` to `f(T Q)`.
    The ReLU makes degrees above lmax that the grid folds back a little, so this holds to about a
    per cent for a general Q, and exactly for quarter turns about the viewing axis.

    Args:
        features: Functions F that come in.
        lmax: Highest degree.
        level: Of the rotation grid that the ReLU is taken on.

    Shape:
        (B, F, Σ(2l+1)²) -> (B, 1, Σ(2l+1)²).

    Reference:
        Klee et al. 2023, "Image to Sphere", §4.3; there the filter has local support.
    """

    def __init__(self, features: int, *, lmax: int = 6, level: int = 2) -> None:
        super().__init__()
        self.features, self.lmax = features, check_lmax(lmax)
        self.grid = RotationGridValues(lmax, level)
        self.filter = nn.Parameter(torch.empty(features, num_wigner(lmax)))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Kaiming-uniform; the fan is the features and the orders n."""
        bound = 1 / math.sqrt(self.features * (2 * self.lmax + 1))
        nn.init.uniform_(self.filter, -bound, bound)

    def forward(self, coefficients: Tensor) -> Tensor:
        """ReLU and convolution."""
        active = self.grid.project(torch.relu(self.grid(coefficients)))
        sizes = [(2 * degree + 1) ** 2 for degree in range(self.lmax + 1)]
        parts = []
        with full_precision(active):
            pairs = zip(active.split(sizes, -1), self.filter.split(sizes, -1), strict=True)
            for degree, (signal, weights) in enumerate(pairs):
                shape = (2 * degree + 1, 2 * degree + 1)
                signal, weights = signal.unflatten(-1, shape), weights.unflatten(-1, shape)
                weights = weights.to(signal.dtype)
                parts.append(torch.einsum("fon,bfnm->bom", weights, signal).flatten(1))
        return torch.cat(parts, dim=-1)[:, None]

    def extra_repr(self) -> str:
        """`8 -> 1 functions`."""
        return f"{self.features} -> 1 functions"


def values_at(coefficients: Tensor, rotation: Tensor, lmax: int) -> Tensor:
    """Values of functions at any rotations: (B, Σ(2l+1)²) and (B, ..., 3, 3) -> (B, ...)."""
    basis = wigner_basis(rotation, lmax)
    return torch.einsum("bc,b...c->b...", coefficients, basis)


@torch.no_grad()
def climb(coefficients: Tensor, start: Tensor, lmax: int, *, steps: int = 8) -> Tensor:
    """Walk from rotations to the nearest maximum of band-limited functions on SO(3).

    Newton steps in the tangent space with exact first and second derivatives. The curvatures' signs
    are turned downwards, so that every step goes uphill; a step is at most as long as a trust
    radius, which is halved where the value did not rise. The result is never lower than the start.

    Args:
        coefficients: Shape (B, Σ(2l+1)²).
        start: Rotations, shape (B, 3, 3).
        lmax: Highest degree.
        steps: How many; the same for all, so that a result does not depend on the rest of a batch.

    Returns:
        Rotations, shape (B, 3, 3).
    """
    wide = torch.float32 if coefficients.device.type == "mps" else torch.float64
    c, rotation = coefficients.to(wide), start.to(wide)
    tangent = generator_table(lmax).to(c)
    radius = torch.full((c.shape[0],), 0.5 / max(lmax, 1), dtype=wide, device=c.device)
    value = values_at(c, rotation, lmax)
    with full_precision(c):
        for _ in range(steps):
            step = _newton_step(c, rotation, lmax, tangent)
            length = step.norm(dim=1).clamp(min=1e-30)
            step = step * (radius / length).clamp(max=1.0)[:, None]
            trial = torch.linalg.matrix_exp(_cross_matrix(step)) @ rotation
            higher = values_at(c, trial, lmax)
            better = higher > value
            rotation = torch.where(better[:, None, None], trial, rotation)
            value = torch.where(better, higher, value)
            radius = torch.where(better, radius, radius / 2)
    return rotation.to(start.dtype)


def _newton_step(c: Tensor, rotation: Tensor, lmax: int, tangent: Tensor) -> Tensor:
    """ω that maximises the second-order model of the function at exp(ω) R: (B, 3)."""
    basis = wigner_basis(rotation, lmax)
    # f(exp(ω) R) = Σ_l tr(D(exp ω) U(R) Cᵀ), and the table knows D(exp ω) to second order.
    matrices, start = [], 0
    for degree in range(lmax + 1):
        width = 2 * degree + 1
        block = slice(start, start + width**2)
        u, coefficient = (t[:, block].unflatten(1, (width, width)) for t in (basis, c))
        matrices.append((coefficient @ u.mT).flatten(1))
        start += width**2
    derivatives = torch.cat(matrices, dim=1) @ tangent.T  # (B, 9)
    first, second = derivatives[:, :3], derivatives[:, 3:]
    hessian = second[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(1, (3, 3))
    curvature, axes = torch.linalg.eigh(hessian)
    floor = 1e-6 * curvature.abs().amax(dim=1, keepdim=True) + 1e-30
    along = (axes.mT @ first[..., None])[..., 0] / curvature.abs().clamp(min=floor)
    return (axes @ along[..., None])[..., 0]


def _cross_matrix(vector: Tensor) -> Tensor:
    """The skew matrix of ω × ·, (B, 3) -> (B, 3, 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
