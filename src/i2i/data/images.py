"""The user's own labelled pictures: a folder and a CSV, as the arrays of a rendered store."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2i.data.photographs import prepare_photograph
from i2i.data.sources.base import canonical_class_name, safe_name
from i2i.errors import ConfigurationError, DatasetNotFoundError, ImageError

_CHANNELS = {"gray": 1, "depth": 1, "rgb": 3}
_NAMED = ("qx", "qy", "qz", "qw")
_NUMBERED = ("q0", "q1", "q2", "q3")
_UNIT_TOLERANCE = 1e-2  # quaternions written with two decimals still pass


class LabelledImages(NamedTuple):
    """Pictures and labels, in the order of the CSV.

    Attributes:
        images: Shape (N, C, S, S), uint8, white background.
        rotations: Shape (N, 3, 3), float64, object to camera.
        class_names: Classes, sorted, or in the order that was asked for.
        class_ids: Shape (N,), int64, index into ``class_names``.
        file_names: N names as the CSV writes them.
    """

    images: np.ndarray
    rotations: np.ndarray
    class_names: tuple[str, ...]
    class_ids: np.ndarray
    file_names: tuple[str, ...]


def read_labelled_images(
    root: str | Path,
    csv_file: str | Path,
    *,
    image_size: int,
    modality: str,
    classes: Sequence[str] | None = None,
    quaternion_order: str | None = None,
) -> LabelledImages:
    """Read pictures that are labelled by a CSV file.

    The header names the columns ``file``, ``class`` (may be missing when ``classes`` names exactly
    one) and the quaternion's: either ``qx, qy, qz, qw``, in any order, or ``q0, q1, q2, q3``, whose
    order ``quaternion_order`` must tell. The quaternion is the rotation object → camera, with
    the camera's x right, y up and z towards the viewer. A picture is squared, padded with white and
    scaled exactly as ``predict`` does it.

    Args:
        root: Folder that file names are relative to.
        csv_file: The table; a relative path is looked up in ``root`` first.
        image_size: Side S of the result in pixels.
        modality: ``rgb`` keeps colours; ``gray`` takes their mean; ``depth`` takes pictures whose
            values already are the project's depth coding.
        classes: Classes to keep, in this order; ``None`` keeps all, sorted.
        quaternion_order: Order of ``q0 ... q3``: ``"xyzw"`` or ``"wxyz"``.

    Raises:
        DatasetNotFoundError: The folder, the CSV, or a picture is not there.
        ConfigurationError: Columns are missing, a value cannot be read, a quaternion is not a
            unit one, or no row is left.
        ImageError: A file is not a picture.
    """
    if modality not in _CHANNELS:
        raise ConfigurationError(
            f"modality={modality!r} is unknown; allowed: {', '.join(_CHANNELS)}."
        )
    root = Path(root).expanduser()
    table = _find_table(root, Path(csv_file).expanduser())
    if quaternion_order not in (None, "xyzw", "wxyz"):
        raise ConfigurationError(
            f"quaternion_order={quaternion_order!r} is unknown; allowed: xyzw, wxyz."
        )
    rows = _read_rows(table)
    columns = _quaternion_columns(rows[0][1], quaternion_order, table)
    names, kept = _select(rows, classes, table)
    rotations = np.stack([_rotation(row, columns, f"{table}, line {line}") for line, row in kept])
    files = tuple(row["file"] for _, row in kept)
    missing = [name for name in files if not (root / name).is_file()]
    if missing:
        raise DatasetNotFoundError(
            f"{len(missing)} pictures of {table} are not in {root}, the first is {missing[0]}: "
            "set data.root=<the folder that the file column is relative to>."
        )
    images = np.stack([_read_image(root / name, image_size, modality) for name in files])
    ids = np.array([names.index(_class_of(row, names)) for _, row in kept], dtype=np.int64)
    return LabelledImages(images, rotations, names, ids, files)


def _find_table(root: Path, path: Path) -> Path:
    if not root.is_dir():
        raise DatasetNotFoundError(f"{root} is not a folder: set data.root=<folder of pictures>.")
    for candidate in (root / path, path):
        if candidate.is_file():
            return candidate
    raise DatasetNotFoundError(
        f"{path} is neither in {root} nor here: set data.csv=<table with the columns file, class, "
        "qx, qy, qz, qw>."
    )


def _read_rows(table: Path) -> list[tuple[int, dict[str, str]]]:
    """Return (line number, row) pairs with stripped lower-case column names."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, skipinitialspace=True)
            header = [name.strip().lower() for name in reader.fieldnames or []]
            reader.fieldnames = header
            rows = [(reader.line_num, row) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"{table} is not a CSV file in UTF-8 ({error}).") from error
    if "file" not in header:
        raise ConfigurationError(
            f"{table} has no column file; its header is: {', '.join(header) or '(empty)'}. "
            "Expected: file, class, qx, qy, qz, qw."
        )
    if not rows:
        raise ConfigurationError(f"{table} has a header but no rows.")
    for line, row in rows:
        if None in row or None in row.values():
            raise ConfigurationError(
                f"{table}, line {line}: the number of values differs from the header's "
                f"{len(header)} columns."
            )
    return [(line, {key: value.strip() for key, value in row.items()}) for line, row in rows]


def _quaternion_columns(row: Mapping[str, str], order: str | None, table: Path) -> tuple[str, ...]:
    """Return the names of the columns of x, y, z and w."""
    if all(name in row for name in _NAMED):
        return _NAMED
    if all(name in row for name in _NUMBERED):
        if order == "xyzw":
            return _NUMBERED
        if order == "wxyz":
            return ("q1", "q2", "q3", "q0")
        raise ConfigurationError(
            f"{table} names its quaternion q0, q1, q2, q3, which does not tell the order: set "
            "data.quaternion_order=xyzw or data.quaternion_order=wxyz."
        )
    raise ConfigurationError(
        f"{table} has no quaternion columns; its header is: {', '.join(row)}. Expected qx, qy, qz, "
        "qw (in any order), or q0, q1, q2, q3 with data.quaternion_order=xyzw or wxyz."
    )


def _class_of(row: Mapping[str, str], classes: Sequence[str] | None) -> str:
    if "class" not in row and classes is not None and len(classes) == 1:
        return classes[0]
    return canonical_class_name(safe_name(row["class"]))


def _select(
    rows: list[tuple[int, dict[str, str]]], classes: Sequence[str] | None, table: Path
) -> tuple[tuple[str, ...], list[tuple[int, dict[str, str]]]]:
    """Return the class names and the rows that belong to them."""
    wanted = None if classes is None else [canonical_class_name(name) for name in classes]
    if "class" not in rows[0][1] and (wanted is None or len(wanted) != 1):
        raise ConfigurationError(
            f"{table} has no column class: add one, or name the only class with data.object=<name>."
        )
    found = sorted({_class_of(row, wanted) for _, row in rows})
    names = tuple(dict.fromkeys(wanted)) if wanted is not None else tuple(found)
    unknown = [name for name in names if name not in found]
    if unknown or not names:
        raise ConfigurationError(
            f"{table} has no picture of {', '.join(unknown) or '(no class)'}; it has: "
            f"{', '.join(found)}. Choose with data.object=<class>."
        )
    return names, [(line, row) for line, row in rows if _class_of(row, names) in names]


def _rotation(row: Mapping[str, str], columns: Sequence[str], where: str) -> np.ndarray:
    try:
        quaternion = np.array([float(row[name]) for name in columns])
    except ValueError as error:
        raise ConfigurationError(f"{where}: a quaternion value is no number ({error}).") from error
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) <= _UNIT_TOLERANCE:  # also refuses NaN
        raise ConfigurationError(
            f"{where}: the quaternion {', '.join(row[name] for name in columns)} has length "
            f"{norm:.4g}; a rotation needs length 1. Are these really {', '.join(columns)}?"
        )
    return Rotation.from_quat(quaternion).as_matrix()


def _read_image(path: Path, image_size: int, modality: str) -> np.ndarray:
    """Return one picture, shape (C, S, S), uint8."""
    try:
        prepared = prepare_photograph(path, channels=_CHANNELS[modality], image_size=image_size)
    except OSError as error:
        raise ImageError(f"{path} cannot be read as a picture ({error}).") from error
    return np.rint(prepared.tensor[0].numpy() * 255.0).astype(np.uint8)
