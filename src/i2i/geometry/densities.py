"""Probability densities on SO(3), with respect to the Haar measure of total volume π²."""

import math

import roma
import torch
from torch import Tensor

HAAR_VOLUME = math.pi**2
"""Volume of SO(3): the uniform density is 1/π², its logarithm −2.29."""

_TABLE = 4096
_REACH = 12.0  # in units of 1/√κ: the density there is e^-72 of its peak


def cosine_defect(a: Tensor, b: Tensor) -> Tensor:
    """1 − cos(angle) between rotations, exact for small angles: (..., 3, 3) -> (...,)."""
    return (a - b).square().sum(dim=(-2, -1)) / 4


def isotropic_log_density(defect: Tensor, concentration: Tensor | float) -> Tensor:
    """Log density of the isotropic matrix Fisher distribution around a rotation.

    p(R) = exp(κ cos θ) / (π² (I₀(κ) − I₁(κ))), θ the angle to the centre: the maximum-entropy
    distribution with a given mean of cos θ. κ = 0 is uniform; for large κ the angle about each axis
    has a standard deviation of 1/√κ radians.

    Args:
        defect: 1 − cos θ of any shape, from `cosine_defect`.
        concentration: κ ≥ 0.

    Returns:
        Logarithms in float64, of the shape of `defect`.
    """
    kappa = torch.as_tensor(concentration, dtype=torch.float64, device=defect.device)
    # i0e and i1e hold exp(−κ) already: what is left is −κ (1 − cos θ).
    normaliser = torch.special.i0e(kappa) - torch.special.i1e(kappa)
    return -kappa * defect.double() - torch.log(normaliser) - math.log(HAAR_VOLUME)


def isotropic_samples(
    concentration: float, shape: tuple[int, ...], generator: torch.Generator | None = None
) -> Tensor:
    """Rotations drawn around the identity: (*shape, 3, 3), float64.

    The axis is uniform, the angle comes from the inverse of its tabulated distribution function.
    """
    device = generator.device if generator is not None else torch.device("cpu")
    reach = min(math.pi, _REACH / math.sqrt(max(concentration, 1e-12)))
    angles = torch.linspace(0, reach, _TABLE, dtype=torch.float64, device=device)
    # Haar: the angle alone has the density (1 − cos θ)/π.
    weight = torch.exp(concentration * (angles.cos() - 1)) * (1 - angles.cos())
    cumulative = torch.cumulative_trapezoid(weight, angles)
    cumulative = torch.cat([cumulative.new_zeros(1), cumulative / cumulative[-1]])
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64, device=device)
    above = torch.searchsorted(cumulative, uniform.contiguous()).clamp(1, _TABLE - 1)
    low, high = cumulative[above - 1], cumulative[above]
    part = (uniform - low) / (high - low).clamp(min=1e-300)
    angle = angles[above - 1] + part * (angles[above] - angles[above - 1])
    axis = torch.randn((*shape, 3), generator=generator, dtype=torch.float64, device=device)
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True).clamp(min=1e-12)
    rotations: Tensor = roma.rotvec_to_rotmat(angle[..., None] * axis)
    return rotations
