"""What networks return: the contract between models, tasks, metrics and pictures."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass
class PosePrediction:
    """Rotations of a batch, and where the network has one, a distribution over candidates.

    Attributes:
        rotation: (B, 3, 3), the best guess, object -> camera.
        logits: (B, K) scores of the candidates, or None.
        log_prob: (B, K) log of the probability *mass* of each candidate, or None.
        candidates: (B, K, 3, 3), or (K, 3, 3) where all images share them, or None.
        extras: Further tensors that a network's own loss needs.
    """

    rotation: Tensor
    logits: Tensor | None = None
    log_prob: Tensor | None = None
    candidates: Tensor | None = None
    extras: dict[str, Tensor] = field(default_factory=dict)

    def sample(self, n: int, generator: torch.Generator | None = None) -> Tensor:
        """Draw `n` rotations for each image from the candidates: (B, n, 3, 3).

        A network without a distribution gives its best guess n times.
        """
        if self.log_prob is None or self.candidates is None:
            return self.rotation[:, None].expand(-1, n, -1, -1)
        index = torch.multinomial(
            self.log_prob.float().exp(), n, replacement=True, generator=generator
        )
        if self.candidates.ndim == 3:
            return self.candidates[index]
        return self.candidates[torch.arange(len(index), device=index.device)[:, None], index]


@dataclass
class ClassPrediction:
    """Class scores of a batch.

    Attributes:
        logits: (B, C).
        descriptor: (B, D), what retrieval compares.
    """

    logits: Tensor
    descriptor: Tensor
