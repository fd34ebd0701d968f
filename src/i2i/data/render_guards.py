"""What surrounds a rendering job: a lock, clear errors, and a progress display."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import IO

from i2i.errors import StoreError

log = logging.getLogger(__name__)


@contextlib.contextmanager
def locked(folders: Iterable[Path], part: tuple[int, int] | None = None) -> Iterator[None]:
    """Hold the locks of the stores in some folders; wait for those that another process has.

    Args:
        folders: Folders of classes, made when missing.
        part: Number and count of the part that is rendered. Different parts of a class go on at
            once; who wants all of it waits for them, and they for it. None for all of it.
    """
    with contextlib.ExitStack() as stack:
        for folder in sorted(folders):  # everybody in the same order, or two wait for each other
            folder.mkdir(parents=True, exist_ok=True)
            # Reading and writing, as NFS wants it for a lock that is shared.
            _lock(stack.enter_context((folder / ".lock").open("a+")), folder, shared=bool(part))
            if part is not None:
                own = folder / f".lock-{part[0]}-of-{part[1]}"
                _lock(stack.enter_context(own.open("a+")), folder, shared=False)
        yield  # closing the files releases the locks, and so does the end of the process


def _lock(stream: IO[str], folder: Path, *, shared: bool) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system; unique names and renames still hold
        return
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(stream, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info("Another process renders %s; waiting for it.", folder)
        fcntl.flock(stream, kind)
    except OSError:
        log.warning("%s is on a file system without locks; render from one process.", folder)


@contextlib.contextmanager
def disk_errors(base: Path) -> Iterator[None]:
    """Turn the errors that a user can do something about into clear ones."""
    try:
        yield
    except BrokenProcessPool as error:
        raise StoreError(
            "A rendering process died, perhaps for lack of memory. What is rendered is kept: run "
            "the same command again, with data.render_workers=0 to see the mesh that does it."
        ) from error
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        free = shutil.disk_usage(base).free / 2**20
        raise StoreError(
            f"The disk of {base} is full ({free:.0f} MiB free). What is rendered is kept: free "
            "some space and run the same command again, or give paths.data_dir=... on a larger "
            "disk."
        ) from error


@contextlib.contextmanager
def progress_of(total: int, *, enabled: bool) -> Iterator[Callable[[int], None]]:
    """Progress of ``total`` images: a bar on a terminal, else a log line every tenth."""
    if enabled and sys.stdout.isatty():
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        with Progress("rendering", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as bar:
            task = bar.add_task("rendering", total=total)
            yield lambda count: bar.advance(task, count)
        return
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        before, done = done, done + count
        if enabled and done * 10 // max(total, 1) > before * 10 // max(total, 1):
            log.info("Rendered %d of %d images.", done, total)

    yield advance


def worker_count(num_workers: int | None) -> int:
    """How many processes render; None for one per processor that may be used.

    Raises:
        ValueError: if it is negative.
    """
    if num_workers is not None and num_workers < 0:
        raise ValueError(f"data.render_workers={num_workers} is not allowed: give 0 or more.")
    if num_workers is not None:
        return num_workers
    if hasattr(os, "sched_getaffinity"):  # a job of a cluster has a few of the node's processors
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
