"""Real, human-made, textured furniture: the ``.sh3f`` libraries of Sweet Home 3D.

A ``.sh3f`` file is a zip with a catalogue (``PluginFurnitureCatalog.properties``) and one OBJ with
MTL and textures for each item. The catalogue's category is the room, not the shape, so that the
classes come from the items' names (``sweethome_classes.py``).
"""

from __future__ import annotations

import hashlib
import posixpath
import re
import zipfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from i2i.data.sources.base import MeshItem, MeshSource, resolve_symmetry, safe_name
from i2i.data.sources.mesh_files import read_mesh_bytes
from i2i.data.sources.sweethome_classes import CLASSES, YAW_DEG, class_of
from i2i.errors import DatasetNotFoundError, MeshError

DEBIAN_ROOT = Path("/usr/share/sweethome3d/furniture")
CATALOGUE = "PluginFurnitureCatalog.properties"


@dataclass(frozen=True)
class CatalogueEntry:
    """One item of a catalogue.

    Attributes:
        library: File name of the library without its suffix.
        number: The item's number in the catalogue.
        name: English name.
        creator: Author.
        licence: The item's licence, or the library's.
        model: Path of the OBJ inside the zip.
        rotation: Row-major 3×3 matrix that the catalogue gives for the model, or ``None``.
    """

    library: str
    number: int
    name: str
    creator: str
    licence: str
    model: str
    rotation: tuple[float, ...] | None

    @property
    def key(self) -> str:
        """Stable name of the model: ``<library>/<stem of the OBJ>``."""
        return f"{self.library}/{posixpath.splitext(posixpath.basename(self.model))[0]}"


class SweetHome(MeshSource):
    """Furniture of ``.sh3f`` libraries, y up, back to the wall.

    After the turn to z up, the front of a piece looks along −y. The catalogue's own rotation and
    the corrections of ``sweethome_classes.YAW_DEG`` are applied by :meth:`load`.

    Args:
        root: Folder that holds the ``.sh3f`` files; ``None`` means where Debian's package
            ``sweethome3d-furniture`` puts them.
        symmetry: One symmetry for all classes, or a mapping for some.

    >>> source = SweetHome(root="/no/such/folder")
    >>> "chair" in source.classes
    True
    """

    name = "sweethome"
    up_axis = "y"
    classes = CLASSES
    licence = "CC0 and CC BY 3.0, by library; see each item"

    def __init__(
        self,
        root: str | Path | None = None,
        *,
        symmetry: str | Mapping[str, str] | None = None,
    ) -> None:
        self.root = Path(root).expanduser() if root else DEBIAN_ROOT
        self.symmetry = resolve_symmetry(self.classes, symmetry)

    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """See :meth:`MeshSource.items`; no official split, near-duplicates share a group."""
        wanted = self.check_classes(classes)
        by_class: dict[str, list[MeshItem]] = {name: [] for name in wanted}
        for path in self._libraries():
            for entry in read_catalogue(path):
                class_name = class_of(entry.key, entry.name)
                if class_name in by_class:
                    by_class[class_name].append(_item(path, entry, class_name))
        return [item for name in wanted for item in _merge_groups(by_class[name])]

    def load(self, item: MeshItem) -> trimesh.Trimesh | trimesh.Scene:
        """See :meth:`MeshSource.load`; the catalogue's rotation is already applied."""
        library, _, member = item.ref.partition("::")
        path = Path(library)
        entry = next((e for e in read_catalogue(path) if e.model == member), None)
        if entry is None:
            raise MeshError(f"{item.ref}: the catalogue of {path.name} has no such model")
        with zipfile.ZipFile(path) as archive:
            try:
                data = archive.read(member)
            except (KeyError, zipfile.BadZipFile, OSError) as error:
                raise MeshError(f"{item.ref}: cannot be read from the zip ({error})") from error
            loaded = read_mesh_bytes(
                data, file_type="obj", name=item.ref, resolver=_ZipFolder(archive, member)
            )
        loaded.apply_transform(_standard_from_model(entry, item.ref))
        return loaded

    def _libraries(self) -> list[Path]:
        paths = sorted(self.root.glob("*.sh3f")) if self.root.is_dir() else []
        if not paths:
            raise DatasetNotFoundError(
                f"no .sh3f file in {self.root}. Install Debian's package with "
                "`apt-get install sweethome3d-furniture`, or download furniture libraries from "
                "https://www.sweethome3d.com/importModels.jsp, and set data.root=<the folder that "
                "holds the .sh3f files>."
            )
        return paths


class _ZipFolder(trimesh.resolvers.Resolver):
    """Files that an OBJ inside a zip refers to, looked up beside it whatever their case."""

    def __init__(self, archive: zipfile.ZipFile, member: str) -> None:
        self._archive = archive
        self._folder = posixpath.dirname(member)
        self._names = {name.lower(): name for name in archive.namelist()}

    def get(self, name: str) -> bytes:
        """Return the bytes of a file named relative to the OBJ.

        Raises:
            KeyError: No such file; trimesh then goes on without it.
        """
        relative = str(name).strip().replace("\\", "/")
        full = posixpath.normpath(posixpath.join(self._folder, relative)).lower()
        return self._archive.read(self._names[full])

    def keys(self) -> list[str]:
        """Return the names in the zip."""
        return list(self._names.values())

    def namespaced(self, namespace: str) -> _ZipFolder:
        """Return a resolver for a folder below this one."""
        return _ZipFolder(self._archive, posixpath.join(self._folder, namespace, "x"))

    def write(self, name: str, data: bytes) -> None:
        """Refuse: libraries are only read."""
        raise OSError("a furniture library is read-only")


def parse_properties(data: bytes) -> dict[str, str]:
    r"""Parse a Java properties file: ISO-8859-1, ``\uXXXX``, continued lines.

    >>> parse_properties(b"name#1 = Caf\\u00e9 \\\n  chair\n# remark\n")
    {'name#1': 'Café chair'}
    """
    text = re.sub(r"\r\n?", "\n", data.decode("iso-8859-1"))
    text = re.sub(r"(?<!\\)((?:\\\\)*)\\\n[ \t\f]*", r"\1", text)
    entries: dict[str, str] = {}
    for line in text.split("\n"):
        line = line.lstrip(" \t\f")
        if not line or line[0] in "#!":
            continue
        match = re.match(r"((?:\\.|[^\\=: \t\f])+)[ \t\f]*[=:]?[ \t\f]*(.*)", line)
        if match:
            entries[_unescape(match[1])] = _unescape(match[2]).strip()
    return entries


def _unescape(text: str) -> str:
    def replace(match: re.Match[str]) -> str:
        code = match[1]
        if len(code) == 5:
            return chr(int(code[1:], 16))
        return {"n": "\n", "t": "\t", "r": "\r", "f": "\f"}.get(code, code)

    return re.sub(r"\\(u[0-9a-fA-F]{4}|.)", replace, text)


@lru_cache(maxsize=64)
def read_catalogue(path: Path) -> tuple[CatalogueEntry, ...]:
    """Read the items of a furniture library, in the catalogue's order.

    Raises:
        DatasetNotFoundError: The file is not a zip, or has no catalogue.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = parse_properties(archive.read(CATALOGUE))
    except (zipfile.BadZipFile, KeyError, OSError) as error:
        raise DatasetNotFoundError(
            f"{path} is not a Sweet Home 3D furniture library ({error}); remove it from data.root "
            "or download it again."
        ) from error
    fields: dict[int, dict[str, str]] = defaultdict(dict)
    for key, value in entries.items():
        match = re.fullmatch(r"(\w+)#(\d+)", key)
        if match:
            fields[int(match[2])][match[1]] = value
    library_licence = entries.get("license", "")
    return tuple(
        CatalogueEntry(
            library=path.stem,
            number=number,
            name=item["name"],
            creator=item.get("creator", ""),
            licence=item.get("license", library_licence),
            model=item["model"].lstrip("/"),
            rotation=_rotation_of(item.get("modelRotation")),
        )
        for number, item in sorted(fields.items())
        if item.get("name") and item.get("model", "").lower().endswith(".obj")
    )


def _rotation_of(text: str | None) -> tuple[float, ...] | None:
    """Parse the nine row-major numbers of ``modelRotation``."""
    if not text:
        return None
    return tuple(float(number) for number in text.split())


def _standard_from_model(entry: CatalogueEntry, ref: str) -> np.ndarray:
    """Return the (4, 4) rotation from the OBJ's frame to the standard one, y up, front at +z."""
    rotation = np.eye(3)
    if entry.rotation is not None:
        rotation = np.asarray(entry.rotation, dtype=np.float64)
        if rotation.size != 9 or abs(abs(np.linalg.det(rotation.reshape(3, 3))) - 1.0) > 1e-2:
            raise MeshError(f"{ref}: the catalogue's modelRotation is not a 3x3 rotation")
        # The catalogue writes five to eight digits: the nearest rotation removes the rounding.
        u, _, vt = np.linalg.svd(rotation.reshape(3, 3))
        rotation = u @ vt
    yaw = np.deg2rad(YAW_DEG.get(entry.key, 0.0))
    about_y = np.array(
        [[np.cos(yaw), 0.0, np.sin(yaw)], [0.0, 1.0, 0.0], [-np.sin(yaw), 0.0, np.cos(yaw)]]
    )
    transform = np.eye(4)
    transform[:3, :3] = about_y @ rotation
    return transform


def _item(path: Path, entry: CatalogueEntry, class_name: str) -> MeshItem:
    return MeshItem(
        class_name=class_name,
        instance_id=safe_name(f"{entry.library}-{entry.key.split('/')[1]}"),
        split=None,
        group=safe_name(f"{entry.creator}-{_bare_name(entry.name)}".lower()),
        ref=f"{path}::{entry.model}",
        licence=entry.licence,
        author=entry.creator,
    )


# Words that tell variants of one design apart: colours and woods.
_VARIANTS = frozenset(
    {"black", "blue", "brown", "clear", "dark", "gray", "green", "grey", "light", "orange", "pink",
     "purple", "red", "white", "yellow", "alder", "oak", "pear", "teak", "teck", "wooden"}
)  # fmt: skip


def _bare_name(name: str) -> str:
    """Drop colours, woods and numbers from a name: variants of one design then share it."""
    words = re.findall(r"[a-z]+", name.lower())
    return "-".join(word for word in words if word not in _VARIANTS)


def _merge_groups(items: list[MeshItem]) -> list[MeshItem]:
    """Join the groups of items whose OBJ has exactly the same vertices, and sort the items."""
    members: dict[str, tuple[str, ...]] = defaultdict(tuple)
    for library, _, member in (item.ref.partition("::") for item in items):
        members[library] += (member,)
    first_group: dict[str, str] = {}
    parent: dict[str, str] = {item.group: item.group for item in items}

    def root_of(group: str) -> str:
        while parent[group] != group:
            group = parent[group]
        return group

    for item in sorted(items, key=lambda item: item.instance_id):
        library, _, member = item.ref.partition("::")
        digest = _geometry_digests(library, members[library])[member]
        other = root_of(first_group.setdefault(digest, item.group))
        mine = root_of(item.group)
        parent[max(other, mine)] = min(other, mine)
    merged = [
        MeshItem(**{**item.__dict__, "group": root_of(item.group)})  # frozen: rebuilt
        for item in items
    ]
    return sorted(merged, key=lambda item: item.instance_id)


@lru_cache(maxsize=64)
def _geometry_digests(library: str, members: tuple[str, ...]) -> dict[str, str]:
    """Hash the vertex lines of each OBJ: recoloured copies of one model have the same."""
    digests = {}
    with zipfile.ZipFile(library) as archive:
        for member in members:
            try:
                vertices = re.findall(rb"^v [^\r\n]*", archive.read(member), re.MULTILINE)
            except (KeyError, zipfile.BadZipFile, OSError):
                vertices = [member.encode()]  # unreadable: load() reports it; here it is alone
            digests[member] = hashlib.sha256(b"\n".join(vertices)).hexdigest()
    return digests
