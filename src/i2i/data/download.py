"""Getting the data sets that can be downloaded, and saying how to get the others."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from i2i.data.archives import unpack
from i2i.data.sources.base import canonical_class_name
from i2i.data.sources.mesh_files import read_mesh
from i2i.data.sources.modelnet40 import TRAIN_COUNTS, modelnet_edition, write_marker
from i2i.data.transfer import fetch
from i2i.errors import DownloadError, MeshError

log = logging.getLogger(__name__)

MODELNET40_URLS: tuple[str, ...] = (
    "https://lmb.informatik.uni-freiburg.de/resources/datasets/ORION/modelnet40_manually_aligned.tar",
)

_MANUAL: dict[str, str] = {
    "shapenet55": (
        "ShapeNetCore v2 needs an account: register at https://shapenet.org or ask for access at "
        "https://huggingface.co/ShapeNet, unpack the archive, and set data.root=<the folder that "
        "directly holds 02691156/, 02747177/, ...>."
    ),
    "sweethome": (
        "Install Debian's package with `apt-get install sweethome3d-furniture`, or download "
        "furniture libraries (.sh3f) from https://www.sweethome3d.com/importModels.jsp into one "
        "folder and set data.root to it."
    ),
    "synthetic": "The synthetic objects are built in: nothing has to be downloaded.",
    "meshes": "Your own meshes are not downloaded: set data.root=<your folder of meshes>.",
    "images": "Your own pictures are not downloaded: set data.root=<your folder of pictures>.",
}


def download_dataset(
    name: str,
    root: str | Path | None,
    *,
    urls: Sequence[str] | None = None,
    size: int | None = None,
    checksum: str | None = None,
    keep_archive: bool = False,
    progress: bool = True,
) -> Path:
    """Download a data set by the name of its source.

    Args:
        name: Name of the source, such as ``"modelnet40"``.
        root: Folder that will hold the class folders.
        urls: Other addresses of the archive.
        size: Expected size of the archive in bytes, if known.
        checksum: ``"sha256:<hex>"`` or ``"md5:<hex>"`` of the archive, if known.
        keep_archive: Keep the archive beside ``root`` after unpacking.
        progress: Draw progress bars.

    Returns:
        ``root``.

    Raises:
        DownloadError: The data set cannot be downloaded automatically (the message says what to
            do), the transfer failed, or the archive is not what it should be.
    """
    if name in _MANUAL:
        raise DownloadError(_MANUAL[name])
    if name != "modelnet40":
        known = ", ".join(["modelnet40", *_MANUAL])
        raise DownloadError(f"nothing is known about downloading {name!r}; known: {known}.")
    if root is None or not str(root):
        raise DownloadError("data.root is not set: set data.root=<folder for ModelNet40>.")
    return download_modelnet40(
        root,
        urls=tuple(urls or MODELNET40_URLS),
        size=size,
        checksum=checksum,
        keep_archive=keep_archive,
        progress=progress,
    )


def download_modelnet40(
    root: str | Path,
    *,
    urls: Sequence[str] = MODELNET40_URLS,
    size: int | None = None,
    checksum: str | None = None,
    keep_archive: bool = False,
    progress: bool = True,
) -> Path:
    """Download and unpack the manually aligned ModelNet40.

    No checksum of the archive is published. Without one the result is verified by what is in it:
    all forty classes, both splits, the first mesh of every class can be read; training
    counts that differ from the official split are reported.

    Args:
        root: Folder that will directly hold the class folders; must be empty or missing.
        urls: Mirrors of the archive.
        size: Expected size of the archive in bytes, if known.
        checksum: Checksum of the archive, if known.
        keep_archive: Keep the archive beside ``root``.
        progress: Draw progress bars.

    Returns:
        ``root``.

    Raises:
        DownloadError: See :func:`download_dataset`.
    """
    root = Path(root).expanduser()
    if root.is_dir() and any(root.iterdir()):
        if modelnet_edition(root) == "aligned":
            log.info("%s already holds the aligned ModelNet40.", root)
            return root
        raise DownloadError(
            f"{root} already has files that this command did not write: set data.root to a new "
            "folder, or remove it."
        )
    file_name = Path(urlsplit(urls[0]).path).name if urls else ""
    if file_name.lower() == "modelnet40.zip":
        raise DownloadError(
            f"{urls[0]} is the ModelNet40 that is not aligned: no orientation can be learned from "
            "it. Use an address of modelnet40_manually_aligned.tar."
        )
    archive = root.parent / (file_name or "modelnet40_manually_aligned.tar")
    fetch(urls, archive, size=size, checksum=checksum, progress=progress)

    def check(staging: Path) -> Path:
        folder = _checked_modelnet40(staging)
        write_marker(folder, archive=archive.name)
        return folder

    unpack(archive, root, check=check, progress=progress)
    if not keep_archive:
        archive.unlink()
    return root


def _checked_modelnet40(staging: Path) -> Path:
    """Find the folder that holds the classes and look whether they are all there."""
    candidates = [staging, *sorted(path for path in staging.iterdir() if path.is_dir())]
    found = {
        folder: {canonical_class_name(path.name): path for path in folder.iterdir()}
        for folder in candidates
    }
    folder = max(candidates, key=lambda folder: len(found[folder].keys() & TRAIN_COUNTS.keys()))
    missing = sorted(TRAIN_COUNTS.keys() - found[folder].keys())
    if missing:
        raise DownloadError(
            f"the archive has no folder for {len(missing)} of the 40 classes of ModelNet40 "
            f"({', '.join(missing[:5])}, ...): it is another archive or a damaged one."
        )
    for name, count in TRAIN_COUNTS.items():
        train = sorted((found[folder][name] / "train").glob("*.off"))
        test = sorted((found[folder][name] / "test").glob("*.off"))
        if not train or not test:
            raise DownloadError(f"the archive has no train/*.off or no test/*.off of {name}.")
        if len(train) != count:
            log.warning("%s has %d training meshes, officially %d.", name, len(train), count)
        try:
            read_mesh(train[0])
        except MeshError as error:
            raise DownloadError(f"the archive holds damaged meshes: {error}") from error
    return folder
