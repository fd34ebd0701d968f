import logging

import pytest

from i2i.data.sources.modelnet40 import (
    POSE_CLASSES,
    TRAIN_COUNTS,
    ModelNet40,
    modelnet_edition,
    write_marker,
)
from i2i.errors import DatasetNotFoundError

TRIANGLE = "OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def make(root, folders, *, train=2, test=1):
    for folder in folders:
        for split, count in (("train", train), ("test", test)):
            (root / folder / split).mkdir(parents=True)
            for number in range(count):
                (root / folder / split / f"{folder}_{number:04d}.off").write_text(TRIANGLE)
    return root


def test_the_official_counts():
    assert len(TRAIN_COUNTS) == 40
    assert sum(TRAIN_COUNTS.values()) == 9843
    assert set(POSE_CLASSES) <= set(TRAIN_COUNTS)
    assert len(POSE_CLASSES) == 10


def test_official_split_order_and_loading(tmp_path):
    source = ModelNet40(make(tmp_path / "aligned", ["chair", "desk"]))
    items = source.items(["desk", "chair"])
    assert [(i.class_name, i.split) for i in items] == [
        ("desk", "train"), ("desk", "train"), ("desk", "test"),
        ("chair", "train"), ("chair", "train"), ("chair", "test"),
    ]  # fmt: skip
    assert source.up_axis == "z"
    assert source.load(items[0]).area == pytest.approx(0.5)
    assert items == ModelNet40(tmp_path / "aligned").items(["desk", "chair"])


@pytest.mark.parametrize("folder", ["night_stand", "night-stand", "Night_Stand"])
@pytest.mark.parametrize("asked", ["night_stand", "night-stand"])
def test_two_word_classes_are_found_however_they_are_written(tmp_path, folder, asked):
    items = ModelNet40(make(tmp_path / "aligned", [folder])).items([asked])
    assert {item.class_name for item in items} == {"night_stand"}
    assert len(items) == 3


def test_symmetry_of_the_pose_classes():
    source = ModelNet40("anywhere")
    assert {name for name, kind in source.symmetry.items() if kind == "z"} == {
        "bottle", "bowl", "cone", "cup", "stool", "vase",
    }  # fmt: skip


def test_unknown_classes_and_missing_folders_tell_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"spaceship.*airplane, bathtub"):
        ModelNet40(tmp_path).items(["spaceship"])
    with pytest.raises(DatasetNotFoundError, match=r"i2i\.download data=modelnet40"):
        ModelNet40(tmp_path / "no").items(["desk"])
    with pytest.raises(DatasetNotFoundError, match=r"data\.root"):
        ModelNet40().items(["desk"])
    make(tmp_path / "inner", ["desk"])
    with pytest.raises(DatasetNotFoundError, match=f"deeper: data.root={tmp_path}/inner"):
        ModelNet40(tmp_path).items(["desk"])
    with pytest.raises(DatasetNotFoundError, match="no folder for chair; it has: desk"):
        ModelNet40(tmp_path / "inner").items(["chair"])
    (tmp_path / "inner" / "sofa").mkdir()
    with pytest.raises(DatasetNotFoundError, match=r"no train/\*\.off"):
        ModelNet40(tmp_path / "inner").items(["sofa"])


def test_the_common_zip_is_refused_unless_told_otherwise(tmp_path, caplog):
    common = make(tmp_path / "ModelNet40", ["desk"])
    with pytest.raises(DatasetNotFoundError, match="not aligned"):
        ModelNet40(common).items(["desk"])
    with caplog.at_level(logging.WARNING):
        assert len(ModelNet40(common, assume_aligned=True).items(["desk"])) == 3
    assert "aligned" not in caplog.text
    beside = make(tmp_path / "below" / "meshes", ["desk"])
    (tmp_path / "below" / "ModelNet40.zip").touch()
    assert modelnet_edition(beside) == "not aligned"


def test_the_edition_is_said_to_be_unknown_where_nothing_tells_it(tmp_path, caplog):
    root = make(tmp_path / "meshes", ["desk"])
    assert modelnet_edition(root) == "unknown"
    ModelNet40(root).items(["desk"])
    assert "not aligned" in caplog.text
    caplog.clear()
    write_marker(root, archive="modelnet40_manually_aligned.tar")
    ModelNet40(root).items(["desk"])
    assert "not aligned" not in caplog.text
    write_marker(root, archive="ModelNet40.zip", alignment="none")
    assert modelnet_edition(root) == "not aligned"
    (tmp_path / "unaligned").mkdir()
    assert modelnet_edition(tmp_path / "unaligned") == "unknown"


def test_counts_that_differ_from_the_official_ones_are_noticed(tmp_path, caplog):
    ModelNet40(make(tmp_path / "aligned", ["desk"])).items(["desk"])
    assert "desk has 2 training meshes; the official split has 200" in caplog.text
