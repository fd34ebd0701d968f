"""What networks return: the contract between models, tasks, metrics and pictures."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from i2i.geometry.densities import (
    HAAR_VOLUME,
    cosine_defect,
    isotropic_log_density,
    isotropic_samples,
)
from i2i.geometry.rotation_grids import nearest_cell


@dataclass
class PosePrediction:
    """Rotations of a batch, and where the network has one, a distribution over SO(3).

    Attributes:
        rotation: (B, 3, 3), the best guess, object -> camera.
        logits: (B, K) scores of the candidates, or None.
        log_prob: (B, K) log of the probability *mass* of each candidate, or None.
        candidates: (B, K, 3, 3), or (K, 3, 3) where all images share them, or None.
        extras: Further tensors that a network's own loss needs.
        equal_volume: Whether the candidates are the centres of K cells of equal volume that fill
            SO(3), so that their masses are a density.
        concentration: κ of the isotropic components around the candidates, or around `rotation`
            where there are none; None until it was fitted.
    """

    rotation: Tensor
    logits: Tensor | None = None
    log_prob: Tensor | None = None
    candidates: Tensor | None = None
    extras: dict[str, Tensor] = field(default_factory=dict)
    equal_volume: bool = False
    concentration: Tensor | None = None

    @classmethod
    def of_candidates(
        cls, logits: Tensor, candidates: Tensor, **extras: Tensor
    ) -> "PosePrediction":
        """The best of candidates (B, K, 3, 3) by their logits (B, K), with their softmax."""
        best = logits.argmax(dim=1)
        return cls(
            rotation=candidates[torch.arange(best.shape[0], device=best.device), best],
            logits=logits,
            log_prob=torch.log_softmax(logits, dim=1),
            candidates=candidates,
            extras=extras,
        )

    def components(self) -> tuple[Tensor, Tensor]:
        """Log masses (B, K) and centres (B, K, 3, 3) or (K, 3, 3); one component at a point."""
        if self.log_prob is None or self.candidates is None:
            return self.rotation.new_zeros(len(self.rotation), 1), self.rotation[:, None]
        return self.log_prob, self.candidates

    def log_density(self, rotations: Tensor) -> Tensor:
        """Log density at `rotations` (B, N, 3, 3) with respect to a Haar volume of π²: (B, N).

        Cells of equal volume have their mass over their volume; other candidates, or the best guess
        alone, are the centres of isotropic components of the fitted concentration.

        Raises:
            ValueError: If a concentration is needed and was not fitted.
        """
        log_mass, centres = self.components()
        if self.equal_volume:
            cell = nearest_cell(rotations.flatten(0, 1), centres).view(rotations.shape[:2])
            return log_mass.double().gather(1, cell) + math.log(centres.shape[-3] / HAAR_VOLUME)
        if self.concentration is None:
            raise ValueError(
                "the density of these components needs a concentration: it is fitted on validation "
                "images (data.val_fraction > 0)"
            )
        shared = centres if centres.ndim == 4 else centres[None]
        defect = cosine_defect(rotations.double()[:, :, None], shared.double()[:, None])
        components = isotropic_log_density(defect, self.concentration)
        return torch.logsumexp(log_mass.double()[:, None] + components, dim=2)

    def sample(self, n: int, generator: torch.Generator | None = None) -> Tensor:
        """Draw `n` rotations for each image: (B, n, 3, 3).

        Candidates are drawn by their mass, and spread by their components where a concentration is
        known. A network without a distribution gives its best guess n times, spread likewise.
        """
        log_mass, centres = self.components()
        index = torch.multinomial(log_mass.float().exp(), n, replacement=True, generator=generator)
        if centres.ndim == 3:
            drawn = centres[index]
        else:
            drawn = centres[torch.arange(len(index), device=index.device)[:, None], index]
        if self.concentration is None or self.equal_volume:
            return drawn
        noise = isotropic_samples(float(self.concentration), drawn.shape[:2], generator)
        return noise.to(drawn) @ drawn


@dataclass
class ClassPrediction:
    """Class scores of a batch.

    Attributes:
        logits: (B, C).
        descriptor: (B, D), what retrieval compares.
    """

    logits: Tensor
    descriptor: Tensor
