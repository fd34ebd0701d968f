"""Batches of noise of the right shapes: for measuring, counting and trying networks out."""

from __future__ import annotations

import torch

from i2i.data.info import DataInfo
from i2i.geometry.rotations import random_rotations

Batch = dict[str, torch.Tensor]


def noise_batch(info: DataInfo, count: int, *, seed: int = 0) -> Batch:
    """A batch of noise, the same one for the same seed.

    Args:
        info: What the data are.
        count: Samples B.
        seed: Of the noise.

    Returns:
        `image` (B, C, S, S), `points` (B, P, 3) or `views` (B, V, C, S, S), as `info` says, with
        random `rotation` (B, 3, 3), the classes in turn, and numbers for the objects.
    """
    generator = torch.Generator().manual_seed(seed)
    pictures = (info.channels, info.image_size, info.image_size)
    if info.num_points is not None:
        # Points of a ball's surface: they have no two at one place, as noise in a cube might.
        points = torch.randn((count, info.num_points, 3), generator=generator)
        content = {"points": torch.nn.functional.normalize(points, dim=2)}
    elif info.num_views is not None:
        content = {"views": torch.rand((count, info.num_views, *pictures), generator=generator)}
    else:
        content = {"image": torch.rand((count, *pictures), generator=generator)}
    return {
        **content,
        "rotation": random_rotations(count, generator=generator).float(),
        "class_id": torch.arange(count) % info.num_classes,
        "instance_id": torch.arange(count),
        "view_id": torch.zeros(count, dtype=torch.long),
    }
