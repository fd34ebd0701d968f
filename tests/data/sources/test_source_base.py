import pickle

import pytest

from i2i.data.sources.base import (
    Z_SYMMETRIC_CLASSES,
    MeshItem,
    canonical_class_name,
    check_up_axis,
    resolve_symmetry,
    safe_name,
)


def test_the_published_list_of_symmetric_classes():
    assert {"bottle", "cup", "stool", "cone", "bowl", "vase"} == Z_SYMMETRIC_CLASSES


def test_items_survive_pickling():
    item = MeshItem("chair", "a", "train", "g", "x.off", licence="CC0", author="me")
    assert pickle.loads(pickle.dumps(item)) == item


@pytest.mark.parametrize("written", ["night_stand", "night-stand", "Night Stand", "NIGHT-STAND "])
def test_spellings_of_a_class_are_one(written):
    assert canonical_class_name(written) == "night_stand"


@pytest.mark.parametrize("name", ["a b", "../x", "ä/ö", "(1)", "...", "part=3,4", "x'y\"z"])
def test_safe_names_hold_nothing_that_a_folder_or_hydra_trips_over(name):
    cleaned = safe_name(name)
    assert cleaned
    assert set(cleaned) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
    assert not cleaned.startswith(".")


def test_symmetry_settings():
    assert resolve_symmetry(["bottle", "car"]) == {"bottle": "z", "car": "none"}
    assert resolve_symmetry(["bottle", "car"], "none") == {"bottle": "none", "car": "none"}
    assert resolve_symmetry(["bottle", "car"], {"car": "z"}) == {"bottle": "z", "car": "z"}
    with pytest.raises(ValueError, match="none, z"):
        resolve_symmetry(["car"], {"car": "x"})
    with pytest.raises(ValueError, match="boat"):
        resolve_symmetry(["car"], {"boat": "z"})


def test_up_axis_names_the_allowed_ones():
    assert check_up_axis("-y") == "-y"
    with pytest.raises(ValueError, match="x, y, z, -x, -y, -z"):
        check_up_axis("up")
