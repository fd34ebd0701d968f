"""Which objects are for training, validation and test.

Objects of one group (near-duplicates) always stay on one side. Classes are split one by one, so a
class has the same split whether it is trained alone or with others.
"""

from __future__ import annotations

import hashlib
import logging
from collections import defaultdict
from collections.abc import Iterable, Sequence

from i2i.data.sources.base import MeshItem

log = logging.getLogger(__name__)

SPLIT_MODES = ("instance", "view")
MIN_GROUPS = 3
"""A class with fewer different objects is split by view."""

Splits = dict[str, list[MeshItem]]


def split_items(
    items: Sequence[MeshItem],
    *,
    split: str = "instance",
    test_fraction: float = 0.2,
    val_fraction: float = 0.0,
    seed: int = 0,
    fold: int | None = None,
    folds: int = 3,
) -> Splits:
    """Divide objects into train, val and test.

    An official split is kept, and validation is carved from its training part. In classes that are
    split by view (see `class_modes`) every object is in train and test, and in val if one is asked
    for; their views are disjoint because train and test views have seeds of their own.

    Args:
        items: Objects of one or more classes.
        split: ``"instance"`` or ``"view"``.
        test_fraction: Share of the objects for test, where there is no official split.
        val_fraction: Share of the remaining objects for validation.
        seed: Seed of the choice.
        fold: Number of the cross-validation fold that is the test set; None for none.
        folds: Number of folds.

    Returns:
        Objects of ``"train"``, ``"val"`` and ``"test"``, each in the order of ``items``.

    Raises:
        ValueError: if a setting is out of range, or folds are asked of an official split.
    """
    _check(split, test_fraction, val_fraction, fold, folds)
    modes = class_modes(items, split=split)
    result: Splits = {"train": [], "val": [], "test": []}
    for name, members in _by_class(items).items():
        if modes[name] == "view":
            # A unique object per split and view; validation views are carved by the data module.
            for part in ("train", "test", *(("val",) if val_fraction > 0 else ())):
                result[part] += members
            continue
        train, test = _test_part(members, test_fraction, val_fraction, seed, fold, folds)
        chosen = _take_groups(train, val_fraction, seed, purpose="val", leave=1)
        if val_fraction > 0 and not chosen:
            log.warning("Class %s has too few training objects for a validation part.", name)
        result["train"] += [item for item in train if item.group not in chosen]
        result["val"] += [item for item in train if item.group in chosen]
        result["test"] += test
    return result


def class_modes(
    items: Sequence[MeshItem], *, split: str = "instance", notice: bool = True
) -> dict[str, str]:
    """How each class is split: ``"view"`` if asked for or if it has too few different objects.

    Args:
        items: Objects of one or more classes.
        split: What is asked for.
        notice: Tell of classes for which it is changed.

    Returns:
        ``"instance"`` or ``"view"`` for each class name.
    """
    modes = {}
    for name, members in _by_class(items).items():
        groups = len({item.group for item in members})
        too_few = split == "instance" and groups < MIN_GROUPS and not _has_official(members)
        if too_few and notice:
            log.warning(
                "Class %s has %d different object(s): training and test use the same objects, seen "
                "from different views (data.split=view). Errors on new objects will be larger.",
                name,
                groups,
            )
        modes[name] = "view" if too_few else split
    return modes


def _check(
    split: str, test_fraction: float, val_fraction: float, fold: int | None, folds: int
) -> None:
    if split not in SPLIT_MODES:
        raise ValueError(f"data.split={split} is not known. Allowed: {', '.join(SPLIT_MODES)}.")
    for name, value in (("test_fraction", test_fraction), ("val_fraction", val_fraction)):
        if not 0 <= value < 1:
            raise ValueError(f"data.{name}={value} is not allowed: it must be in [0, 1).")
    if fold is not None and not (folds >= 2 and 0 <= fold < folds):
        raise ValueError(
            f"data.fold={fold} of data.folds={folds} is not allowed: give at least 2 folds and a "
            "fold from 0 to folds − 1."
        )


def _by_class(items: Iterable[MeshItem]) -> dict[str, list[MeshItem]]:
    classes: dict[str, list[MeshItem]] = defaultdict(list)
    for item in items:
        classes[item.class_name].append(item)
    return dict(classes)


def _has_official(members: Sequence[MeshItem]) -> bool:
    """Whether the source itself names training and test objects of this class."""
    return {"train", "test"} <= {item.split for item in members}


def _test_part(
    members: Sequence[MeshItem],
    test_fraction: float,
    val_fraction: float,
    seed: int,
    fold: int | None,
    folds: int,
) -> tuple[list[MeshItem], list[MeshItem]]:
    """Divide one class into training (with validation) and test objects."""
    if _has_official(members):
        if fold is not None:
            raise ValueError(
                f"Class {members[0].class_name} has an official split, so data.fold={fold} has no "
                "meaning: leave it out."
            )
        return (
            [item for item in members if item.split != "test"],
            [item for item in members if item.split == "test"],
        )
    if fold is not None:
        test_groups = _fold_groups(members, fold, folds, seed)
    else:
        leave = 2 if val_fraction > 0 else 1
        test_groups = _take_groups(members, test_fraction, seed, purpose="test", leave=leave)
    return (
        [item for item in members if item.group not in test_groups],
        [item for item in members if item.group in test_groups],
    )


def _rank(seed: int, purpose: str, class_name: str, group: str) -> str:
    """Position of a group in a random order; new groups do not disturb the others."""
    return hashlib.sha256(f"{seed}|{purpose}|{class_name}|{group}".encode()).hexdigest()


def _shuffled_groups(members: Sequence[MeshItem], seed: int, purpose: str) -> list[tuple[str, int]]:
    """Groups of one class in random order, with the number of their objects."""
    sizes: dict[str, int] = defaultdict(int)
    for item in members:
        sizes[item.group] += 1
    class_name = members[0].class_name if members else ""
    return sorted(sizes.items(), key=lambda pair: _rank(seed, purpose, class_name, pair[0]))


def _take_groups(
    members: Sequence[MeshItem], fraction: float, seed: int, *, purpose: str, leave: int
) -> set[str]:
    """Choose random groups that hold about a fraction of the objects.

    At least one group is taken and at least ``leave`` groups are left, if there are enough.
    """
    groups = _shuffled_groups(members, seed, purpose)
    target = fraction * len(members)
    chosen: set[str] = set()
    count = 0
    for group, size in groups[: max(0, len(groups) - leave)] if fraction > 0 else []:
        # Stop where one more group would miss the target by more than stopping does.
        if chosen and abs(count + size - target) >= abs(count - target):
            break
        chosen.add(group)
        count += size
    return chosen


def _fold_groups(members: Sequence[MeshItem], fold: int, folds: int, seed: int) -> set[str]:
    """Groups of one cross-validation fold; the folds hold about equally many objects."""
    groups = _shuffled_groups(members, seed, "fold")
    if len(groups) < folds:
        raise ValueError(
            f"Class {members[0].class_name} has {len(groups)} group(s) of objects, too few for "
            f"data.folds={folds}: use fewer folds."
        )
    loads = [0] * folds
    chosen: set[str] = set()
    # Largest groups first; sorting is stable, so equal sizes stay in random order.
    for group, size in sorted(groups, key=lambda pair: -pair[1]):
        lightest = loads.index(min(loads))
        loads[lightest] += size
        if lightest == fold:
            chosen.add(group)
    return chosen
