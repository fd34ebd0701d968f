"""Memory that the processes of one machine share, see `exchange.cpp`.

Gloo, torch's own way between processes on CPUs, sends each message through the kernel and wakes up
threads on both sides: a millisecond or two where all cores are busy.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed

from i2i.nn.native import functions, library, pointer

_FOLDER = Path("/dev/shm")  # memory, as a folder
_SLOT_BYTES = 1 << 20
_PATIENCE_SECONDS = 2.0  # after which it is asked whether the other process lives
_TIMEOUT_SECONDS = 1800.0  # after which one that lives is given up, as torch's groups do
_SUMS = {torch.float32: 1, torch.float64: 2}


class SharedMemory:
    """What the processes of the default group read and write together.

    Args:
        memory: Mapped by all of them, `size_for` bytes, zeros at the beginning.
        pids: Of all processes, by rank.
    """

    def __init__(self, memory: mmap.mmap, pids: list[int]) -> None:
        self._memory, self._pids = memory, pids
        self._at = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._rank, self._turn = distributed.get_rank(), 0

    @staticmethod
    def size_for(processes: int) -> int:
        """Bytes that so many processes share."""
        return processes * (64 + 2 * _SLOT_BYTES)  # a line for each counter

    def gather(self, tensor: Tensor) -> Tensor:
        """The tensors of all processes, (processes, *shape)."""
        ours = tensor.detach().contiguous().flatten()
        parts = [ours.new_empty(len(self._pids), 0)]
        for some in _pieces(ours):
            parts.append(ours.new_empty(len(self._pids), len(some)))
            self._exchange(some, parts[-1], 0)
        return torch.cat(parts, dim=1).view(len(self._pids), *tensor.shape)

    def add_up(self, tensor: Tensor) -> None:
        """Put the sum over all processes in its place: a contiguous tensor of :func:`can_add`."""
        for some in _pieces(tensor.detach().view(-1)):
            self._exchange(some, some, _SUMS[tensor.dtype])

    @staticmethod
    def can_add(tensor: Tensor) -> bool:
        """Whether :func:`add_up` takes it."""
        return tensor.dtype in _SUMS and tensor.device.type == "cpu" and tensor.is_contiguous()

    def _exchange(self, ours: Tensor, theirs: Tensor, of: int) -> None:
        self._turn += 1
        written: Tensor | None = ours
        give_up = time.monotonic() + _TIMEOUT_SECONDS
        while True:
            late = functions().i2i_exchange(
                ctypes.c_void_p(self._at),
                *map(ctypes.c_int64, (self._rank, len(self._pids), _SLOT_BYTES)),
                ctypes.c_uint64(self._turn),
                *map(pointer, (written, theirs)),
                ctypes.c_int64(ours.nbytes),
                of,
                ctypes.c_double(_PATIENCE_SECONDS),
            )
            if not late:
                return
            if late < 0:
                raise RuntimeError(
                    "the processes that share the batch are out of step: one of them has left out "
                    "a batch, or computes with another network"
                )
            written = None
            name = f"process {late - 1} of {len(self._pids)}, which shares the batch,"
            if not _is_alive(self._pids[late - 1]):
                raise RuntimeError(f"{name} has ended: its own message says why")
            if time.monotonic() > give_up:
                raise RuntimeError(f"{name} did not answer for {_TIMEOUT_SECONDS / 60:.0f} minutes")


def shared_memory() -> SharedMemory | None:
    """Memory for all processes of the default group, or None where they cannot share one.

    All of them have to call it together.
    """
    path = _offered() if distributed.get_rank() == 0 else None
    try:
        offer = [None if path is None else str(path)]
        distributed.broadcast_object_list(offer, src=0)
        memory = _mapped(offer[0])
        answers: list[Any] = [None] * distributed.get_world_size()
        distributed.all_gather_object(answers, (memory is not None, _namespace(), os.getpid()))
    finally:
        if path is not None:
            path.unlink()  # the memory lasts as long as somebody has it
    # Processes that cannot see each other could not tell whether the others live.
    are_together = len({namespace for _, namespace, _ in answers}) == 1
    if memory is None or not are_together or not all(is_mapped for is_mapped, *_ in answers):
        return None
    return SharedMemory(memory, [pid for *_, pid in answers])


def _offered() -> Path | None:
    """A new file of zeros, whose memory is really there."""
    if library() is None or not _FOLDER.is_dir():
        return None
    with contextlib.suppress(OSError):
        handle, name = tempfile.mkstemp(prefix="i2i_", dir=_FOLDER)
        try:
            os.posix_fallocate(handle, 0, SharedMemory.size_for(distributed.get_world_size()))
            return Path(name)
        except OSError:
            Path(name).unlink()
        finally:
            os.close(handle)
    return None


def _mapped(name: str | None) -> mmap.mmap | None:
    """Its memory; None if this process has no library, or is on another machine."""
    if name is None or library() is None:
        return None
    with contextlib.suppress(OSError, ValueError), Path(name).open("r+b") as file:
        return mmap.mmap(file.fileno(), SharedMemory.size_for(distributed.get_world_size()))
    return None


def _pieces(flat: Tensor) -> tuple[Tensor, ...]:
    """Parts of a tensor that fit into a slot."""
    return flat.split(_SLOT_BYTES // flat.element_size()) if flat.numel() else ()


def _namespace() -> str:
    """In which process numbers mean the same."""
    with contextlib.suppress(OSError):
        return str(Path("/proc/self/ns/pid").readlink())
    return f"unknown of {os.getpid()}"


def _is_alive(pid: int) -> bool:
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X")
