"""Seeds by address: uniform, independent of order, disjoint between splits, the same for ever."""

import math

import numpy as np
import pytest

from i2i.geometry.seeding import uniform_hash, view_rotation


def views(split="train", n=2000, **changes):
    address = {"class_name": "desk", "instance_id": "desk_0001", "seed": 0, **changes}
    return np.stack([view_rotation("modelnet40", split, view=v, **address) for v in range(n)])


def test_views_are_rotations_and_haar():
    r = views(n=8000)
    np.testing.assert_allclose(
        r @ r.transpose(0, 2, 1), np.broadcast_to(np.eye(3), r.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(r), 1)
    flat = r.reshape(-1, 9)
    tolerance = 5 / math.sqrt(len(r))
    np.testing.assert_allclose(flat.mean(0), 0, atol=tolerance)
    np.testing.assert_allclose(flat.T @ flat / len(r), np.eye(9) / 3, atol=tolerance)
    assert (flat[:, ::4].sum(1) ** 2).mean() == pytest.approx(1, abs=0.08)


def test_a_view_depends_on_its_address_alone():
    first = view_rotation("synthetic", "train", "car", "car_3", 7, 1)
    views(n=5)
    np.random.default_rng(0).random(100)
    assert (view_rotation("synthetic", "train", "car", "car_3", 7, 1) == first).all()


def test_the_stream_is_pinned():
    """Stores made by one release are continued by the next."""
    expected = [
        [-0.11270880538545569, -0.032191117744255315, -0.993106468172954],
        [-0.8866642911271104, 0.4543649815690044, 0.08590051433988599],
        [0.4484675685360559, 0.8902337869695655, -0.07975364887692638],
    ]
    np.testing.assert_allclose(
        view_rotation("synthetic", "train", "car", "car_3", 7, 1), expected, atol=1e-12
    )


def test_splits_classes_instances_and_seeds_have_disjoint_views():
    sets = [
        views(n=300),
        views("test", n=300),
        views(n=300, class_name="car"),
        views(n=300, instance_id="desk_0002"),
        views(n=300, seed=1),
        np.stack(
            [view_rotation("synthetic", "train", "desk", "desk_0001", v, 0) for v in range(300)]
        ),
    ]
    rotations = {tuple(r.ravel().round(9)) for group in sets for r in group}
    assert len(rotations) == 1800


def test_addresses_cannot_run_into_each_other():
    a = view_rotation("d", "train", "ab", "c", 1, 2)
    b = view_rotation("d", "train", "a", "bc", 1, 2)
    c = view_rotation("d", "train", "ab", "c", 12, 0)
    assert not np.allclose(a, b)
    assert not np.allclose(a, c)


def test_integer_types_do_not_matter():
    a = view_rotation("d", "train", "a", "b", np.int64(3), np.int32(1))
    assert (a == view_rotation("d", "train", "a", "b", 3, 1)).all()


def test_uniform_hash_is_uniform_in_every_argument():
    n = 20_000
    for numbers in (
        uniform_hash(0, np.arange(n)),
        uniform_hash(5, np.full(n, 3), np.arange(n)),
        uniform_hash(5, np.arange(n), np.full(n, 3)),
        np.array([uniform_hash(seed, 0) for seed in range(n)]),
    ):
        assert numbers.min() >= 0
        assert numbers.max() < 1
        ranks = (np.arange(n) + 0.5) / n
        assert np.abs(np.sort(numbers) - ranks).max() < 1.95 / math.sqrt(n)
        assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 4 / math.sqrt(n)


def test_uniform_hash_broadcasts_and_is_pure():
    rows, columns = np.arange(4)[:, None], np.arange(5)
    table = uniform_hash(9, rows, columns)
    assert table.shape == (4, 5)
    assert table[2, 3] == uniform_hash(9, 2, 3)
    assert len(np.unique(table)) == 20
    assert uniform_hash(9, 2, 3) != uniform_hash(9, 3, 2)
    assert uniform_hash(9, 2, 3) != uniform_hash(8, 2, 3)
    assert uniform_hash(9, -1) != uniform_hash(9, 1)


def test_uniform_hash_is_splitmix64():
    """First output of the published generator with state 0."""
    expected = (0xE220A8397B1DCDAF >> 11) * 2.0**-53
    assert uniform_hash(0).item() == expected


def test_uniform_hash_refuses_fractions():
    with pytest.raises(TypeError, match="integers"):
        uniform_hash(0, 0.5)
