import csv

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from i2i.data.images import read_labelled_images
from i2i.errors import ConfigurationError, DatasetNotFoundError, ImageError

HALF = np.sqrt(0.5)


def picture(path, *, size=(16, 16), color=(200, 40, 90)):
    Image.new("RGB", size, color).save(path)


def table(path, header, *rows):
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])
    return path


def read(root, name="labels.csv", **settings):
    return read_labelled_images(root, name, **{"image_size": 16, "modality": "rgb", **settings})


def test_arrays_names_and_rotations(tmp_path):
    picture(tmp_path / "a.png")
    picture(tmp_path / "b.png", color=(0, 0, 0))
    quaternions = Rotation.random(2, random_state=3).as_quat()
    table(
        tmp_path / "labels.csv",
        ["qw", "file", "class", "qx", "qy", "qz"],  # any order of the columns
        *[
            [q[3], name, kind, *q[:3]]
            for q, name, kind in zip(quaternions, ["a.png", "b.png"], ["Nut", "bolt"], strict=True)
        ],
    )
    images, rotations, names, ids, files = read(tmp_path)
    assert images.shape == (2, 3, 16, 16)
    assert images.dtype == np.uint8
    assert images[0, :, 8, 8].tolist() == [200, 40, 90]
    np.testing.assert_allclose(rotations, Rotation.from_quat(quaternions).as_matrix(), atol=1e-12)
    assert names == ("bolt", "nut")
    assert ids.tolist() == [1, 0]
    assert files == ("a.png", "b.png")
    only = read(tmp_path, classes=["nut"], modality="gray")
    assert only.images.shape == (1, 1, 16, 16)
    assert only.images[0, 0, 8, 8] == (200 + 40 + 90) // 3
    assert only.class_ids.tolist() == [0]


def test_a_quarter_turn_about_z_by_hand(tmp_path):
    picture(tmp_path / "a.png")
    expected = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    table(
        tmp_path / "n.csv",
        ["file", "class", "qx", "qy", "qz", "qw"],
        ["a.png", "x", 0, 0, HALF, HALF],
    )
    np.testing.assert_allclose(read(tmp_path, "n.csv").rotations[0], expected, atol=1e-12)
    header = ["file", "class", "q0", "q1", "q2", "q3"]
    table(tmp_path / "w.csv", header, ["a.png", "x", HALF, 0, 0, HALF])
    np.testing.assert_allclose(
        read(tmp_path, "w.csv", quaternion_order="wxyz").rotations[0], expected, atol=1e-12
    )
    table(tmp_path / "x.csv", header, ["a.png", "x", 0, 0, HALF, HALF])
    np.testing.assert_allclose(
        read(tmp_path, "x.csv", quaternion_order="xyzw").rotations[0], expected, atol=1e-12
    )
    with pytest.raises(ConfigurationError, match="quaternion_order=xyzw"):
        read(tmp_path, "x.csv")
    with pytest.raises(ConfigurationError, match="xyzw, wxyz"):
        read(tmp_path, "x.csv", quaternion_order="yzwx")


def test_wide_pictures_are_padded_with_white(tmp_path):
    picture(tmp_path / "a.png", size=(32, 16), color=(10, 10, 10))
    table(
        tmp_path / "labels.csv",
        ["file", "class", "qx", "qy", "qz", "qw"],
        ["a.png", "x", 0, 0, 0, 1],
    )
    image = read(tmp_path, image_size=32).images[0, 0]
    assert (image[:7] == 255).all()
    assert (image[-7:] == 255).all()
    assert (image[9:23] == 10).all()


HEADER = ["file", "class", "qx", "qy", "qz", "qw"]


@pytest.mark.parametrize(
    ("header", "row", "error", "message"),
    [
        (["name", "class"], ["a.png", "x"], ConfigurationError, "no column file"),
        (["file", "qx", "qy", "qz", "qw"], ["a.png", 0, 0, 0, 1], ConfigurationError,
         "no column class"),
        (["file", "class", "qx", "qy"], ["a.png", "x", 0, 0], ConfigurationError,
         "quaternion columns"),
        (HEADER, ["gone.png", "x", 0, 0, 0, 1], DatasetNotFoundError, r"gone\.png"),
        (HEADER, ["a.png", "x", 0, 0, 1, 1], ConfigurationError, r"line 2.*length 1\.414"),
        (HEADER, ["a.png", "x", 0, 0, 0, "nan"], ConfigurationError, "line 2"),
        (HEADER, ["a.png", "x", 0, 0, 0, "one"], ConfigurationError, "no number"),
        (HEADER, ["a.png", "x", 0, 0], ConfigurationError, "line 2.*6 columns"),
        (HEADER, ["text.png", "x", 0, 0, 0, 1], ImageError, r"text\.png"),
        (HEADER, ["cut.png", "x", 0, 0, 0, 1], ImageError, r"cut\.png"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path, header, row, error, message):
    picture(tmp_path / "a.png")
    (tmp_path / "text.png").write_text("no picture")
    picture(tmp_path / "cut.png", size=(200, 200))
    data = (tmp_path / "cut.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    table(tmp_path / "labels.csv", header, row)
    with pytest.raises(error, match=message):
        read(tmp_path)


def test_missing_table_folder_class_and_modality(tmp_path):
    with pytest.raises(DatasetNotFoundError, match=r"data\.csv"):
        read(tmp_path)
    with pytest.raises(DatasetNotFoundError, match=r"data\.root"):
        read(tmp_path / "no")
    picture(tmp_path / "a.png")
    table(tmp_path / "labels.csv", HEADER, ["a.png", "x", 0, 0, 0, 1])
    with pytest.raises(ConfigurationError, match="nut; it has: x"):
        read(tmp_path, classes=["nut"])
    with pytest.raises(ConfigurationError, match="gray, depth, rgb"):
        read(tmp_path, modality="infrared")
    table(tmp_path / "plain.csv", ["file", *HEADER[2:]], ["a.png", 0, 0, 0, 1])
    assert read(tmp_path, "plain.csv", classes=["nut"]).class_names == ("nut",)
    (tmp_path / "empty.csv").write_text("file,class,qx,qy,qz,qw\n")
    with pytest.raises(ConfigurationError, match="no rows"):
        read(tmp_path, "empty.csv")
