"""The user's own pictures as batches."""

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from i2i.data.labelled import LabelledImagesDataModule
from i2i.errors import ImageError


@pytest.fixture
def pictures(tmp_path):
    def write(splits=None, count=10):
        rotations = Rotation.random(count, random_state=0)
        header = ["file", "class", "qx", "qy", "qz", "qw", *(["split"] if splits else [])]
        lines = [",".join(header)]
        for number, quaternion in enumerate(rotations.as_quat()):
            Image.new("RGB", (20, 20), (number * 20,) * 3).save(tmp_path / f"{number}.png")
            row = [f"{number}.png", "part" if number % 2 else "cup", *map(repr, quaternion)]
            lines.append(",".join([*row, *([splits[number]] if splits else [])]))
        (tmp_path / "labels.csv").write_text("\n".join(lines) + "\n")
        return rotations.as_matrix()

    return write


def make(root, **options):
    module = LabelledImagesDataModule(
        root, **{"modality": "gray", "image_size": 8, "batch_size": 4, "shift_px": 0, **options}
    )
    module.setup()
    return module


def test_split_by_ratio_is_complete_and_reproducible(pictures, tmp_path):
    pictures()
    module = make(tmp_path, test_fraction=0.3, val_fraction=0.3)
    names = [module.instance_names(split) for split in ("train", "val", "test")]
    assert [len(part) for part in names] == [5, 2, 3]
    assert len({name for part in names for name in part}) == 10
    again = make(tmp_path, test_fraction=0.3, val_fraction=0.3)
    assert again.instance_names("test") == module.instance_names("test")
    other = make(tmp_path, test_fraction=0.3, val_fraction=0.3, seed=1)
    assert other.instance_names("train") != module.instance_names("train")


def test_split_column_and_labels(pictures, tmp_path):
    matrices = pictures(["train"] * 5 + ["test"] * 4 + ["val"])
    module = make(tmp_path)
    assert module.instance_names("val") == ["part/9.png"]
    [batch] = list(module.test_dataloader())
    assert torch.allclose(batch["rotation"], torch.tensor(matrices[5:9], dtype=torch.float32))
    assert batch["class_id"].tolist() == [1, 0, 1, 0]
    assert batch["image"][:, 0, 4, 4].tolist() == pytest.approx(np.arange(5, 9) * 20 / 255)
    assert module.info.class_names == ("cup", "part")


def test_symmetric_class_is_stripped(pictures, tmp_path):
    pictures()
    plain, stripped = (
        make(tmp_path, symmetry={"cup": "z"}, strip_symmetry=strip).dataset("train")
        for strip in (False, True)
    )
    cup = plain.class_id == 0
    change = np.abs(plain.rotation - stripped.rotation).max(axis=(1, 2))
    assert (change[cup] > 1e-3).all()
    assert (change[~cup] == 0).all()
    # The direction of the object's axis in the camera frame is what stripping keeps.
    assert np.abs(plain.rotation[..., 2] - stripped.rotation[..., 2]).max() < 1e-6


def test_wrong_split_is_reported_with_its_line(pictures, tmp_path):
    pictures(["train"] * 3 + ["dev"] + ["test"] * 6)
    with pytest.raises(ImageError, match=r"line 5.*'dev'.*train, val, test"):
        make(tmp_path)


def test_no_training_picture_is_reported(pictures, tmp_path):
    pictures(["test"] * 10)
    with pytest.raises(ImageError, match="no picture for training"):
        make(tmp_path)


@pytest.mark.parametrize("modality", ["partial_points", "full_points", "views", "grey"])
def test_pictures_are_neither_clouds_nor_view_sets(tmp_path, modality):
    with pytest.raises(ValueError, match=rf"modality={modality} is not allowed.*gray, depth, rgb"):
        LabelledImagesDataModule(tmp_path, modality=modality)
