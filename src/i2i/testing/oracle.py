"""From picture to group element with a perfect encoder: finds transposed matrices and signs.

A fixed field of features is attached to the object's directions. A camera that sees the object in
orientation ``view`` paints that field on a feature map, the projector samples the map at the
visible vertices, and the icosahedral layer correlates the samples with the same field on the whole
mesh. If every convention fits, the element with the largest response is the one nearest to
``view``; if one matrix is the wrong way round, it almost never is. Pass your own ``sampler`` and
``correlate`` to run the chain through real layers.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from i2i.geometry.icosahedron import Icosahedron, icosahedron
from i2i.geometry.rotations import random_rotations

Sampler = Callable[[Tensor], Tensor]
Correlate = Callable[[Tensor, Tensor], Tensor]
Field = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class OracleResult:
    """How often the largest response lies where it should, as fractions of the views.

    Attributes:
        num_views: How many views were tried.
        nearest: It is the element nearest to ``view``.
        one_of_two: It is one of the two nearest.
        wrong_inverse: Negative control: it is the element nearest to ``view.T``.
        wrong_frame: Negative control: it is the element nearest to ``view`` among the matrices of
            the standard orientation, while the mesh is turned to the viewer.
    """

    num_views: int
    nearest: float
    one_of_two: float
    wrong_inverse: float
    wrong_frame: float

    def to_dict(self) -> dict[str, float]:
        """Plain numbers, for reports."""
        return asdict(self)


def random_field(
    num_features: int = 256, *, frequency: float = 2.0, generator: torch.Generator | None = None
) -> Field:
    """Random Fourier features F(p) = √(2/N) cos(W p + b), whose dot product is a similarity.

    Args:
        num_features: N.
        frequency: Standard deviation of the entries of W.
        generator: Source of randomness.

    Returns:
        Function from points (..., 3) to features (..., N), float64.
    """
    weights = frequency * torch.randn(num_features, 3, generator=generator, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(num_features, generator=generator, dtype=torch.float64)

    def field(points: Tensor) -> Tensor:
        return math.sqrt(2 / num_features) * torch.cos(points @ weights.T + phase)

    return field


def front_directions(map_size: int, *, coverage: float) -> Tensor:
    """Direction that each cell of an orthographic map shows, in camera axes, clamped to the rim.

    The unit circle covers ``coverage`` of half the width. Row down is −y, column right is +x.

    Args:
        map_size: S.
        coverage: Fraction of the half-width.

    Returns:
        Unit vectors with z >= 0, shape (S, S, 3), float64.
    """
    centre = (torch.arange(map_size, dtype=torch.float64) + 0.5 - map_size / 2) * 2
    centre = centre / (map_size * coverage)
    b, a = torch.meshgrid(-centre, centre, indexing="ij")
    radius = torch.hypot(a, b)
    shrink = 1 / radius.clamp(min=1.0)
    a, b = a * shrink, b * shrink
    return torch.stack((a, b, (1 - a**2 - b**2).clamp(min=0).sqrt()), dim=-1)


def paint_maps(field: Field, views: Tensor, *, map_size: int, coverage: float) -> Tensor:
    """Feature maps of a perfect encoder: cell p shows ``F(view @ direction(p))``.

    Args:
        field: Features of object-frame directions.
        views: Camera→object rotations, shape (B, 3, 3).
        map_size: S.
        coverage: As in `front_directions`.

    Returns:
        Shape (B, N, S, S).
    """
    directions = front_directions(map_size, coverage=coverage)
    return field(torch.einsum("bij,uvj->buvi", views, directions)).movedim(-1, 1)


def gaussian_sampler(
    mesh: Icosahedron, *, map_size: int, sigma: float = 0.2, coverage: float = 0.9
) -> Sampler:
    """Reference projector, written out: normalised Gaussian weights around each visible vertex.

    Args:
        mesh: Icosahedron whose visible vertices are sampled.
        map_size: S.
        sigma: Standard deviation in cells.
        coverage: Fraction of the half-width that the unit sphere covers.

    Returns:
        Function from maps (B, N, S, S) to samples (B, V_half, N).
    """
    a, b = mesh.visible_xy.unbind(-1)
    column = map_size / 2 + 0.5 * map_size * coverage * a
    row = map_size / 2 - 0.5 * map_size * coverage * b
    cell = torch.arange(map_size, dtype=torch.float64) + 0.5
    squared = (cell[None, :, None] - row[:, None, None]) ** 2 + (
        cell[None, None, :] - column[:, None, None]
    ) ** 2
    weights = torch.softmax((-squared / (2 * sigma**2)).flatten(1), dim=-1).reshape(squared.shape)

    def sample(maps: Tensor) -> Tensor:
        return torch.einsum("vij,bnij->bvn", weights.to(maps), maps)

    return sample


def correlation(mesh: Icosahedron) -> Correlate:
    """Reference icosahedral layer, written out: ``out(g) = Σ_{v visible} f(g v) · ψ(v)``.

    Args:
        mesh: Icosahedron whose action table is used.

    Returns:
        Function of f (V, N) and ψ (B, V_half, N) to responses (B, 60).
    """
    moved = mesh.action[:, mesh.visible]

    def correlate(sphere: Tensor, psi: Tensor) -> Tensor:
        return torch.einsum("gvn,bvn->bg", sphere[moved], psi)

    return correlate


def run_oracle(
    *,
    level: int = 1,
    normalize_midpoints: bool = False,
    map_size: int = 8,
    sigma: float = 0.2,
    coverage: float = 0.9,
    num_fields: int = 5,
    views_per_field: int = 400,
    seed: int = 0,
    sampler: Sampler | None = None,
    correlate: Correlate | None = None,
) -> OracleResult:
    """Run the chain over random views and count where the largest response lies.

    Args:
        level: Mesh level.
        normalize_midpoints: As in `icosahedron`.
        map_size: Cells along one side of the feature map.
        sigma: Of the reference sampler, in cells.
        coverage: Of the painted map and of the reference sampler.
        num_fields: Independent random feature fields.
        views_per_field: Random views for each.
        seed: Of all randomness.
        sampler: Projector to test, maps (B, N, S, S) float64 -> samples (B, V_half, N), without
            non-linearity; the reference one by default.
        correlate: Group layer to test, f (V, N) and ψ (B, V_half, N) -> (B, 60).

    Returns:
        Fractions over all views. A right chain has nearest > 0.85 and one_of_two > 0.97 (measured
        0.90–0.93 and 0.98–1.00), with normalised midpoints nearest > 0.92, and both controls < 0.5.
    """
    mesh = icosahedron(level, normalize_midpoints=normalize_midpoints)
    sampler = sampler or gaussian_sampler(mesh, map_size=map_size, sigma=sigma, coverage=coverage)
    correlate = correlate or correlation(mesh)
    generator = torch.Generator().manual_seed(seed)
    hits = torch.zeros(4, dtype=torch.float64)
    for _ in range(num_fields):
        field = random_field(generator=generator)
        views = random_rotations(views_per_field, generator)
        psi = sampler(paint_maps(field, views, map_size=map_size, coverage=coverage))
        hits += _hits(correlate(field(mesh.directions), psi).argmax(dim=-1), views, mesh)
    total = num_fields * views_per_field
    return OracleResult(total, *(hits / total).tolist())


def _hits(best: Tensor, views: Tensor, mesh: Icosahedron) -> Tensor:
    """Counts for the four fractions of `OracleResult`; ``best`` has shape (B,)."""
    standard = icosahedron(mesh.level, "standard").rotations

    def ranked(target: Tensor, rotations: Tensor) -> Tensor:
        return torch.einsum("bij,gij->bg", target, rotations).topk(2, dim=-1).indices

    two = ranked(views, mesh.rotations)
    counts = (
        best == two[:, 0],
        (best[:, None] == two).any(dim=-1),
        best == ranked(views.mT, mesh.rotations)[:, 0],
        best == ranked(views, standard)[:, 0],
    )
    return torch.stack([count.sum() for count in counts]).double()
