"""What the processes that share a batch (DDP) tell each other."""

import torch
from torch import Tensor, distributed


def num_processes() -> int:
    """How many processes share a batch."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return 1
    return distributed.get_world_size()


def sum_over_processes(*parts: Tensor) -> tuple[Tensor, ...]:
    """The sums of the tensors of all processes, in one exchange; no gradient passes.

    Args:
        parts: Tensors of one dtype and device, of the same shapes in every process.
    """
    packed = torch.cat([part.detach().flatten() for part in parts])
    if num_processes() > 1:
        distributed.all_reduce(packed)
    sizes = [part.numel() for part in parts]
    return tuple(
        flat.view(part.shape) for flat, part in zip(packed.split(sizes), parts, strict=True)
    )
