"""Which different answers a distribution over rotations gives, and how sure it is of each."""

import torch
from torch import Tensor

from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.models.prediction import PosePrediction

SAME_ANSWER_DEG = 15.0
"""Candidates closer than this to a better one count as the same answer; their mass is added up."""

_PAIRS_AT_ONCE = 2**17  # of images and candidates whose angles are in memory
Answers = list[tuple[Tensor, float]]


def distinct_answers(prediction: PosePrediction, symmetry: str, *, count: int) -> list[Answers]:
    """Different answers and their probability masses for each image, the given best one first.

    Several candidates may stand for one rotation (neighbouring group elements whose residuals
    meet): each candidate's mass goes to the first answer within `SAME_ANSWER_DEG` of it, going
    through the candidates from the most probable to the least. Answers that look the same by the
    symmetry of the class are one.

    Args:
        prediction: Of B images.
        symmetry: Of the class, see `i2i.geometry.symmetries`.
        count: Answers for each image, at most.

    Returns:
        For each image pairs of a rotation (3, 3), float64, and its mass; none for a network
        without a distribution.
    """
    best = prediction.rotation.double().cpu()
    if prediction.log_prob is None or prediction.candidates is None:
        return [[] for _ in best]
    candidates = prediction.candidates.double().cpu()
    if candidates.ndim == 3:  # all images share them
        candidates = candidates.expand(len(best), -1, -1, -1)
    mass = prediction.log_prob.double().exp().cpu()
    step = max(1, _PAIRS_AT_ONCE // mass.shape[1])
    parts = (tensor.split(step) for tensor in (best, candidates, mass))
    return [
        answers
        for some in zip(*parts, strict=True)
        for answers in _of_some(*some, symmetry=symmetry, count=count)
    ]


def _of_some(
    center: Tensor, candidates: Tensor, mass: Tensor, *, symmetry: str, count: int
) -> list[Answers]:
    """The same for centres (b, 3, 3), candidates (b, K, 3, 3) and their masses (b, K)."""
    found: list[Answers] = [[] for _ in center]
    free = torch.ones_like(mass, dtype=torch.bool)
    for _ in range(count):
        angle = torch.rad2deg(symmetric_angle_rad(candidates, center[:, None], symmetry))
        same = free & (angle <= SAME_ANSWER_DEG)
        # The first centre is always an answer, the others where a candidate was left for them.
        is_answer = free.any(dim=1) if found[0] else torch.ones(len(mass), dtype=torch.bool)
        masses = torch.where(same, mass, 0.0).sum(dim=1)
        for row in is_answer.nonzero().flatten().tolist():
            found[row].append((center[row], float(masses[row])))
        free &= ~same
        chosen = torch.where(free, mass, -1.0).argmax(dim=1)
        center = candidates[torch.arange(len(mass)), chosen]
    # The best stays first: it is what the network answers, even where merged masses rank higher.
    return [[one[0], *sorted(one[1:], key=lambda answer: -answer[1])] for one in found]
