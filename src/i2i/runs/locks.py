"""Advisory locks of jobs, so that two sweeps at once never run the same one."""

import contextlib
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

_held: set[IO[str]] = set()
_ATTEMPTS = 5
_PAUSE_S = 0.1


@contextlib.contextmanager
def job_lock(folder: Path, identity: str) -> Iterator[bool]:
    """Hold the lock of a job, if nobody else does.

    The lock ends with the process, however that ends. Its file stays behind: removing it would
    let two processes lock two files of the same name.

    Args:
        folder: Folder of the locks, made when missing.
        identity: The job's hash.

    Yields:
        Whether the lock is ours. True as well where the file system has no locks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{identity}.lock").open("a+") as stream:
        if not _acquire(stream):
            yield False
            return
        stream.truncate(0)
        stream.write(f"process {os.getpid()} on {platform.node()}\n")
        stream.flush()
        _held.add(stream)
        try:
            yield True
        finally:
            _held.discard(stream)


def holder(folder: Path, identity: str) -> str:
    """Who took the lock last, in words."""
    path = folder / f"{identity}.lock"
    return (path.read_text().strip() if path.is_file() else "") or "another process"


def _acquire(stream: IO[str]) -> bool:
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return True
    for attempt in range(_ATTEMPTS):
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(_PAUSE_S if attempt + 1 < _ATTEMPTS else 0)
        except OSError:  # a file system without locks
            return True
    return False


def _let_go_in_a_fork() -> None:
    """A forked worker shares the lock; one that outlives its parent must not keep it."""
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in _held:  # in place, so that closing the stream later closes no other file
        os.dup2(null, stream.fileno())
    os.close(null)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go_in_a_fork)
