"""Answers of a distribution, against going through its candidates one by one."""

import pytest
import torch

from i2i.distinct_answers import SAME_ANSWER_DEG, distinct_answers
from i2i.geometry.rotations import random_rotations
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.models.prediction import PosePrediction


def one_by_one(best, candidates, mass, symmetry, count):
    answers, free = [], set(range(len(mass)))
    for center in [None, *sorted(free, key=lambda index: (-mass[index].item(), index))]:
        if (center is not None and center not in free) or len(answers) == count:
            continue
        rotation = best if center is None else candidates[center]
        near = {
            index
            for index in free
            if symmetric_angle_rad(candidates[index], rotation, symmetry).rad2deg()
            <= SAME_ANSWER_DEG
        }
        answers.append((rotation, sum(mass[index].item() for index in near)))
        free -= near
    return [answers[0], *sorted(answers[1:], key=lambda answer: -answer[1])]


@pytest.mark.parametrize("symmetry", ["none", "z", "z2"])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("spread", "count"), [(180, 4), (20, 4), (20, 100)])
def test_answers_are_those_of_going_through_candidates(
    symmetry, shared, spread, count, monkeypatch
):
    """Also in parts, where few images and candidates are in memory at once."""
    centers = random_rotations(5, generator=torch.Generator().manual_seed(1)).double()
    small = torch.randn(5, 30, 3, dtype=torch.float64) * torch.deg2rad(torch.tensor(spread / 2.0))
    skew = torch.zeros(5, 30, 3, 3, dtype=torch.float64)
    skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0] = small.unbind(-1)
    candidates = torch.linalg.matrix_exp(skew - skew.mT) @ centers[:, None]
    candidates = candidates[0] if shared else candidates
    log_prob = torch.randn(5, 30).double().log_softmax(dim=1)
    prediction = PosePrediction(rotation=centers, log_prob=log_prob, candidates=candidates)
    expected = [
        one_by_one(
            centers[row], candidates if shared else candidates[row], log_prob[row].exp(),
            symmetry, count,
        )
        for row in range(5)
    ]  # fmt: skip
    assert len({len(answers) for answers in expected}) > 1 or count == 4
    for limit in (10**6, 70):
        monkeypatch.setattr("i2i.distinct_answers._PAIRS_AT_ONCE", limit)
        found = distinct_answers(prediction, symmetry, count=count)
        for ours, theirs in zip(found, expected, strict=True):
            assert [mass for _, mass in ours] == pytest.approx([mass for _, mass in theirs])
            for (rotation, _), (other, _) in zip(ours, theirs, strict=True):
                torch.testing.assert_close(rotation, other)


def test_a_network_without_a_distribution_gives_no_answers():
    prediction = PosePrediction(rotation=torch.eye(3).expand(2, 3, 3))
    assert distinct_answers(prediction, "none", count=4) == [[], []]
