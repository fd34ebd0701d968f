"""Shifts of batches, against direct per-pixel definitions."""

import numpy as np
import pytest

from i2i.data.augment import (
    Augmentation,
    scaled_shift,
    shift_depth,
    shift_images,
    to_float,
)


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


def test_shift_matches_brute_force():
    images = noise(9, 2, 6, 7)
    offsets = np.array([(r, c) for r in (-2, 0, 3) for c in (-3, 0, 1)])
    shifted = shift_images(images, offsets, fill=255)
    expected = np.full_like(images, 255)
    for b, (row, column) in enumerate(offsets):
        for i in range(6):
            for j in range(7):
                if 0 <= i + row < 6 and 0 <= j + column < 7:
                    expected[b, :, i + row, j + column] = images[b, :, i, j]
    assert (shifted == expected).all()


@pytest.mark.parametrize(
    ("shift_px", "image_size", "expected"),
    [(3, 128, 3), (4, 64, 2), (3, 256, 6), (5, 64, 2.5), (1, 16, 0.125), (0, 16, 0)],
)
def test_shift_scales_with_the_image(shift_px, image_size, expected):
    assert scaled_shift(shift_px, image_size) == expected


@pytest.mark.parametrize(("shift", "ends"), [(2.0, 2), (2.5, 3), (0.125, 1)])
def test_shifts_are_uniform_with_a_fraction_at_the_ends(shift, ends):
    keys = [np.arange(60_000)]
    rows, _ = Augmentation(shift_px=shift).pixel_offsets(keys).T
    found = {int(v): (rows == v).mean() for v in np.unique(rows)}
    assert set(found) == set(range(-ends, ends + 1))
    inner = 1 / (2 * shift + 1)
    for value, frequency in found.items():
        part = (shift - (ends - 1)) if abs(value) == ends and shift != ends else 1.0
        assert frequency == pytest.approx(inner * part, abs=0.006)


@pytest.mark.parametrize("shift_px", [-1, 64])
def test_impossible_shifts_are_refused(shift_px):
    with pytest.raises(ValueError, match="not allowed"):
        scaled_shift(shift_px, 128)


def test_pixel_offsets_are_uniform_and_independent():
    offsets = Augmentation(shift_px=2).pixel_offsets([np.arange(25_000)])
    counts = np.zeros((5, 5))
    np.add.at(counts, tuple(offsets.T + 2), 1)
    # 25 equally likely cells of 1,000 expected draws: 5 standard deviations are 155.
    assert np.abs(counts - 1000).max() < 155


def test_depth_offsets_are_uniform_in_their_range():
    # 10 % of the diameter (2 units) is 0.1 of the normalised depth (2 units are 1).
    offsets = Augmentation(depth_shift=10).depth_offsets([np.arange(20_000)])
    assert -0.1 <= offsets.min() < -0.0999
    assert 0.0999 < offsets.max() <= 0.1
    assert abs(offsets.mean()) < 0.1 / np.sqrt(3) * 5 / np.sqrt(20_000)


def test_depth_shift_moves_the_surface_only():
    images = np.array([0.0, 0.2, 0.9, 1.0], np.float32).reshape(1, 1, 2, 2).repeat(2, 0)
    shifted = shift_depth(images, np.array([0.3, -0.3]))
    assert shifted.reshape(2, 4) == pytest.approx(
        np.array([[0.3, 0.5, 1.0, 1.0], [0.0, 0.0, 0.6, 1.0]]), abs=1e-6
    )


def test_to_float_is_the_exact_quotient():
    values = np.arange(256, dtype=np.uint8)
    floats = to_float(values)
    assert floats.dtype == np.float32
    assert (floats == values.astype(np.float32) / np.float32(255)).all()
    assert floats[255] == 1.0


def test_augmentation_does_not_depend_on_the_grouping():
    images, keys = noise(12, 1, 16, 16), np.arange(100, 112)
    augmentation = Augmentation(shift_px=2, depth_shift=5, seed=7)
    whole = augmentation(images, [keys])
    order = np.random.default_rng(1).permutation(12)
    parts = np.concatenate([augmentation(images[o : o + 1], [keys[o : o + 1]]) for o in order])
    assert (parts == whole[order]).all()
    assert (Augmentation(2, 5, seed=8)(images, [keys]) != whole).any()


def test_no_augmentation_is_the_plain_image():
    images = noise(3, 3, 8, 8)
    assert (Augmentation()(images, [np.arange(3)]) == to_float(images)).all()
