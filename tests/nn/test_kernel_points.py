"""The places of a kernel's weights."""

import math

import pytest
import torch

from i2i.nn.kernel_points import kernel_points


@pytest.mark.parametrize("count", [15, 24])
def test_one_in_the_middle_and_the_rest_spread_over_the_sphere(count):
    points = kernel_points(count, 0.7)
    assert points.shape == (count, 3)
    assert not points[0].any()
    torch.testing.assert_close(points[1:].norm(dim=1), torch.full((count - 1,), 0.7).double())
    # Neighbours in a plane of equilateral triangles of the sphere's area; no set on it does better.
    best = math.sqrt(8 * math.pi / math.sqrt(3) / (count - 1))
    assert torch.pdist(points[1:] / 0.7).min() > 0.75 * best
    assert points[1:].mean(dim=0).norm() < 0.05


def test_the_same_on_every_call_and_proportional_to_the_radius():
    torch.testing.assert_close(kernel_points(24, 2.0), 2 * kernel_points(24, 1.0))
    assert torch.equal(kernel_points(24, 0.5), kernel_points(24, 0.5))
    assert kernel_points(1, 1.0).shape == (1, 3)


def test_impossible_kernels_are_refused():
    for count, radius in ((0, 1.0), (3, 0.0), (3, -1.0)):
        with pytest.raises(ValueError, match="positive"):
            kernel_points(count, radius)
