"""The rendered store: rows of one class and split as plain arrays on disk, with a card.

A store is the folder ``<root>/<source>/<key>/<class>/<split>/``. Its main array (images, points or
view sets) is opened as a memory map. Its rows are ordered by object and view. The folder appears
under its name only when all of it is written, so whatever carries the name is whole.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from i2i.data.content import content_of
from i2i.errors import StoreError, StoreMismatchError

SCHEMA_VERSION = 1
CARD = "card.json"
LABELS = ("rotations", "instances", "views")


@dataclass(frozen=True)
class StoreSettings:
    """Everything that decides what the rows of a store hold, but for the meshes.

    Attributes:
        source: Name of the mesh source.
        up_axis: Axis of its meshes that points up.
        renderer: Name of the renderer, with its options if it has any.
        renderer_version: Its version; None if it is not installed, then it is not compared.
        camera_distance: Distance from the camera to the object's centre, in object radii.
        camera_fov_deg: Full field of view, in degrees.
        modality: A key of `i2i.data.info.CHANNELS`.
        image_size: Height and width in pixels of what is drawn: images, views, or the depth images
            behind partial clouds; 0 where nothing is drawn.
        seed: Seed of the views.
        num_points: Points of a cloud; None where there are none.
        camera_set: Camera set of the views; None where there is none.
    """

    source: str
    up_axis: str
    renderer: str
    renderer_version: str | None
    camera_distance: float
    camera_fov_deg: float
    modality: str
    image_size: int
    seed: int
    num_points: int | None = None
    camera_set: str | None = None

    def told(self) -> dict[str, Any]:
        """Fields as a card tells them; those that the modality does not have are left out."""
        fields = asdict(self)
        return {k: v for k, v in fields.items() if v is not None or k == "renderer_version"}

    @property
    def key(self) -> str:
        """Folder name of these settings; versions are left out, they are checked in the card."""
        fixed = {**self.told(), "renderer_version": None, "schema": SCHEMA_VERSION}
        digest = hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:8]
        size = f"{self.image_size}px" if self.num_points is None else f"{self.num_points}"
        name = self.renderer.partition(":")[0]  # its options are in the digest
        return f"{self.modality}_{size}_{name}_{digest}"

    def folder(self, root: str | os.PathLike[str], class_name: str, split: str) -> Path:
        """Folder of the store of one class and split."""
        return Path(root) / self.source / self.key / class_name / split


@dataclass(frozen=True)
class StoredRun:
    """Consecutive views of one object, as they are put into a store.

    Attributes:
        instance_id: Name of the object.
        first_view: Number of the first view.
        content: Main array, shape (N, ...): see `i2i.data.content`.
        rotations: Object to camera, shape (N, 3, 3), float64.
    """

    instance_id: str
    first_view: int
    content: np.ndarray
    rotations: np.ndarray


@dataclass(frozen=True)
class RenderedStore:
    """An opened store; ``content`` is a memory map.

    Attributes:
        path: Folder of the store.
        card: Contents of ``card.json``.
        content: Images (N, C, H, W), uint8, background 255; points (N, P, 3), float32, in camera
            axes and object radii; or view sets (N, V, C, H, W), uint8.
        rotations: Object to camera, shape (N, 3, 3), float64.
        instances: Index into ``card["items"]`` of each row, shape (N,), int32.
        views: Number of the view of each row, shape (N,), int32.
    """

    path: Path
    card: dict[str, Any]
    content: np.ndarray
    rotations: np.ndarray
    instances: np.ndarray
    views: np.ndarray

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], *, expected: StoreSettings | None = None
    ) -> RenderedStore:
        """Open a store and check it cheaply: settings, shapes, types and file sizes.

        Args:
            path: Folder of the store.
            expected: Settings that it must have been made with; None to accept any.

        Raises:
            StoreError: if there is no whole store.
            StoreMismatchError: if it was made with other settings.
        """
        folder = Path(path)
        card = read_card(folder)
        if card is None:
            raise StoreError(
                f"There is no rendered store in {folder}. Make it with `python -m i2i.render` and "
                "the same data settings."
            )
        if expected is not None:
            check_settings(card, expected, folder)
        content = _open_array(folder, card, content_of(card["settings"]).name, mmap_mode="r")
        labels = {name: _open_array(folder, card, name) for name in LABELS}
        return cls(path=folder, card=card, content=content, **labels)

    @property
    def instance_ids(self) -> list[str]:
        """Names of the objects; ``instances`` is an index into it."""
        return [item["id"] for item in self.card["items"]]

    def rows(self, instance_ids: Sequence[str], *, views: range) -> np.ndarray:
        """Rows of some objects and views, in the order of the objects, shape (N,), int64.

        Raises:
            StoreError: if the store lacks one of the objects or views.
        """
        position = {name: number for number, name in enumerate(self.instance_ids)}
        bounds = np.searchsorted(self.instances, np.arange(len(position) + 1))
        chosen = []
        for name in instance_ids:
            number = position.get(name)
            if number is None or bounds[number + 1] - bounds[number] < views.stop:
                raise StoreError(
                    f"The store {self.path} lacks {views.stop} views of {name}. "
                    "Render them with `python -m i2i.render` and the same data settings."
                )
            chosen.append(bounds[number] + np.arange(views.start, views.stop))
        return np.concatenate(chosen) if chosen else np.zeros(0, np.int64)

    def verify(self) -> None:
        """Read every byte and compare checksums with the card.

        Raises:
            StoreError: naming the first file that differs.
        """
        for name in self.card["arrays"]:
            file = self.path / f"{name}.npy"
            with file.open("rb") as stream:
                found = hashlib.file_digest(stream, "sha256").hexdigest()
            if found != self.card["arrays"][name]["sha256"]:
                raise StoreError(
                    f"{file} is damaged: its checksum is not the one in {CARD}. Delete the folder "
                    f"{self.path} and run `python -m i2i.render` again."
                )


def read_card(folder: Path) -> dict[str, Any] | None:
    """Card of the store in a folder; None if there is no whole store.

    Raises:
        StoreError: if the card is not one.
    """
    try:
        card = json.loads((folder / CARD).read_text())
    except FileNotFoundError:
        return None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise StoreError(f"{folder / CARD} is damaged ({error}). Delete {folder}.") from error
    if card.get("schema") != SCHEMA_VERSION:
        raise StoreMismatchError(_mismatch(folder, "schema", SCHEMA_VERSION, card.get("schema")))
    return card


def check_settings(card: dict[str, Any], expected: StoreSettings, folder: Path) -> None:
    """Compare a card with the settings asked for.

    Raises:
        StoreMismatchError: naming the first field that differs.
    """
    for field, asked in asdict(expected).items():
        there = card["settings"].get(field)
        if there != asked and not (field == "renderer_version" and asked is None):
            raise StoreMismatchError(_mismatch(folder, field, asked, there))


def _mismatch(folder: Path, field: str, asked: object, there: object) -> str:
    return (
        f"The rendered store {folder} was made with {field}={there!r}, but {field}={asked!r} is "
        "asked for. Render it again with `python -m i2i.render ... overwrite=true` and the same "
        "data settings, or keep both with another `paths.data_dir=...`."
    )


def mesh_mismatch(folder: Path, instance_id: str) -> StoreMismatchError:
    """The error for an object whose mesh file is not the one that was rendered."""
    return StoreMismatchError(
        f"The mesh of {instance_id} is another one than the rendered store {folder} was made from. "
        "Render it again with `python -m i2i.render ... overwrite=true` and the same data "
        "settings, or keep both with another `paths.data_dir=...`."
    )


def _open_array(
    folder: Path, card: dict[str, Any], name: str, mmap_mode: Literal["r"] | None = None
) -> np.ndarray:
    """Open one array and compare it with the card."""
    file, told = folder / f"{name}.npy", card["arrays"][name]
    try:
        size = file.stat().st_size
        # NumPy would map a truncated file without complaint until a missing page is touched.
        if size != told["bytes"]:
            raise ValueError(f"it has {size} bytes instead of {told['bytes']}")
        array = np.load(file, mmap_mode=mmap_mode)
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{file} cannot be used: {error}. Delete the folder {folder} and run "
            "`python -m i2i.render` again."
        ) from error
    if list(array.shape) != told["shape"] or array.dtype.str != told["dtype"]:
        raise StoreError(
            f"{file} holds {array.dtype} {array.shape}, the card says {told['dtype']} "
            f"{told['shape']}. Delete the folder {folder} and run `python -m i2i.render` again."
        )
    return array


def write_store(
    folder: Path, card: dict[str, Any], runs: Iterable[StoredRun], *, num_rows: int
) -> None:
    """Write a whole store next to its place, then put it there, replacing an older one.

    Args:
        folder: Folder of the store.
        card: Card without ``counts`` and ``arrays``; ``card["items"]`` in the order of the rows.
        runs: Content and rotations in the order of the rows; read once, one at a time.
        num_rows: Number of rows in all runs.

    Raises:
        OSError: if the disk is full; what was there before is untouched.
    """
    temporary = folder.parent / f".{folder.name}.new-{os.getpid()}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        arrays = _write_arrays(temporary, card, runs, num_rows)
        name = content_of(card["settings"]).name
        rows = "images" if name == "images" else "rows"
        counts = {rows: num_rows, "items": len(card["items"]), "skipped": len(card["skipped"])}
        text = json.dumps({**card, "counts": counts, "arrays": arrays}, indent=1, sort_keys=True)
        with (temporary / CARD).open("wb") as stream:
            stream.write(text.encode() + b"\n")
            _sync(stream)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _replace(temporary, folder)


def _write_arrays(
    folder: Path, card: dict[str, Any], runs: Iterable[StoredRun], num_rows: int
) -> dict[str, dict[str, Any]]:
    """Write the four arrays; returns what the card says about them."""
    number = {item["id"]: index for index, item in enumerate(card["items"])}
    content = content_of(card["settings"])
    rotations = np.zeros((num_rows, 3, 3))
    instances = np.zeros(num_rows, np.int32)
    views = np.zeros(num_rows, np.int32)

    def content_bytes() -> Iterator[bytes]:
        row = 0
        for run in runs:
            here = slice(row, row + len(run.content))
            rotations[here] = run.rotations
            instances[here] = number[run.instance_id]
            views[here] = run.first_view + np.arange(len(run.content))
            row = here.stop
            yield np.ascontiguousarray(run.content, content.dtype).tobytes()
        if row != num_rows:
            raise AssertionError(f"{row} rows came for a store of {num_rows}")

    shape, main = (num_rows, *content.shape), folder / f"{content.name}.npy"
    told = {content.name: _write_array(main, shape, content.dtype, content_bytes())}
    for name, array in (("rotations", rotations), ("instances", instances), ("views", views)):
        file = folder / f"{name}.npy"
        told[name] = _write_array(file, array.shape, array.dtype, [array.tobytes()])
    return told


def _write_array(
    file: Path, shape: tuple[int, ...], dtype: np.dtype, parts: Iterable[bytes]
) -> dict[str, Any]:
    """Write an ``.npy`` file piece by piece.

    Ordinary writes, not a memory map: on a full disk they raise an error instead of a signal.
    """
    header = io.BytesIO()
    description = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, description)
    digest, size = hashlib.sha256(), 0
    with file.open("wb") as stream:
        for part in itertools.chain([header.getvalue()], parts):
            stream.write(part)
            digest.update(part)
            size += len(part)
        _sync(stream)
    return {"shape": list(shape), "dtype": dtype.str, "bytes": size, "sha256": digest.hexdigest()}


def _sync(stream: BinaryIO) -> None:
    """Make sure that the bytes are on the disk before the folder gets its name."""
    stream.flush()
    os.fsync(stream.fileno())


def _replace(temporary: Path, folder: Path) -> None:
    """Put a finished folder in its place; `recover` undoes it if only half of it happens."""
    old = _old(folder)
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    temporary.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def recover(folder: Path) -> None:
    """Put the former store back if a replacement was cut off between its two renames.

    Only for who holds the lock of the store: another process may be just between the two.
    """
    old = _old(folder)
    if not folder.exists() and (old / CARD).exists():
        old.rename(folder)


def _old(folder: Path) -> Path:
    return folder.parent / f".{folder.name}.old"
