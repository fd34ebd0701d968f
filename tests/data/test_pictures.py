"""Reading pictures: ranges of every kind, and messages for what cannot be read."""

import numpy as np
import pytest
from PIL import Image

from i2i.data.pictures import read_mask, read_picture
from i2i.errors import ImageError


def read(picture):
    return read_picture(picture, what="image", warnings=[])


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(ImageError, match="does not exist"):
        read(tmp_path / "nothing.png")
    with pytest.raises(ImageError, match="is a folder"):
        read(tmp_path)


def test_file_that_is_not_a_picture(tmp_path):
    path = tmp_path / "mesh.png"
    path.write_text("OFF\n3 1 0\n")
    with pytest.raises(ImageError, match="not a picture"):
        read(str(path))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_file(tmp_path, suffix):
    path = tmp_path / f"photo{suffix}"
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    with pytest.raises(ImageError, match="truncated or damaged"):
        read(path)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((3, 40, 40), np.uint8), "channels last"),
        (np.full((40, 40), 12.0), "divide by 255"),
        (np.full((40, 40), np.nan), "divide by 255"),
        (np.zeros((1, 40), np.uint8), "too small"),
        (42, "give a path"),
    ],
)
def test_arrays_that_are_no_pictures(array, message):
    with pytest.raises(ImageError, match=message):
        read(array)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA", "P", "CMYK", "1"])
def test_every_mode_gives_color_and_alpha_in_range(mode):
    gray = Image.fromarray(np.linspace(0, 255, 64, dtype=np.uint8).reshape(8, 8))
    color, alpha = read(gray.convert("RGB").convert(mode) if mode != "LA" else gray.convert("LA"))
    assert color.shape == (8, 8, 3)
    assert alpha.shape == (8, 8)
    assert color.min() == 0.0
    assert color.max() == pytest.approx(1.0)
    assert (alpha == 1.0).all()


def test_palette_transparency_becomes_alpha():
    image = Image.fromarray(np.array([[0, 1], [1, 0]], dtype=np.uint8), mode="P")
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.info["transparency"] = 1
    color, alpha = read(image)
    np.testing.assert_array_equal(alpha, [[1, 0], [0, 1]])
    np.testing.assert_allclose(color[0, 0] * 255, (10, 20, 30), atol=1e-4)


def test_mask_is_scaled_by_its_largest_value_and_label_maps_are_binary():
    soft = np.array([[0, 50], [100, 100]], dtype=np.uint8)
    np.testing.assert_allclose(read_mask(soft, shape=(2, 2)), [[0, 0.5], [1, 1]])
    labels = np.array([[0, 3], [1, 0]], dtype=np.int64)
    np.testing.assert_array_equal(read_mask(labels, shape=(2, 2)), [[0, 1], [1, 0]])
