"""ShapeNetCore v2: the eight classes of the paper, and all 55.

The folder holds ``<synset>/<model>/models/model_normalized.obj`` with MTL and textures, y up.
ShapeNet asks for a registration, so that nothing here downloads it.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import trimesh

from i2i.data.sources.base import (
    MeshItem,
    MeshSource,
    canonical_class_name,
    resolve_symmetry,
    safe_name,
)
from i2i.data.sources.mesh_files import read_mesh
from i2i.data.sources.shapenet_synsets import SYNSETS
from i2i.errors import DatasetNotFoundError

PAPER_CLASSES: tuple[str, ...] = (
    "guitar", "bed", "bottle", "bowl", "clock", "chair", "file_cabinet", "airplane",
)  # fmt: skip
PAPER_CAPS: dict[str, int] = {"chair": 1000, "airplane": 1000}
_MODEL = Path("models") / "model_normalized.obj"


class ShapeNet55(MeshSource):
    """ShapeNetCore v2, without an official split (the paper's is a random 80/20 of instances).

    Args:
        root: Folder that directly holds the synset folders (``02691156`` ...).
        symmetry: One symmetry for all classes, or a mapping for some.
        max_instances: Largest number of instances by class, applied before any split; the kept
            ones are drawn at random by ``seed``. ``None`` means the paper's 1,000 for chair and
            airplane; ``{}`` keeps all.
        seed: Seed of that draw.

    >>> source = ShapeNet55(root="/no/such/folder")
    >>> len(source.classes), source.synset_of("file-cabinet"), source.synset_of("02691156")
    (55, '03337140', '02691156')
    """

    name = "shapenet55"
    up_axis = "y"
    licence = "ShapeNet terms of use (https://shapenet.org/terms)"

    def __init__(
        self,
        root: str | Path | None = None,
        *,
        symmetry: str | Mapping[str, str] | None = None,
        max_instances: Mapping[str, int] | None = None,
        seed: int = 0,
    ) -> None:
        self.root = Path(root).expanduser() if root else None
        self.seed = seed
        self._synsets, self._aliases = _synset_names(self.root)
        self.classes = tuple(sorted(self._synsets))
        self.symmetry = resolve_symmetry(self.classes, symmetry)
        self.max_instances = dict(PAPER_CAPS if max_instances is None else max_instances)

    def synset_of(self, class_name: str) -> str:
        """Return the synset of a class that is given by name, alias or synset."""
        return self._synsets[self.check_classes([class_name])[0]]

    def check_classes(self, classes: Sequence[str]) -> tuple[str, ...]:
        """See :meth:`MeshSource.check_classes`; synsets and the taxonomy's names are accepted."""
        given = [classes] if isinstance(classes, str) else list(classes)
        names = [canonical_class_name(str(name)) for name in given]
        return super().check_classes([self._aliases.get(name, name) for name in names])

    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """See :meth:`MeshSource.items`; no item carries a split."""
        wanted = self.check_classes(classes)
        root = self._checked_root()
        items: list[MeshItem] = []
        for name in wanted:
            folder = root / self._synsets[name]
            models = sorted(path.name for path in folder.glob("*") if (path / _MODEL).is_file())
            if not models:
                raise DatasetNotFoundError(
                    f"{folder} ({name}) has no <model>/{_MODEL.as_posix()}. {_ADVICE}"
                )
            for model in self._capped(name, models):
                ref = str(folder / model / _MODEL)
                items.append(MeshItem(name, safe_name(model), None, group=model, ref=ref))
        return items

    def load(self, item: MeshItem) -> trimesh.Trimesh | trimesh.Scene:
        """See :meth:`MeshSource.load`; a scene with one part for each material."""
        return read_mesh(item.ref)

    def _capped(self, class_name: str, models: list[str]) -> list[str]:
        """Keep at most the allowed number, drawn by a hash of seed and model name.

        Whether a model is drawn before another does not depend on the rest of the folder.
        """
        cap = self.max_instances.get(class_name)
        if cap is None or len(models) <= cap:
            return models
        drawn = sorted(
            models, key=lambda model: hashlib.sha256(f"{self.seed}/{model}".encode()).digest()
        )
        return sorted(drawn[:cap])

    def _checked_root(self) -> Path:
        if self.root is None:
            raise DatasetNotFoundError(f"data.root is not set for shapenet55. {_ADVICE}")
        if not self.root.is_dir():
            raise DatasetNotFoundError(f"{self.root} is not a folder. {_ADVICE}")
        if not any((self.root / synset).is_dir() for synset in self._synsets.values()):
            nested = next(
                (child for child in sorted(self.root.iterdir()) if _holds_synsets(child)), None
            )
            hint = f" They seem to be one level deeper: data.root={nested}." if nested else ""
            raise DatasetNotFoundError(f"{self.root} holds no synset folder.{hint} {_ADVICE}")
        return self.root


_ADVICE = (
    "ShapeNetCore v2 cannot be downloaded without an account: register at https://shapenet.org or "
    "ask for access at https://huggingface.co/ShapeNet, unpack the archive, and set "
    "data.root=<the folder that directly holds 02691156/, 02747177/, ...>."
)


def _holds_synsets(folder: Path) -> bool:
    return folder.is_dir() and any((folder / synset).is_dir() for synset in SYNSETS.values())


def _synset_names(root: Path | None) -> tuple[dict[str, str], dict[str, str]]:
    """Return ``{class: synset}`` and ``{other name: class}``.

    Known synsets keep their built-in name, so that a configuration means the same class whatever
    the folder holds. ``taxonomy.json`` adds its synonyms, and the folder its further synsets.
    """
    synsets = dict(SYNSETS)
    lemmas = _taxonomy(root)
    if root is not None and root.is_dir():
        known = set(synsets.values())
        for folder in sorted(root.iterdir()):
            if re.fullmatch(r"\d{8}", folder.name) and folder.name not in known:
                names = [name for name in lemmas.get(folder.name, []) if name not in synsets]
                synsets[names[0] if names else folder.name] = folder.name
    name_of = {synset: name for name, synset in synsets.items()}
    aliases = {synset: name for synset, name in name_of.items() if synset != name}
    for synset, names in lemmas.items():
        for name in names:
            if synset in name_of and name not in synsets:
                aliases.setdefault(name, name_of[synset])
    return synsets, aliases


def _taxonomy(root: Path | None) -> dict[str, list[str]]:
    """Read ``{synset: names}`` of the download's ``taxonomy.json``, or nothing without one.

    Raises:
        DatasetNotFoundError: The file is there but is not a taxonomy.
    """
    path = root / "taxonomy.json" if root is not None else None
    if path is None or not path.is_file():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {
            str(entry["synsetId"]): [
                canonical_class_name(safe_name(name)) for name in entry["name"].split(",")
            ]
            for entry in entries
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetNotFoundError(
            f"{path} is not ShapeNet's taxonomy ({error!r}); unpack it again, or remove it to use "
            "the built-in names."
        ) from error
