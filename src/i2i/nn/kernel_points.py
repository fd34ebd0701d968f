"""Where the weights of a point convolution sit."""

import math

import torch
from torch import Tensor

_GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))


def kernel_points(count: int, radius: float) -> Tensor:
    """One point at the centre and the rest on a sphere, in the order of a Fibonacci lattice.

    Closed form instead of repulsion: the same numbers on every machine, for any count. The points
    on the sphere have equal areas of height and turn by the golden angle from one to the next.

    Args:
        count: Number of points K.
        radius: Of the sphere.

    Returns:
        Shape (K, 3), float64; the centre is first.

    Raises:
        ValueError: If the count or the radius is impossible.

    Example:
        >>> kernel_points(24, 0.5).shape
        torch.Size([24, 3])
    """
    if count < 1 or not radius > 0:
        raise ValueError(f"count={count}, radius={radius}: both must be positive")
    shell = torch.arange(count - 1, dtype=torch.float64)
    height = 1 - (2 * shell + 1) / max(count - 1, 1)
    ring, turn = (1 - height.square()).sqrt(), _GOLDEN_ANGLE_RAD * shell
    sphere = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    return torch.cat([sphere.new_zeros(1, 3), radius * sphere])
