"""Point clouds against brute force, closed forms and their own properties."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from i2i.geometry import points as module
from i2i.geometry.points import (
    ball_query,
    farthest_point_sample,
    gather_points,
    grid_subsample,
    normalize_points,
    radius_neighbours,
    sample_surface,
)
from i2i.geometry.rotations import random_rotations


def cloud(*shape, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, 3, generator=generator, dtype=dtype)


def stack(sizes, seed=0):
    """Clouds of several sizes, one behind the other, and their numbers."""
    numbers = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    return cloud(sum(sizes), seed=seed), numbers


# --- Farthest points ----------------------------------------------------------------------------


def brute_farthest(points, count, start):
    """The definition, one point at a time, in float64."""
    points, picked = points.double().numpy(), [int(start)]
    while len(picked) < count:
        distance = np.linalg.norm(points[:, None] - points[None, picked], axis=2).min(axis=1)
        distance[picked] = -1
        picked.append(int(distance.argmax()))
    return picked


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 3), st.data())
def test_farthest_points_against_the_definition(size, batch, data):
    count = data.draw(st.integers(1, size))
    points = cloud(batch, size, seed=data.draw(st.integers(0, 99)), dtype=torch.float64)
    start = torch.tensor(data.draw(st.lists(st.integers(0, size - 1), min_size=batch,
                                            max_size=batch)))  # fmt: skip
    picked = farthest_point_sample(points, count, start=start)
    assert picked.dtype == torch.int64
    for one, first, row in zip(points, start, picked, strict=True):
        assert row.tolist() == brute_farthest(one, count, first)


def test_both_loops_pick_the_same_points():
    """The one for processors and the one for other devices."""
    points, start = cloud(3, 200), torch.tensor([0, 7, 199])
    expected = farthest_point_sample(points, 150, start=start)
    assert torch.equal(module._farthest_torch(points, 150, start), expected)


def test_farthest_points_start_far_from_the_mean_whatever_the_order():
    points = cloud(4, 300)
    picked = farthest_point_sample(points, 64)
    far = (points - points.mean(dim=1, keepdim=True)).norm(dim=2).argmax(dim=1)
    assert torch.equal(picked[:, 0], far)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    again = farthest_point_sample(points[:, order], 64)
    assert torch.equal(order[again], picked)  # the same points, one by one
    assert torch.equal(farthest_point_sample(points, 64), picked)


@pytest.mark.parametrize("loop", ["numpy", "torch"])
def test_all_points_and_duplicates(loop):
    """Each index once, even where all points coincide, and distinct places before duplicates."""
    twice = cloud(1, 10).repeat(1, 2, 1)
    for points in (cloud(2, 17), torch.zeros(2, 17, 3), twice):
        size = points.shape[1]
        if loop == "numpy":
            picked = farthest_point_sample(points, size)
        else:
            start = torch.zeros(len(points), dtype=torch.long)
            picked = module._farthest_torch(points, size, start)
        assert all(sorted(row.tolist()) == list(range(size)) for row in picked)
    assert len({index % 10 for index in farthest_point_sample(twice, 10)[0].tolist()}) == 10
    assert farthest_point_sample(cloud(2, 1), 1).tolist() == [[0], [0]]


def test_farthest_points_cover_better_than_random_ones():
    points = cloud(1, 1000)
    picked = points[0, farthest_point_sample(points, 100)[0]]
    hole = torch.cdist(points[0], picked).min(dim=1).values.max()
    assert hole < 0.5 * torch.cdist(points[0], points[0, :100]).min(dim=1).values.max()


def test_farthest_points_refuse():
    for count in (0, 6):
        with pytest.raises(ValueError, match="1 to 5"):
            farthest_point_sample(cloud(1, 5), count)
    for start in ([5], [-1], [0, 0]):
        with pytest.raises(ValueError, match="start"):
            farthest_point_sample(cloud(1, 5), 2, start=torch.tensor(start))
    with pytest.raises(ValueError, match="shape"):
        farthest_point_sample(cloud(5), 2)


def test_half_precision_clouds_work():
    points = cloud(2, 50).bfloat16()
    assert torch.equal(farthest_point_sample(points, 9), farthest_point_sample(points.float(), 9))


# --- Balls --------------------------------------------------------------------------------------


def brute_ball(centre, points, radius, count, nearest):
    distance = np.linalg.norm(points - centre, axis=1)
    order = distance.argsort() if nearest else range(len(points))
    found = [i for i in order if distance[i] < radius] or [int(distance.argmin())]
    found = found[:count]
    return [found[k % len(found)] for k in range(count)]


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 3), st.integers(1, 8), st.integers(1, 40), st.integers(1, 12),
    st.floats(0.05, 5), st.booleans(), st.integers(0, 99),
)  # fmt: skip
def test_balls_against_the_definition(batch, centres, size, count, radius, nearest, seed):
    middle = cloud(batch, centres, seed=seed, dtype=torch.float64)
    points = cloud(batch, size, seed=seed + 1, dtype=torch.float64)
    index = ball_query(middle, points, radius=radius, count=count, nearest=nearest)
    assert index.dtype == torch.int64
    for b in range(batch):
        for m in range(centres):
            expected = brute_ball(middle[b, m].numpy(), points[b].numpy(), radius, count, nearest)
            assert index[b, m].tolist() == expected


def test_balls_are_open_repeat_cyclically_and_fall_back_to_the_nearest():
    points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]])
    centres = torch.tensor([[[0.0, 0, 0], [1.4, 0, 0], [9, 0, 0]]])
    index = ball_query(centres, points, radius=1.0, count=5)
    assert index.tolist() == [[[0, 0, 0, 0, 0], [1, 2, 1, 2, 1], [3, 3, 3, 3, 3]]]
    nothing = ball_query(centres[:, 2:], points, radius=1.0, count=2)
    assert nothing.tolist() == [[[3, 3]]]
    # A full ball keeps the first, or the nearest on request.
    assert ball_query(centres[:, 1:2], points, radius=9.0, count=2).tolist() == [[[0, 1]]]
    index = ball_query(centres[:, 1:2], points, radius=9.0, count=2, nearest=True)
    assert index.tolist() == [[[1, 2]]]


def test_balls_refuse():
    points = cloud(2, 5)
    for radius, count in ((0.0, 1), (float("nan"), 1), (1.0, 0)):
        with pytest.raises(ValueError, match="positive"):
            ball_query(points, points, radius=radius, count=count)
    with pytest.raises(ValueError, match="clouds"):
        ball_query(points[:1], points, radius=1.0, count=1)


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_gathered_values_against_a_loop(shape):
    values = torch.randn(3, 10, *shape, dtype=torch.float64, requires_grad=True)
    for index in (torch.randint(0, 10, (3, 4)), torch.randint(0, 10, (3, 4, 5))):
        out = gather_points(values, index)
        expected = torch.stack([values[b, index[b]] for b in range(3)])
        assert torch.equal(out, expected)
        weight = torch.rand_like(out)
        (mine,) = torch.autograd.grad((out * weight).sum(), values)
        (theirs,) = torch.autograd.grad((expected * weight).sum(), values)
        torch.testing.assert_close(mine, theirs)


# --- Grids and neighbours -----------------------------------------------------------------------


def test_cells_against_a_dictionary():
    points, batch = stack([200, 1, 50])
    mean, numbers = grid_subsample(points, batch, 0.7)
    expected = []
    for b in range(3):
        mine = points[batch == b].double().numpy()
        cells = {}
        for point, place in zip(mine, np.floor((mine - mine.min(axis=0)) / 0.7), strict=True):
            cells.setdefault(tuple(place), []).append(point)
        expected += [(b, *np.mean(cells[place], axis=0)) for place in sorted(cells)]
    rows = torch.cat([numbers[:, None].double(), mean.double()], dim=1)
    torch.testing.assert_close(rows, torch.tensor(expected, dtype=torch.float64), atol=1e-6, rtol=0)
    assert (numbers.diff() >= 0).all()
    assert len(mean) < 200


def test_cells_move_with_the_cloud_and_ignore_its_order():
    points, batch = stack([300, 100])
    points = (points * 4096).round() / 4096  # so that a shift by such a number is exact
    mean, numbers = grid_subsample(points, batch, 0.3)
    shift = torch.tensor([1.25, -2.5, 0.0625])[None] * (1 + batch[:, None])
    moved, _ = grid_subsample(points + shift, batch, 0.3)
    torch.testing.assert_close(moved - shift[0] * (1 + numbers[:, None]), mean, atol=1e-6, rtol=0)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(0))
    again, same = grid_subsample(points[order], batch[order], 0.3)
    torch.testing.assert_close(again, mean, atol=1e-6, rtol=0)
    assert torch.equal(same, numbers)


def test_extreme_cells():
    points, batch = stack([20, 30])
    mean, numbers = grid_subsample(points, batch, 100.0)  # one cell holds all
    expected = torch.stack([points[:20].mean(dim=0), points[20:].mean(dim=0)])
    torch.testing.assert_close(mean, expected)
    assert numbers.tolist() == [0, 1]
    mean, numbers = grid_subsample(points, batch, 1e-4)  # each its own
    assert torch.equal(numbers.bincount(), batch.bincount())
    assert set(map(tuple, mean.tolist())) == set(map(tuple, points.tolist()))
    mean, _ = grid_subsample(torch.ones(5, 3), torch.zeros(5, dtype=torch.long), 0.1)
    assert mean.tolist() == [[1.0, 1.0, 1.0]]


def test_cells_refuse():
    points, batch = stack([5])
    for cell in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="side of a cell"):
            grid_subsample(points, batch, cell)
    with pytest.raises(ValueError, match="too small"):
        grid_subsample(points, batch, 1e-9)
    with pytest.raises(ValueError, match="no points"):
        grid_subsample(points[:0], batch[:0], 1.0)
    with pytest.raises(ValueError, match="numbers"):
        grid_subsample(points, batch[:2], 1.0)


def brute_neighbours(queries, query_batch, points, point_batch, radius, limit):
    distance = torch.cdist(queries.double(), points.double())
    distance[query_batch[:, None] != point_batch[None]] = torch.inf
    rows = []
    for row in distance:
        near = [i for i in row.argsort(stable=True).tolist() if row[i] < radius][:limit]
        rows.append(near + [len(points)] * (limit - len(near)))
    return torch.tensor(rows)


@pytest.mark.parametrize("search", ["_nearest_tree", "_nearest_torch"])
@pytest.mark.parametrize(("radius", "limit"), [(0.8, 5), (0.8, 1), (0.05, 3), (3.0, 60)])
def test_neighbours_against_the_definition(search, radius, limit, monkeypatch):
    monkeypatch.setattr(module, "_nearest_tree", getattr(module, search))
    monkeypatch.setattr(module, "_CHUNK", 7)
    points, point_batch = stack([40, 1, 25])
    queries, query_batch = stack([10, 2, 8], seed=1)
    index = radius_neighbours(queries, query_batch, points, point_batch, radius=radius, limit=limit)
    assert index.dtype == torch.int64
    expected = brute_neighbours(queries, query_batch, points, point_batch, radius, limit)
    assert torch.equal(index, expected)


def test_neighbours_of_a_cloud_that_is_missing():
    points, point_batch = stack([3, 4])
    queries, query_batch = stack([2, 0, 5])  # cloud 1 asks nothing, cloud 2 has no points
    index = radius_neighbours(queries, query_batch, points, point_batch, radius=100.0, limit=4)
    assert index[:2].sort(dim=1).values.tolist() == [[0, 1, 2, 7]] * 2
    assert (index[2:] == 7).all()
    assert radius_neighbours(
        queries[:0], query_batch[:0], points, point_batch, radius=1.0, limit=2
    ).shape == (0, 2)


def test_a_point_is_its_own_first_neighbour_and_turning_changes_nothing():
    points, batch = stack([60, 30])
    index = radius_neighbours(points, batch, points, batch, radius=1.0, limit=10)
    assert torch.equal(index[:, 0], torch.arange(90))
    turned = points.double() @ random_rotations(1, torch.Generator().manual_seed(0))[0].T
    again = radius_neighbours(turned, batch, turned, batch, radius=1.0, limit=10)
    assert torch.equal(again, index)


def test_neighbours_refuse():
    points, batch = stack([3, 3])
    with pytest.raises(ValueError, match="rising order"):
        radius_neighbours(points, batch.flip(0), points, batch, radius=1.0, limit=2)
    with pytest.raises(ValueError, match="positive"):
        radius_neighbours(points, batch, points, batch, radius=-1.0, limit=2)


# --- Sizes and surfaces -------------------------------------------------------------------------


def test_normalized_clouds():
    points = 5 * cloud(4, 100) + 3
    out = normalize_points(points)
    torch.testing.assert_close(out.mean(dim=1), torch.zeros(4, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(out.norm(dim=2).amax(dim=1), torch.ones(4))
    torch.testing.assert_close(normalize_points(0.1 * points - 7), out, atol=1e-5, rtol=0)
    assert torch.equal(normalize_points(torch.ones(2, 1, 3)), torch.zeros(2, 1, 3))


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 7]])
HALVES = np.array([[0, 1, 2], [0, 2, 3], [4, 4, 4]])  # the last has no area


def test_a_sampled_surface_is_even():
    uniforms = np.random.default_rng(0).random((40_000, 3))
    points = sample_surface(SQUARE, HALVES, uniforms)
    assert (points[:, 2] == 0).all()
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=8, range=[[0, 1], [0, 1]])
    chi_squared = ((counts - 625) ** 2 / 625).sum()  # of 63 degrees of freedom: 63 ± 11
    assert 25 < chi_squared < 110
    assert np.array_equal(points, sample_surface(SQUARE, HALVES, uniforms))


def test_large_faces_get_more_points():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 1], [0, 3, 1]])
    uniforms = np.random.default_rng(0).random((10_000, 3))
    points = sample_surface(vertices, np.array([[0, 1, 2], [3, 4, 5]]), uniforms)
    assert abs((points[:, 2] > 0.5).mean() - 0.9) < 0.01


def test_extreme_uniforms_stay_on_the_surface():
    edge = np.nextafter(1, 0)
    uniforms = np.array([[0.0, 0, 0], [edge, edge, edge], [edge, 0, edge], [0.5, edge, 0]])
    points = sample_surface(SQUARE, HALVES, uniforms)
    assert ((points >= 0) & (points <= 1)).all()
    assert (points[:, 2] == 0).all()


def test_surfaces_refuse():
    with pytest.raises(ValueError, match="no area"):
        sample_surface(SQUARE, HALVES[2:], np.zeros((1, 3)))
    with pytest.raises(ValueError, match="no area"):
        sample_surface(SQUARE, HALVES[:0], np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"\[0, 1\)"):
        sample_surface(SQUARE, HALVES, np.ones((1, 3)))
