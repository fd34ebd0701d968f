"""What every source of meshes offers: a deterministic list of items, and a loader for one item.

A source knows names, files, licences and the frame of its meshes. It neither normalises (that is
``i2i.rendering.mesh.prepare_mesh``) nor splits at random (that is ``i2i.data.splits``).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from i2i.data.info import SYMMETRIES

if TYPE_CHECKING:
    import trimesh

UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]

UP_AXES: tuple[str, ...] = ("x", "y", "z", "-x", "-y", "-z")

# The classes whose turn about the object's z axis cannot be seen: the list of the published
# renderer (the paper names only those of them that occur in its pose tables).
Z_SYMMETRIC_CLASSES: frozenset[str] = frozenset({"bottle", "cup", "stool", "cone", "bowl", "vase"})


@dataclass(frozen=True)
class MeshItem:
    """One object of a source; plain strings only, so that it can be sent to a worker process.

    Attributes:
        class_name: Class, letters, digits, ``_`` and ``-`` only.
        instance_id: Name of the object, unique within its class.
        split: ``"train"`` or ``"test"`` where the source has an official split, else ``None``.
        group: Objects of one group (near-duplicates) stay on one side of a split.
        ref: What ``MeshSource.load`` needs: a file path, ``"archive::member"`` or a key.
        licence: Licence of this object, where it is known.
        author: Who made this object, where it is known.
    """

    class_name: str
    instance_id: str
    split: Literal["train", "test"] | None
    group: str
    ref: str
    licence: str = ""
    author: str = ""


class MeshSource(ABC):
    """A set of classes of meshes in one frame.

    Attributes:
        name: Short name; it becomes a folder of the rendered store.
        up_axis: The axis of the loaded meshes that points up.
        classes: Every class that the source can offer, sorted.
        symmetry: ``"none"``, ``"z"`` or ``"z2"`` for every class in ``classes``.
        licence: Licence of the source as a whole.
    """

    name: str = ""
    up_axis: str = "z"
    classes: tuple[str, ...] = ()
    symmetry: dict[str, str]
    licence: str = ""

    @abstractmethod
    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """List the objects of some classes.

        Args:
            classes: Class names; each must be one of ``self.classes``.

        Returns:
            Items in an order that depends on nothing but the files: by class in the order
            given, then by split (train first) and instance.

        Raises:
            ValueError: An unknown class; the message lists the known ones.
            DatasetNotFoundError: The files are not there.
        """

    @abstractmethod
    def load(self, item: MeshItem) -> trimesh.Trimesh | trimesh.Scene:
        """Read one object, with its materials, in the source's own frame (``up_axis``).

        Raises:
            MeshError: The file is empty, truncated, not a mesh or has non-finite numbers.
        """

    def check_classes(self, classes: Sequence[str]) -> tuple[str, ...]:
        """Return ``classes`` without repetitions, or raise with the list of known ones.

        Raises:
            ValueError: An empty list, or a class that the source does not have.
        """
        if isinstance(classes, str):
            classes = [classes]
        wanted = tuple(dict.fromkeys(canonical_class_name(name) for name in classes))
        unknown = [name for name in wanted if name not in self.classes]
        if unknown or not wanted:
            given = ", ".join(unknown) if unknown else "(none)"
            raise ValueError(
                f"{self.name} has no class {given}; it has: {', '.join(self.classes)}. "
                f"Choose one with data.object=<class>."
            )
        return wanted


def canonical_class_name(name: str) -> str:
    """Write a class name the way the project does: lower case, words joined by ``_``.

    Folders of the same dataset are found as ``night_stand`` and ``night-stand``; both mean one
    class.

    >>> canonical_class_name("Night-Stand")
    'night_stand'
    """
    return re.sub(r"[\s\-]+", "_", name.strip().lower())


def safe_name(name: str) -> str:
    """Reduce a file or catalogue name to letters, digits, ``.``, ``_`` and ``-``.

    Folder names and Hydra overrides must accept it; other characters become ``_``.

    >>> safe_name("my part (v2)!")
    'my_part_v2'
    """
    cleaned = re.sub(r"[^A-Za-z0-9._-]+", "_", name.strip())
    return re.sub(r"_+", "_", cleaned).strip("._") or "object"


def check_up_axis(up_axis: str) -> str:
    """Return ``up_axis`` or raise with the allowed ones.

    Raises:
        ValueError: Not a signed coordinate axis.
    """
    if up_axis not in UP_AXES:
        raise ValueError(
            f"up_axis={up_axis!r} is not an axis; allowed: {', '.join(UP_AXES)}. "
            "Set data.up_axis=z (or y for most exported OBJ and glTF files)."
        )
    return up_axis


def resolve_symmetry(
    classes: Iterable[str], override: str | Mapping[str, str] | None = None
) -> dict[str, str]:
    """Give every class its symmetry: the published list, then the user's setting.

    Args:
        classes: All classes of a source.
        override: One value for all classes, or a mapping from some classes to values.

    Returns:
        ``{class: "none" | "z" | "z2"}`` for every class.

    Raises:
        ValueError: A value that is not a symmetry, or a class that the source does not have.
    """
    published = {name: "z" if name in Z_SYMMETRIC_CLASSES else "none" for name in classes}
    return override_symmetry(published, override)


def override_symmetry(
    symmetry: Mapping[str, str], override: str | Mapping[str, str] | None
) -> dict[str, str]:
    """Change the symmetry of all classes, of some, or of none.

    Args:
        symmetry: Of every class, by its name.
        override: One value for all classes, a mapping from some classes to values, or None.

    Raises:
        ValueError: A value that is not a symmetry, or a class that is not there.
    """
    if override is None:
        return dict(symmetry)
    settings = dict.fromkeys(symmetry, override) if isinstance(override, str) else dict(override)
    for name, value in settings.items():
        if value not in SYMMETRIES:
            raise ValueError(
                f"symmetry {value!r} of class {name} is unknown; allowed: {', '.join(SYMMETRIES)}."
            )
        if canonical_class_name(name) not in symmetry:
            raise ValueError(
                f"symmetry names the class {name}, which is not one of: {', '.join(symmetry)}."
            )
    return {**symmetry, **{canonical_class_name(name): v for name, v in settings.items()}}
