import pytest
import trimesh

from i2i.data.sources.meshes import Meshes
from i2i.errors import ConfigurationError, DatasetNotFoundError


def box(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box().export(path)
    return path


def test_class_folders_with_the_split_in_them(tmp_path):
    box(tmp_path / "Gear Box" / "train" / "a.stl")
    box(tmp_path / "Gear Box" / "test" / "a.stl")
    box(tmp_path / "bolt" / "b.ply")
    source = Meshes(tmp_path)
    assert source.classes == ("bolt", "gear_box")
    assert [(i.split, i.instance_id) for i in source.items(["gear-box"])] == [
        ("train", "train-a_stl"),
        ("test", "test-a_stl"),
    ]
    assert [i.split for i in source.items(["bolt"])] == [None]
    assert source.load(source.items(["bolt"])[0]).area == pytest.approx(6.0)
    with pytest.raises(ValueError, match="bolt, gear_box"):
        source.items(["nut"])


def test_one_file_and_one_flat_folder_are_one_class(tmp_path):
    source = Meshes(box(tmp_path / "Left bracket.v2.obj"))
    assert source.classes == ("left_bracket.v2",)
    assert len(source.items(source.classes)) == 1
    box(tmp_path / "parts" / "b.obj")
    box(tmp_path / "parts" / "a.off")
    flat = Meshes(tmp_path / "parts")
    assert flat.classes == ("parts",)
    assert [i.instance_id for i in flat.items(["parts"])] == ["a", "b"]


def test_the_folder_of_one_class_may_be_given_itself(tmp_path):
    box(tmp_path / "bolt" / "train" / "a.off")
    box(tmp_path / "bolt" / "test" / "b.off")
    source = Meshes(tmp_path / "bolt")
    assert source.classes == ("bolt",)
    assert [i.split for i in source.items(["bolt"])] == ["train", "test"]


def test_a_lone_train_folder_is_no_split(tmp_path, caplog):
    box(tmp_path / "bolt" / "train" / "a.off")
    (tmp_path / "bolt" / "test").mkdir()
    assert [i.split for i in Meshes(tmp_path).items(["bolt"])] == [None]
    assert "ratio" in caplog.text


def test_the_up_axis_is_z_except_for_gltf_and_must_be_told_for_mixtures(tmp_path):
    box(tmp_path / "a" / "x.obj")
    assert Meshes(tmp_path).up_axis == "z"
    assert Meshes(tmp_path, up_axis="y").up_axis == "y"
    with pytest.raises(ValueError, match="up_axis"):
        Meshes(tmp_path, up_axis="top")
    assert Meshes(box(tmp_path / "b" / "x.glb")).up_axis == "y"
    assert Meshes(tmp_path / "b" / "x.glb", up_axis="z").up_axis == "z"
    with pytest.raises(ConfigurationError, match=r"data\.up_axis"):
        Meshes(tmp_path)
    assert Meshes(tmp_path, up_axis="-y").up_axis == "-y"


def test_symmetry_comes_only_from_the_setting(tmp_path):
    box(tmp_path / "bottle" / "x.obj")
    box(tmp_path / "nut" / "x.obj")
    assert Meshes(tmp_path).symmetry == {"bottle": "none", "nut": "none"}
    assert Meshes(tmp_path, symmetry="z").symmetry == {"bottle": "z", "nut": "z"}
    assert Meshes(tmp_path, symmetry={"nut": "z"}).symmetry == {"bottle": "none", "nut": "z"}


def test_what_cannot_be_understood_is_explained(tmp_path):
    with pytest.raises(DatasetNotFoundError, match=r"data\.root"):
        Meshes()
    with pytest.raises(DatasetNotFoundError, match="neither a folder nor a file"):
        Meshes(tmp_path / "no")
    with pytest.raises(DatasetNotFoundError, match="holds no mesh"):
        Meshes(tmp_path)
    box(tmp_path / "my part" / "a.obj")
    box(tmp_path / "my-part" / "a.obj")
    with pytest.raises(ConfigurationError, match="my_part"):
        Meshes(tmp_path)
    box(tmp_path / "other" / "bolt" / "a.obj")
    box(tmp_path / "other" / "stray.obj")
    with pytest.raises(ConfigurationError, match=r"stray\.obj"):
        Meshes(tmp_path / "other")
    box(tmp_path / "third" / "bolt" / "a.obj")
    box(tmp_path / "third" / "bolt" / "train" / "b.obj")
    with pytest.raises(ConfigurationError, match="train/"):
        Meshes(tmp_path / "third")
