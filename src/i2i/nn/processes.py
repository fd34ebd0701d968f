"""What the processes that share a batch (DDP) tell each other."""

import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, distributed

from i2i.nn.native.exchange import SharedMemory, shared_memory

# The default group that was asked last, and the memory that its processes share. A group that was
# held beyond its end would now and then abort the process when that exits.
_KNOWN: list[tuple[Callable[[], Any], SharedMemory | None]] = [(lambda: None, None)]


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
        sum_in_place(packed)
    sizes = [part.numel() for part in parts]
    return tuple(
        flat.view(part.shape) for flat, part in zip(packed.split(sizes), parts, strict=True)
    )


def gather_from_processes(tensor: Tensor) -> Tensor:
    """The tensors of all processes, which have one shape: (processes, *shape); no gradient."""
    memory = _memory() if tensor.device.type == "cpu" else None
    if memory is not None:
        return memory.gather(tensor)
    ours = tensor.detach().contiguous()
    parts = [torch.empty_like(ours) for _ in range(num_processes())]
    distributed.all_gather(parts, ours)
    return torch.stack(parts)


def sum_in_place(tensor: Tensor) -> None:
    """Put the sum over all processes in the place of each one's tensor; no gradient passes."""
    memory = _memory() if SharedMemory.can_add(tensor) else None
    if memory is None:
        distributed.all_reduce(tensor)
    else:
        memory.add_up(tensor)


def has_shared_memory() -> bool:
    """Whether processes exchange through memory; the first time all ask together."""
    return _memory() is not None


def _memory() -> SharedMemory | None:
    """That of the default group; all processes ask for it together the first time."""
    group = distributed.group.WORLD
    if _KNOWN[0][0]() is not group:
        is_local = distributed.get_backend() == "gloo"
        _KNOWN[0] = (weakref.ref(group), shared_memory() if is_local else None)
    return _KNOWN[0][1]
