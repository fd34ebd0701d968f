"""Cheap recognition of mesh files that were changed after they were rendered."""

from __future__ import annotations

import functools
import hashlib
import os
import zipfile
from pathlib import Path

from i2i.data.sources.base import MeshItem

_EDGE_BYTES = 16384


def mesh_fingerprint(item: MeshItem) -> str:
    """Short text that changes with the mesh behind an item, without reading all of it.

    Files: their size and a hash of their beginning and end. Archive members: size and CRC from the
    archive's index. Anything else (procedural objects): the key itself. Other files that a mesh
    refers to, such as textures, are not looked at.
    """
    archive, separator, member = item.ref.partition("::")
    if separator and zipfile.is_zipfile(archive):
        stat = os.stat(archive)
        found = _archive_index(archive, stat.st_size, stat.st_mtime_ns).get(member)
        return f"{found[0]}-{found[1]:08x}" if found else "missing"
    if Path(item.ref).is_file():
        return _file_fingerprint(Path(item.ref))
    return hashlib.sha256(item.ref.encode()).hexdigest()[:16]


@functools.lru_cache(maxsize=256)
def _archive_index(archive: str, size: int, mtime_ns: int) -> dict[str, tuple[int, int]]:
    """Size and CRC of each member; size and time of the archive only tell cached ones apart."""
    with zipfile.ZipFile(archive) as opened:
        return {info.filename: (info.file_size, info.CRC) for info in opened.infolist()}


def _file_fingerprint(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            digest = hashlib.sha256(stream.read(_EDGE_BYTES))
            stream.seek(max(0, size - _EDGE_BYTES))
            digest.update(stream.read(_EDGE_BYTES))
    except OSError:
        return "unreadable"  # rendering will say why
    return f"{size}-{digest.hexdigest()[:16]}"
