"""Point clouds from files."""

import numpy as np
import pytest
import torch
import trimesh

from i2i.data.point_files import prepare_cloud, read_points
from i2i.errors import ImageError


@pytest.fixture
def points():
    return np.random.default_rng(0).normal(size=(200, 3)) * [1, 2, 3] + [5, 0, -40]


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".npy", ".npz"])
def test_every_format_gives_the_points(suffix, points, tmp_path):
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    elif suffix == ".xyz":
        np.savetxt(path, points, fmt="%.9g")
    elif suffix == ".npy":
        np.save(path, points)
    else:
        np.savez(path, points=points)
    np.testing.assert_allclose(read_points(path), points, rtol=1e-6)


def test_a_prepared_cloud_is_centred_and_scaled(points):
    cloud = prepare_cloud(points, num_points=len(points))[0].double().numpy()
    centred = points - points.mean(axis=0)
    expected = centred / np.linalg.norm(centred, axis=1).max()
    # The order is that of the farthest points; every one of the file is there.
    np.testing.assert_allclose(
        cloud[np.argsort(cloud[:, 0])], expected[np.argsort(expected[:, 0])], atol=1e-6
    )


def test_fewer_points_are_spread_over_the_whole_cloud(points):
    cloud = prepare_cloud(points, num_points=64)[0]
    apart = torch.cdist(cloud, cloud).fill_diagonal_(9).min()
    everything = prepare_cloud(points, num_points=len(points))[0]
    assert apart > 3 * torch.cdist(everything, everything).fill_diagonal_(9).min()


def test_where_the_cloud_lies_and_how_large_it_is_does_not_matter(points):
    here = prepare_cloud(points, num_points=64)
    there = prepare_cloud(points * 0.01 + [1000, 20, 3], num_points=64)
    np.testing.assert_allclose(here.numpy(), there.numpy(), atol=1e-5)


def test_opencv_axes_are_turned_about_x(points):
    ours = prepare_cloud(points, num_points=32)
    theirs = prepare_cloud(points * [1, -1, -1], num_points=32, axes="opencv")
    np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=1e-6)


def test_few_points_are_repeated_and_what_was_not_measured_is_left_out(points):
    holes = np.concatenate([points[:40], np.full((7, 3), np.nan)])
    cloud = prepare_cloud(holes, num_points=100)[0]
    assert cloud.shape == (100, 3)
    assert len(cloud.unique(dim=0)) == 40


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (np.zeros((50, 2)), r"\(N, 3\)"),
        (np.zeros((50, 3)), "the same point"),
        (np.ones((5, 3)), "at least"),
    ],
)
def test_what_is_no_cloud_is_refused(content, word, tmp_path):
    np.save(tmp_path / "bad.npy", content)
    with pytest.raises(ImageError, match=word):
        read_points(tmp_path / "bad.npy")


def test_files_of_nothing_and_cut_files_are_named(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    (tmp_path / "none.ply").write_text(header)
    (tmp_path / "empty.npy").touch()
    np.savez(tmp_path / "cut.npz", points=np.ones((99, 3)))
    whole = (tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("none.ply", "empty.npy", "cut.npz"):
        with pytest.raises(ImageError, match=name):
            read_points(tmp_path / name)


def test_files_that_cannot_be_read_are_named_with_what_can(tmp_path):
    with pytest.raises(ImageError, match=r"no such file.*\.ply"):
        read_points(tmp_path / "nothing.ply")
    for name in ("text.ply", "picture.png"):
        (tmp_path / name).write_text("hello")
        with pytest.raises(ImageError, match=name):
            read_points(tmp_path / name)
