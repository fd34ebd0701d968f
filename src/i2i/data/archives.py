"""Unpacking a tar or zip that is not trusted: nothing leaves the folder, half a result is none."""

from __future__ import annotations

import os
import re
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from rich.progress import track

from i2i.errors import DownloadError

_SPARE = 64 << 20  # bytes of disk that unpacking leaves free


@dataclass(frozen=True)
class _Member:
    """One regular file or folder of an archive.

    Attributes:
        name: Checked relative path.
        size: Bytes of the unpacked file.
        is_folder: Whether it is a folder.
        open: Opens the content.
    """

    name: PurePosixPath
    size: int
    is_folder: bool
    open: Callable[[], IO[bytes] | None]


def unpack(
    archive: str | Path,
    folder: str | Path,
    *,
    check: Callable[[Path], Path] | None = None,
    progress: bool = True,
) -> Path:
    """Unpack an archive into a folder that does not exist yet.

    Files go to ``<folder>.part`` first, which is renamed when everything is there; what an
    interrupted call left is removed.

    Args:
        archive: A tar (also compressed) or zip file.
        folder: Where the files go.
        check: Looks at the unpacked files, raises if they are not what they should be, and returns
            the folder among them that becomes ``folder``.
        progress: Draw a progress bar.

    Returns:
        ``folder``.

    Raises:
        DownloadError: Not an archive, a damaged one, one with links, devices or paths that lead
            out, a full disk, or a folder that already has files.
    """
    archive, folder = Path(archive), Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DownloadError(f"{folder} is already there: remove it, or set another data.root.")
    staging = folder.with_name(folder.name + ".part")
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    try:
        with _members(archive) as members:
            _check_space(staging, sum(member.size for member in members))
            for member in track(members, f"Unpacking {archive.name}", disable=not progress):
                _write(member, staging)
        chosen = check(staging) if check is not None else staging
    except (tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        shutil.rmtree(staging, ignore_errors=True)
        raise DownloadError(
            f"{archive} could not be unpacked ({error}). If it is damaged, remove it and download "
            "it again."
        ) from error
    except BaseException:  # refused content, or Ctrl-C: leave nothing half done
        shutil.rmtree(staging, ignore_errors=True)
        raise
    if folder.exists():
        folder.rmdir()
    os.replace(chosen, folder)
    shutil.rmtree(staging, ignore_errors=True)
    return folder


@contextmanager
def _members(archive: Path) -> Iterator[list[_Member]]:
    """Open an archive and list its members, all of them checked before any is written."""
    if tarfile.is_tarfile(archive):
        with tarfile.open(archive) as tar:
            yield [_tar_member(tar, info) for info in tar.getmembers()]
    elif zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as pack:
            yield [_zip_member(pack, info) for info in pack.infolist()]
    else:
        raise DownloadError(
            f"{archive} is neither a tar nor a zip file: remove it and download it again."
        )


def _tar_member(tar: tarfile.TarFile, info: tarfile.TarInfo) -> _Member:
    if not (info.isreg() or info.isdir()):  # links, devices, pipes
        raise DownloadError(
            f"{info.name} in the archive is a link or a device; nothing was unpacked."
        )
    name = _checked_name(info.name)
    return _Member(name, info.size, info.isdir(), lambda: tar.extractfile(info))


def _zip_member(pack: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DownloadError(
            f"{info.filename} in the archive is a link or a device; nothing was unpacked."
        )
    name = _checked_name(info.filename)
    return _Member(name, info.file_size, info.is_dir(), lambda: pack.open(info))


def _checked_name(name: str) -> PurePosixPath:
    """Return a member's path, or refuse one that is absolute, climbs up or names a drive."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or re.match(r"[A-Za-z]:", name) or "\0" in name:
        raise DownloadError(
            f"{name!r} in the archive leads out of the folder; nothing was unpacked."
        )
    return path


def _write(member: _Member, staging: Path) -> None:
    """Write one member; owners, modes and times of the archive are not taken over."""
    path = staging / member.name
    if member.is_folder:
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    source = member.open()
    if source is None:
        raise DownloadError(f"{member.name} in the archive has no content.")
    with source, path.open("wb") as stream:
        shutil.copyfileobj(source, stream, 1 << 20)
    if path.stat().st_size != member.size:
        raise EOFError(f"{member.name} is cut off")


def _check_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if needed + _SPARE > free:
        raise DownloadError(
            f"{folder.parent} has {free / 1e9:.1f} GB free, {(needed + _SPARE) / 1e9:.1f} GB are "
            "needed to unpack: free some space, or set data.root to another disk."
        )
