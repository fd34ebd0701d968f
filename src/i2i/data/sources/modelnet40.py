"""The forty classes of ModelNet40, in the manually aligned edition of the paper.

The folder holds ``<class>/{train,test}/*.off``, z up, with the official split. The well-known
``ModelNet40.zip`` has the same names inside but is not aligned: its objects of one class face in
different directions, so that no orientation can be learned from it.
"""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import trimesh

from i2i.data.sources.base import (
    MeshItem,
    MeshSource,
    canonical_class_name,
    resolve_symmetry,
    safe_name,
)
from i2i.data.sources.mesh_files import read_mesh
from i2i.errors import DatasetNotFoundError

log = logging.getLogger(__name__)

# Instances of the official training split; they sum to 9,843.
TRAIN_COUNTS: dict[str, int] = {
    "airplane": 626, "bathtub": 106, "bed": 515, "bench": 173, "bookshelf": 572, "bottle": 335,
    "bowl": 64, "car": 197, "chair": 889, "cone": 167, "cup": 79, "curtain": 138, "desk": 200,
    "door": 109, "dresser": 200, "flower_pot": 149, "glass_box": 171, "guitar": 155,
    "keyboard": 145, "lamp": 124, "laptop": 149, "mantel": 284, "monitor": 465, "night_stand": 200,
    "person": 88, "piano": 231, "plant": 240, "radio": 104, "range_hood": 115, "sink": 128,
    "sofa": 680, "stairs": 124, "stool": 90, "table": 392, "tent": 163, "toilet": 344,
    "tv_stand": 267, "vase": 475, "wardrobe": 87, "xbox": 103,
}  # fmt: skip
POSE_CLASSES: tuple[str, ...] = (
    "desk", "bottle", "sofa", "toilet", "car", "chair", "stool", "airplane", "guitar", "bench",
)  # fmt: skip

# Written into the folder by i2i.data.download: says which archive the files came from.
MARKER = ".i2i-source.json"
_ALIGNED = "manual"


class ModelNet40(MeshSource):
    """ModelNet40, manually aligned.

    Args:
        root: Folder that directly holds the class folders; ``None`` is reported when it is used.
        symmetry: One symmetry for all classes, or a mapping for some.
        assume_aligned: Take the meshes as aligned although nothing in the folder says so.

    >>> source = ModelNet40(root="/no/such/folder")
    >>> len(source.classes), source.symmetry["bottle"], source.symmetry["car"]
    (40, 'z', 'none')
    """

    name = "modelnet40"
    up_axis = "z"
    classes = tuple(TRAIN_COUNTS)
    licence = "academic use; the models belong to their authors (modelnet.cs.princeton.edu)"

    def __init__(
        self,
        root: str | Path | None = None,
        *,
        symmetry: str | Mapping[str, str] | None = None,
        assume_aligned: bool = False,
    ) -> None:
        self.root = Path(root).expanduser() if root else None
        self.symmetry = resolve_symmetry(self.classes, symmetry)
        self.assume_aligned = assume_aligned

    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """See :meth:`MeshSource.items`; every item carries the official split.

        Raises:
            ValueError: An unknown class.
            DatasetNotFoundError: The folder, or a class in it, is missing, or the folder is
                known not to be the aligned edition.
        """
        wanted = self.check_classes(classes)
        folders = self._class_folders()
        self._check_alignment()
        missing = [name for name in wanted if name not in folders]
        if missing:
            raise DatasetNotFoundError(
                f"{self.root} has no folder for {', '.join(missing)}; it has: "
                f"{', '.join(sorted(folders))}. The download may be incomplete: run "
                "`python -m i2i.download data=modelnet40` again."
            )
        items: list[MeshItem] = []
        for name in wanted:
            found = _class_items(folders[name], name)
            if not found:
                raise DatasetNotFoundError(
                    f"{folders[name]} has no train/*.off or test/*.off files; run "
                    "`python -m i2i.download data=modelnet40` again."
                )
            items += found
            _notice_counts(name, found)
        return items

    def load(self, item: MeshItem) -> trimesh.Trimesh | trimesh.Scene:
        """See :meth:`MeshSource.load`."""
        return read_mesh(item.ref)

    def _class_folders(self) -> dict[str, Path]:
        """Find the class folders; ``night_stand``, ``night-stand`` and ``Night Stand`` are one."""
        advice = (
            "Get the manually aligned ModelNet40 with `python -m i2i.download data=modelnet40`, or "
            "set data.root=<the folder that directly holds airplane/, bathtub/, ...>."
        )
        if self.root is None:
            raise DatasetNotFoundError(f"data.root is not set for modelnet40. {advice}")
        if not self.root.is_dir():
            raise DatasetNotFoundError(f"{self.root} is not a folder. {advice}")
        folders = _known_folders(self.root)
        if not folders:
            below = [child for child in sorted(self.root.iterdir()) if child.is_dir()]
            nested = next((child for child in below if _known_folders(child)), None)
            hint = f" They seem to be one level deeper: data.root={nested}." if nested else ""
            raise DatasetNotFoundError(
                f"{self.root} holds no ModelNet40 class folder.{hint} {advice}"
            )
        return folders

    def _check_alignment(self) -> None:
        """Refuse the edition that is not aligned; warn when the edition cannot be told."""
        if self.assume_aligned or self.root is None:
            return
        edition = modelnet_edition(self.root)
        if edition == "not aligned":
            raise DatasetNotFoundError(
                f"{self.root} looks like the common ModelNet40.zip, which is not aligned: "
                "orientations cannot be learned from it. Get the manually aligned edition with "
                "`python -m i2i.download data=modelnet40`. If these meshes are aligned after all, "
                "set data.source.assume_aligned=true."
            )
        if edition == "unknown":
            log.warning(
                "Nothing in %s says that these are the manually aligned meshes, and the common "
                "ModelNet40.zip has the same file names but is not aligned. Set "
                "data.source.assume_aligned=true if you know that they are.",
                self.root,
            )


def modelnet_edition(root: Path) -> Literal["aligned", "not aligned", "unknown"]:
    """Tell which edition a folder holds, from the traces that its unpacking left.

    The meshes themselves do not say. A marker of our download does, and so does the name of the
    aligned archive, ``modelnet40_manually_aligned``. The common zip leaves a folder called
    ``ModelNet40`` with ``__MACOSX/ModelNet40`` beside it.
    """
    marker = root / MARKER
    if marker.is_file():
        try:
            alignment = json.loads(marker.read_text(encoding="utf-8")).get("alignment")
        except (OSError, ValueError, AttributeError):
            return "unknown"
        return "aligned" if alignment == _ALIGNED else "not aligned"
    name = root.resolve().name
    if re.search(r"(?<!un)(?<!not.)aligned", name.lower()):
        return "aligned"
    folders = (root, root.resolve().parent)
    traces = ("ModelNet40.zip", "__MACOSX/ModelNet40")
    has_trace = any((folder / trace).exists() for folder in folders for trace in traces)
    return "not aligned" if has_trace or name == "ModelNet40" else "unknown"


def write_marker(root: Path, *, archive: str, alignment: str = _ALIGNED) -> None:
    """Note in a folder which archive its meshes came from, for :func:`modelnet_edition`."""
    content = {"dataset": "modelnet40", "archive": archive, "alignment": alignment}
    (root / MARKER).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _known_folders(root: Path) -> dict[str, Path]:
    children = (child for child in sorted(root.iterdir()) if child.is_dir())
    named = {canonical_class_name(child.name): child for child in children}
    return {name: folder for name, folder in named.items() if name in TRAIN_COUNTS}


def _class_items(folder: Path, class_name: str) -> list[MeshItem]:
    items = []
    splits: tuple[Literal["train", "test"], ...] = ("train", "test")
    for split in splits:
        for path in sorted((folder / split).glob("*.off")):
            if path.name.startswith("."):  # "._x.off", left by macOS archives
                continue
            stem = safe_name(path.stem)
            items.append(MeshItem(class_name, stem, split, group=stem, ref=str(path)))
    return items


def _notice_counts(class_name: str, items: Sequence[MeshItem]) -> None:
    found = Counter(item.split for item in items)["train"]
    if found != TRAIN_COUNTS[class_name]:
        log.warning(
            "%s has %d training meshes; the official split has %d.",
            class_name, found, TRAIN_COUNTS[class_name],
        )  # fmt: skip
