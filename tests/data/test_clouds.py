"""What happens to the clouds of a batch, against closed forms and direct definitions."""

import numpy as np
import torch
from scipy.stats import kstest

from i2i import data
from i2i.data.clouds import CloudAugmentation, strip_labels
from i2i.geometry.rotations import random_rotations
from i2i.geometry.symmetries import strip_symmetry

SYMMETRY = ("none", "z", "z2")


def clouds(count=6, size=40):
    rng = np.random.default_rng(0)
    return (rng.normal(size=(count, size, 3)) * [1, 2, 3] + [4, 5, 6]).astype(np.float32)


def labels(count=6):
    generator = torch.Generator().manual_seed(1)
    return random_rotations(count, generator=generator).numpy().astype(np.float32)


def augment(count=6, size=40, keys=None, class_id=None, rotation=None, **options):
    keys = np.arange(count) if keys is None else keys
    return CloudAugmentation(**options)(
        clouds(count, size),
        labels(count) if rotation is None else rotation,
        np.zeros(count, np.int64) if class_id is None else class_id,
        [keys],
    )


def points_of(**options):
    return augment(**options)[0].astype(float)


def normalized(points):
    """The definition, one cloud at a time."""
    centred = [cloud - cloud.mean(axis=0) for cloud in points.astype(np.float64)]
    return np.stack([cloud / max(np.linalg.norm(point) for point in cloud) for cloud in centred])


def test_by_default_a_cloud_is_only_normalised():
    points, rotation = augment()
    assert points.dtype == rotation.dtype == np.float32
    assert np.abs(points - normalized(clouds())).max() < 1e-6
    assert (rotation == labels()).all()
    assert np.abs(points.mean(axis=1)).max() < 1e-6
    assert np.abs(np.linalg.norm(points, axis=2).max(axis=1) - 1).max() < 1e-6


def test_a_turn_turns_points_and_label_alike():
    points, rotation = augment(rotate=True)
    plain, before = augment()
    for cloud, label, old_cloud, old_label in zip(points, rotation, plain, before, strict=True):
        # Kabsch: the rotation that takes the plain cloud to the turned one.
        u, _, vt = np.linalg.svd(cloud.T.astype(np.float64) @ old_cloud)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        assert np.abs(old_cloud @ turn.T - cloud).max() < 1e-5
        assert np.abs(turn @ old_label - label).max() < 1e-5
        assert np.abs(label - old_label).max() > 0.1


def test_turns_are_uniform():
    turns = CloudAugmentation(rotate=True).turns([np.arange(5000)])
    assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert np.abs(np.linalg.det(turns) - 1).max() < 1e-12
    # Haar measure: an angle of at most a has the probability (a − sin a)/π, and each column is
    # uniform on the sphere, so each of its coordinates is uniform in [−1, 1].
    angle = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.001
    for row in range(3):
        for column in range(3):
            assert kstest(turns[:, row, column], "uniform", args=(-1, 2)).pvalue > 0.001


def test_labels_of_symmetric_classes_are_stripped_after_the_turn():
    class_id, full = np.arange(300) % 3, labels(300)
    stripped = strip_labels(full, class_id, SYMMETRY).astype(np.float32)
    options = {"count": 300, "class_id": class_id, "rotate": True}
    _, found = augment(rotation=stripped, symmetry=SYMMETRY, **options)
    turn = CloudAugmentation(rotate=True).turns([np.arange(300)])
    for number, name in enumerate(SYMMETRY):
        mine = class_id == number
        # The same as stripping the turned label that was never stripped before.
        expected = strip_symmetry(torch.from_numpy(turn[mine] @ full[mine]), name).numpy()
        assert np.abs(found[mine] - expected).max() < 1e-5, name
    # Without the second stripping labels would not be the canonical ones.
    _, once = augment(rotation=stripped, **options)
    assert np.abs(once - found)[class_id == 0].max() < 1e-6
    for number in (1, 2):
        assert np.abs(once - found)[class_id == number].max() > 0.5
    # Whole labels stay whole.
    _, whole = augment(rotation=full, **options)
    assert np.abs(whole - turn @ full).max() < 1e-6


def test_dropped_points_become_the_first_one():
    points, _ = augment(dropout=0.8, count=400)
    plain, _ = augment(count=400)
    same = (points == plain).all(axis=2)
    first = (points == plain[:, :1]).all(axis=2)
    assert (same | first).all()
    share = (~same).mean(axis=1)
    assert kstest(share, "uniform", args=(0, 0.8)).pvalue > 1e-4  # each a mean of 40 draws
    assert share.max() < 0.8 + 4 * np.sqrt(0.25 / 40)
    dropped = CloudAugmentation(dropout=0.8).dropped(40, [np.arange(400)])
    assert (dropped[:, 1:] == ~same[:, 1:]).all()


def test_scale_is_one_factor_for_all_axes():
    points, _ = augment(scale=0.25, count=2000)
    plain, _ = augment(count=2000)
    factor = np.linalg.norm(points, axis=2).max(axis=1)
    assert np.abs(points - factor[:, None, None] * plain).max() < 1e-5
    assert kstest(factor, "uniform", args=(0.75, 0.5)).pvalue > 0.001


def test_shift_moves_a_cloud_as_a_whole():
    points, _ = augment(shift=0.1, count=2000)
    plain, _ = augment(count=2000)
    moved = points - plain
    assert np.abs(moved - moved[:, :1]).max() < 1e-6
    for axis in range(3):
        assert kstest(moved[:, 0, axis], "uniform", args=(-0.1, 0.2)).pvalue > 0.001
    assert np.abs(np.corrcoef(moved[:, 0].T) - np.eye(3)).max() < 0.08


def test_noise_is_normal_and_independent():
    points, _ = augment(noise=0.02, count=300)
    plain, _ = augment(count=300)
    noise = (points - plain).astype(np.float64)
    assert kstest(noise.ravel(), "norm", args=(0, 0.02)).pvalue > 0.001
    assert np.abs(np.corrcoef(noise.reshape(-1, 3).T) - np.eye(3)).max() < 0.04
    assert np.abs(np.corrcoef(noise[:, :2].reshape(300, 6).T) - np.eye(6)).max() < 0.25


EVERYTHING = {"rotate": True, "dropout": 0.5, "scale": 0.2, "shift": 0.1, "noise": 0.01}


def test_a_sample_depends_on_its_key_alone():
    augmentation = CloudAugmentation(**EVERYTHING, seed=3)
    points, rotation, keys = clouds(12), labels(12), np.arange(50, 62)
    class_id = np.zeros(12, np.int64)
    whole = augmentation(points, rotation, class_id, [keys])
    order = np.random.default_rng(2).permutation(12)
    for row in order:
        part = slice(row, row + 1)
        one = augmentation(points[part], rotation[part], class_id[part], [keys[part]])
        assert (one[0] == whole[0][part]).all()
        assert (one[1] == whole[1][part]).all()
    for other in (CloudAugmentation(**EVERYTHING, seed=4), augmentation):
        changed = other(points, rotation, class_id, [keys + (other is augmentation)])
        assert (np.abs(changed[1] - whole[1]).max(axis=(1, 2)) > 1e-3).all()


def test_what_one_setting_does_is_the_same_beside_the_others():
    whole = points_of()
    factor = points_of(scale=0.3)[:, 0, 0] / whole[:, 0, 0]
    shift = points_of(shift=0.2)[:, :1] - whole[:, :1]
    both = factor[:, None, None] * whole + shift
    np.testing.assert_allclose(points_of(scale=0.3, shift=0.2), both, atol=1e-5)
    noisy = points_of(noise=0.1) + shift
    np.testing.assert_allclose(points_of(noise=0.1, shift=0.2), noisy, atol=1e-5)


def test_settings_draw_independently():
    """Of 4,000 samples; streams that were the same would be wholly correlated."""
    streams = (data.clouds._TURN, data.clouds._SCALE, data.clouds._SHIFT, data.clouds._SHARE,
               data.clouds._DROP, data.clouds._NOISE)  # fmt: skip
    keys = [np.arange(4000)]
    draws = [CloudAugmentation()._uniform(stream, (1,), keys)[:, 0] for stream in streams]
    correlation = np.corrcoef(draws) - np.eye(len(streams))
    assert np.abs(correlation).max() < 0.08


def test_a_factor_for_each_axis():
    whole, scaled = points_of(), points_of(scale=0.2, scale_per_axis=True)
    factor = scaled[:, 0] / whole[:, 0]
    np.testing.assert_allclose(scaled, whole * factor[:, None], atol=1e-5)
    assert np.abs(factor - 1).max() <= 0.2 + 1e-5
    assert (np.ptp(factor, axis=1) > 1e-3).all()
