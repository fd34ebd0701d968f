"""Sampling from predictions."""

import torch

from i2i.geometry.rotations import random_rotations
from i2i.models.prediction import PosePrediction


def test_samples_follow_the_probabilities():
    candidates = random_rotations(2 * 3, torch.Generator().manual_seed(0)).view(2, 3, 3, 3)
    probability = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.1, 0.9]])
    for shared in (False, True):
        own = candidates[0] if shared else candidates
        prediction = PosePrediction(
            torch.eye(3).expand(2, 3, 3), log_prob=probability.log(), candidates=own
        )
        drawn = prediction.sample(4000, torch.Generator().manual_seed(1))
        assert drawn.shape == (2, 4000, 3, 3)
        each = own.expand(2, 3, 3, 3)
        same = (drawn[:, :, None] == each[:, None]).all(dim=-1).all(dim=-1)
        frequency = same.double().mean(dim=1)
        torch.testing.assert_close(frequency, probability.double(), atol=0.03, rtol=0)
        assert frequency[0, 2] == 0
    again = prediction.sample(4000, torch.Generator().manual_seed(1))
    assert torch.equal(drawn, again)


def test_without_a_distribution_samples_are_the_best_guess():
    rotation = random_rotations(2)
    drawn = PosePrediction(rotation).sample(3)
    assert torch.equal(drawn, rotation[:, None].expand(2, 3, 3, 3))
