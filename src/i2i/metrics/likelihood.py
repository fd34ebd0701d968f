"""How good a distribution over SO(3) is: log-likelihood, spread, calibration."""

import math
from typing import Any

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from i2i.geometry.densities import cosine_defect, isotropic_log_density
from i2i.geometry.symmetries import symmetric_angle_rad

WITHIN_DEG = 30.0
_LOG_RANGE = (math.log(1e-2), math.log(1e6))  # of κ: from almost uniform to 0.06°


def fit_concentration(log_mass: Tensor, defect: Tensor) -> float:
    """The concentration that makes the truth most likely under a mixture.

    Args:
        log_mass: (N, K) log masses of the components.
        defect: (N, K) 1 − cos(angle) between each component's centre and the truth.

    Returns:
        κ, the same for all components and images.
    """
    log_mass, defect = log_mass.double(), defect.double()

    def negative_log_likelihood(log_kappa: float) -> float:
        density = isotropic_log_density(defect, math.exp(log_kappa))
        return -torch.logsumexp(log_mass + density, dim=1).mean().item()

    # A coarse scan first: the likelihood of a mixture can have more than one maximum.
    low, high = _LOG_RANGE
    grid = torch.linspace(low, high, 37, dtype=torch.float64).tolist()
    best = min(range(len(grid)), key=lambda i: negative_log_likelihood(grid[i]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(negative_log_likelihood, bounds=bounds, method="bounded")
    return math.exp(found.x)


class ConcentrationFit(Metric):
    """Collects what the fit needs over a validation: of the mixture and of the best guess alone.

    `compute()` gives `mixture` and `point`, the two concentrations.

    Args:
        **options: Of `torchmetrics.Metric`.
    """

    is_differentiable = False
    full_state_update = False

    log_mass: list[Tensor]
    defect: list[Tensor]
    point_defect: list[Tensor]

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - torchmetrics' own
        super().__init__(**options)
        for name in ("log_mass", "defect", "point_defect"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(
        self, rotation: Tensor, target: Tensor, log_mass: Tensor | None, centres: Tensor | None
    ) -> None:
        """Add a batch.

        Args:
            rotation: (B, 3, 3) best guesses.
            target: (B, 3, 3) truths.
            log_mass: (B, K), None where there is no mixture.
            centres: (B, K, 3, 3), None where there is no mixture.
        """
        target = target.detach().double()
        self.point_defect.append(cosine_defect(rotation.detach().double(), target))
        if log_mass is not None and centres is not None:
            self.log_mass.append(log_mass.detach().double())
            self.defect.append(cosine_defect(centres.detach().double(), target[:, None]))

    def compute(self) -> dict[str, float]:
        """The concentrations that fit the collected images best."""
        defect = dim_zero_cat(self.point_defect)[:, None]
        point = fit_concentration(torch.zeros_like(defect), defect)
        if not len(self.defect):
            return {"mixture": point, "point": point}
        mixture = fit_concentration(dim_zero_cat(self.log_mass), dim_zero_cat(self.defect))
        return {"mixture": mixture, "point": point}


def spread_deg(samples: Tensor, target: Tensor, *, symmetry: str = "none") -> Tensor:
    """Mean angle between draws (B, n, 3, 3) and the truth (B, 3, 3), in degrees: (B,).

    Each draw counts with its angle to the nearest rotation that looks like the truth.
    """
    angle = symmetric_angle_rad(samples.float(), target.float()[:, None], symmetry)
    return torch.rad2deg(angle.double()).mean(dim=1)


def probability_within(
    samples: Tensor, rotation: Tensor, limit_deg: float = WITHIN_DEG, *, symmetry: str = "none"
) -> Tensor:
    """Fraction of samples (B, n, 3, 3) within an angle of the best guess (B, 3, 3): (B,)."""
    angle = symmetric_angle_rad(samples.float(), rotation.float()[:, None], symmetry)
    return (torch.rad2deg(angle) < limit_deg).double().mean(dim=1)


def calibration_error(probability: Tensor, outcome: Tensor, *, bins: int = 10) -> Tensor:
    """Expected calibration error: mean gap between predicted and observed frequency, a scalar.

    The images are sorted by their predicted probability into bins of equal size.

    Args:
        probability: (N,) predicted for each image.
        outcome: (N,) bool, whether it happened.
        bins: Number of bins; at most one a sample.
    """
    order = probability.double().argsort(stable=True)
    sorted_probability, sorted_outcome = probability.double()[order], outcome.double()[order]
    gaps, sizes = [], []
    for p, y in zip(
        sorted_probability.tensor_split(min(bins, len(order))),
        sorted_outcome.tensor_split(min(bins, len(order))),
        strict=True,
    ):
        gaps.append((p.mean() - y.mean()).abs() * len(p))
        sizes.append(len(p))
    return torch.stack(gaps).sum() / sum(sizes)
