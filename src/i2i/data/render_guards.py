"""What surrounds a rendering job: a lock, clear errors, and a progress display."""

from __future__ import annotations

import contextlib
import errno
import logging
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from i2i.errors import StoreError

log = logging.getLogger(__name__)


@contextlib.contextmanager
def locked(base: Path) -> Iterator[None]:
    """Hold the lock of all stores with the same settings; wait if another process has it."""
    base.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # no such locks on this system; unique names and renames still hold
        yield
        return
    with (base / ".lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.info("Another process renders %s; waiting for it.", base)
            fcntl.flock(stream, fcntl.LOCK_EX)
        except OSError:
            log.warning("%s is on a file system without locks; render from one process.", base)
        yield  # closing the file releases the lock, and so does the end of the process


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
