"""The user's own meshes: a folder of classes, a folder of one class, or a single file."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import trimesh

from i2i.data.sources.base import (
    MeshItem,
    MeshSource,
    canonical_class_name,
    check_up_axis,
    resolve_symmetry,
    safe_name,
)
from i2i.data.sources.mesh_files import MESH_SUFFIXES, read_mesh
from i2i.errors import ConfigurationError, DatasetNotFoundError

log = logging.getLogger(__name__)

_GLTF = (".glb", ".gltf")  # their standard fixes y up
_SPLITS: tuple[Literal["train", "test"], ...] = ("train", "test")


class Meshes(MeshSource):
    """Meshes in a folder.

    Understood are ``<class>/{train,test}/<mesh>``, ``<class>/<mesh>`` (split by a ratio), meshes
    directly in the folder (one class, named like the folder) and a single file (one class, named
    like the file). Formats: OFF, OBJ, PLY, STL, GLB, glTF.

    Args:
        root: The folder or the file.
        up_axis: The meshes' axis that points up. ``None`` means z, except where all files are
            glTF, whose standard says y; a mixture must be told.
        symmetry: ``"none"``, ``"z"`` or ``"z2"`` for all classes, or a mapping for some. Unlike the
            public data sets, no class is symmetric because of its name.

    Raises:
        DatasetNotFoundError: ``root`` is not set, is not there, or holds no mesh file.
        ConfigurationError: Two folders mean one class, a class mixes layouts, or glTF and other
            formats are mixed without an ``up_axis``.
    """

    name = "meshes"
    licence = "the user's own"

    def __init__(
        self,
        root: str | Path | None = None,
        *,
        up_axis: str | None = None,
        symmetry: str | Mapping[str, str] | None = None,
    ) -> None:
        if root is None or not str(root):
            raise DatasetNotFoundError(
                "data.root is not set for meshes: set data.root=<a folder of class folders, a "
                "folder of meshes, or one mesh file>."
            )
        self.root = Path(root).expanduser()
        self._items = _find_items(self.root)
        self.classes = tuple(self._items)
        self.up_axis = _up_axis_of(self.root, self._items, up_axis)
        self.symmetry = dict.fromkeys(self.classes, "none")
        if symmetry is not None:
            given = dict.fromkeys(self.classes, symmetry) if isinstance(symmetry, str) else symmetry
            self.symmetry = resolve_symmetry(self.classes, {**self.symmetry, **given})

    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """See :meth:`MeshSource.items`; items carry a split where the folders do."""
        return [item for name in self.check_classes(classes) for item in self._items[name]]

    def load(self, item: MeshItem) -> trimesh.Trimesh | trimesh.Scene:
        """See :meth:`MeshSource.load`."""
        return read_mesh(item.ref)


def _find_items(root: Path) -> dict[str, list[MeshItem]]:
    """Return ``{class: items}``, sorted."""
    if root.is_file():
        name = canonical_class_name(safe_name(root.stem))
        return {name: _items_of(name, [(root, None)])}
    if not root.is_dir():
        raise DatasetNotFoundError(
            f"{root} is neither a folder nor a file: set data.root=<your folder of meshes>."
        )
    flat = _mesh_files(root)
    files = {
        child: found
        for child in sorted(root.iterdir())
        if child.is_dir() and not child.name.startswith(".") and (found := _class_files(child))
    }
    if flat and files:
        raise ConfigurationError(
            f"{root} holds meshes beside class folders ({flat[0].name}, {next(iter(files)).name}/, "
            "...): put every mesh into a folder named like its class."
        )
    if flat or (not files and any((root / split).is_dir() for split in _SPLITS)):
        files = {root: [(path, None) for path in flat]}
    if set(child.name for child in files) & set(_SPLITS):  # the folder of one class was given
        files = {root: _class_files(root)}
    if not any(files.values()):
        raise DatasetNotFoundError(
            f"{root} holds no mesh; expected <class>/*.off, <class>/train/*.off and "
            f"<class>/test/*.off, or meshes directly in it. Formats: {', '.join(MESH_SUFFIXES)}."
        )
    classes: dict[str, list[MeshItem]] = {}
    for folder, found in files.items():
        name = canonical_class_name(safe_name(folder.resolve().name))
        if name in classes:
            raise ConfigurationError(f"{root}: two folders mean the class {name}; join them.")
        classes[name] = _items_of(name, found)
    return dict(sorted(classes.items()))


def _mesh_files(folder: Path) -> list[Path]:
    return [
        path
        for path in sorted(folder.iterdir())
        if path.is_file() and path.suffix.lower() in MESH_SUFFIXES and path.name[0] != "."
    ]


def _class_files(folder: Path) -> list[tuple[Path, Literal["train", "test"] | None]]:
    """List the files of one class with their split; a lone train or test folder is no split."""
    direct = _mesh_files(folder)
    by_split = {
        split: _mesh_files(folder / split) for split in _SPLITS if (folder / split).is_dir()
    }
    official = [split for split, found in by_split.items() if found]
    if direct and official:
        raise ConfigurationError(
            f"{folder} holds meshes beside {official[0]}/ ({direct[0].name}, ...): move them into "
            "train/ or test/, or all of them directly into the class folder."
        )
    if len(official) == 1:
        log.warning("%s has only %s/: its meshes are split by ratio.", folder, official[0])
        return [(path, None) for path in by_split[official[0]]]
    if official:
        return [(path, split) for split in _SPLITS for path in by_split[split]]
    return [(path, None) for path in direct]


def _items_of(
    class_name: str, files: Sequence[tuple[Path, Literal["train", "test"] | None]]
) -> list[MeshItem]:
    """Name the files; where two would share a name, suffix and split tell them apart."""
    stems = Counter(safe_name(path.stem) for path, _ in files)
    items = []
    for path, split in files:
        name = safe_name(path.stem)
        if stems[name] > 1:
            name = safe_name("-".join(filter(None, [split, path.name.replace(".", "_")])))
        items.append(MeshItem(class_name, name, split, group=name, ref=str(path)))
    repeated = [name for name, n in Counter(item.instance_id for item in items).items() if n > 1]
    if repeated:
        raise ConfigurationError(
            f"two meshes of the class {class_name} are both called {repeated[0]} when written with "
            "letters, digits, '.', '_' and '-' only: rename one."
        )
    return items


def _up_axis_of(root: Path, items: Mapping[str, list[MeshItem]], up_axis: str | None) -> str:
    if up_axis is not None:
        return check_up_axis(up_axis)
    is_gltf = {Path(item.ref).suffix.lower() in _GLTF for found in items.values() for item in found}
    if is_gltf == {True, False}:
        raise ConfigurationError(
            f"{root} mixes glTF files (y up by their standard) with others: convert them to one "
            "frame and say which axis points up with data.up_axis=y or data.up_axis=z."
        )
    if is_gltf == {True}:
        return "y"
    log.info("up_axis is not set: the meshes of %s are taken as z up.", root)
    return "z"
