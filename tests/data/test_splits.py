"""Splits by object: disjoint, grouped, reproducible."""

import logging

import pytest

from i2i.data.sources.base import MeshItem
from i2i.data.splits import class_modes, split_items


def make(count, *, name="chair", per_group=1, official=None):
    return [
        MeshItem(name, f"{i:03d}", official and official(i), f"g{i // per_group}", f"{i}.off")
        for i in range(count)
    ]


def names(items):
    return {(item.class_name, item.instance_id) for item in items}


@pytest.mark.parametrize("val_fraction", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("count", [3, 4, 10, 57])
def test_no_object_in_two_splits_and_none_lost(count, val_fraction):
    items = make(count)
    parts = split_items(items, test_fraction=0.2, val_fraction=val_fraction, seed=1)
    assert sum(map(len, parts.values())) == count
    assert names(parts["train"]) | names(parts["val"]) | names(parts["test"]) == names(items)
    assert parts["train"]
    assert parts["test"]
    assert bool(parts["val"]) == (val_fraction > 0)


def test_fractions_are_met():
    parts = split_items(make(200), test_fraction=0.2, val_fraction=0.1, seed=0)
    assert {name: len(part) for name, part in parts.items()} == {
        "train": 144,
        "val": 16,
        "test": 40,
    }


@pytest.mark.parametrize("options", [{}, {"fold": 0}, {"fold": 2}])
def test_groups_stay_on_one_side(options):
    items = make(60, per_group=4)
    parts = split_items(items, test_fraction=0.3, val_fraction=0.2, seed=3, **options)
    groups = [{item.group for item in part} for part in parts.values()]
    assert sum(map(len, groups)) == len(set.union(*groups)) == 15


def test_seed_changes_the_split_and_nothing_else_does():
    items = make(50)
    first = split_items(items, seed=0)
    assert names(split_items(items, seed=0)["test"]) == names(first["test"])
    assert names(split_items(items[::-1], seed=0)["test"]) == names(first["test"])
    assert names(split_items(items, seed=1)["test"]) != names(first["test"])
    joint = split_items([*make(9, name="bench"), *items], seed=0)
    assert {n for n in names(joint["test"]) if n[0] == "chair"} == names(first["test"])


def test_official_split_is_kept_and_validation_comes_from_training():
    items = make(20, official=lambda i: "test" if i < 5 else "train")
    parts = split_items(items, test_fraction=0.9, val_fraction=0.2, seed=0)
    assert names(parts["test"]) == names(items[:5])
    assert len(parts["val"]) == 3
    assert names(parts["val"]) <= names(items[5:])


def test_folds_cover_every_object_once():
    items = make(31, per_group=2)
    tests = [names(split_items(items, fold=fold, folds=3, seed=2)["test"]) for fold in range(3)]
    assert sum(map(len, tests)) == 31
    assert set.union(*tests) == names(items)
    assert max(map(len, tests)) - min(map(len, tests)) <= 2


@pytest.mark.parametrize("count", [1, 2])
def test_few_objects_are_split_by_view_with_a_notice(count, caplog):
    with caplog.at_level(logging.WARNING):
        parts = split_items(make(count), val_fraction=0.1)
    assert names(parts["train"]) == names(parts["val"]) == names(parts["test"])
    assert "chair" in caplog.text
    assert "data.split=view" in caplog.text


def test_duplicates_count_as_one_object():
    assert class_modes(make(8, per_group=4)) == {"chair": "view"}
    assert class_modes(make(12, per_group=4)) == {"chair": "instance"}


def test_view_on_request_is_no_notice(caplog):
    parts = split_items(make(5), split="view")
    assert names(parts["train"]) == names(parts["test"])
    assert parts["val"] == []
    assert not caplog.text


@pytest.mark.parametrize(
    "options",
    [
        {"split": "random"},
        {"test_fraction": 1.0},
        {"val_fraction": -0.1},
        {"fold": 3},
        {"fold": 0, "folds": 1},
        {"fold": 0, "folds": 11},
    ],
)
def test_bad_settings_are_refused(options):
    with pytest.raises(ValueError, match=r"data\."):
        split_items(make(10), **options)


def test_folds_of_an_official_split_are_refused():
    items = make(10, official=lambda i: "test" if i < 3 else "train")
    with pytest.raises(ValueError, match="official split"):
        split_items(items, fold=0)
