"""Methods side by side: every picture in its place, every error under its own."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2i.data.info import DataInfo
from i2i.rendering.mesh import prepare_mesh
from i2i.viz.qualitative import qualitative_grid
from i2i.viz.rerender import rerender

INFO = DataInfo(("a",), ("none",), channels=1, image_size=16, modality="gray")


@pytest.fixture(scope="module")
def stick():
    return prepare_mesh(trimesh.creation.box((0.2, 0.5, 2.0)))


def shown(axes):
    return np.asarray(axes.images[0].get_array())


def test_rows_are_images_and_columns_methods(stick):
    true = Rotation.random(3, random_state=0).as_matrix()
    off = Rotation.from_rotvec(np.radians([[10.0, 0, 0], [0, 20, 0], [0, 0, 100]])).as_matrix()
    images = np.random.default_rng(0).random((3, 1, 16, 16))
    methods = {"exact": true, "off": off @ true}
    figure = qualitative_grid(
        images, methods, true, info=INFO, meshes=stick, titles=["p", "q", "r"]
    )
    grid = np.array(figure.axes).reshape(3, 4)
    assert [axes.get_title().split(",")[0] for axes in grid[0]] == [
        "input",
        "truth",
        "exact",
        "off",
    ]
    assert [axes.get_ylabel() for axes in grid[:, 0]] == ["p", "q", "r"]
    assert [axes.get_xlabel() for axes in grid[:, 2]] == ["0.0°"] * 3
    assert [axes.get_xlabel() for axes in grid[:, 3]] == ["10.0°", "20.0°", "100.0°"]
    pictures = rerender(stick, methods["off"], info=INFO)
    for row in range(3):
        np.testing.assert_array_equal(shown(grid[row, 0]), images[row, 0])
        np.testing.assert_array_equal(shown(grid[row, 1]), shown(grid[row, 2]))
        np.testing.assert_array_equal(shown(grid[row, 3]), pictures[row, 0])


def test_given_errors_are_shown_and_missing_meshes_stay_blank():
    true = np.stack([np.eye(3)] * 2)
    figure = qualitative_grid(
        np.zeros((2, 1, 16, 16)), {"m": true}, true, info=INFO, meshes=[None, None],
        error_deg={"m": np.array([7.0, np.nan])},
    )  # fmt: skip
    grid = np.array(figure.axes).reshape(2, 3)
    assert [axes.get_xlabel() for axes in grid[:, 2]] == ["7.0°", "not finite"]
    assert (shown(grid[0, 2]) == 1.0).all()


def test_nothing_to_draw_and_wrong_numbers_are_refused():
    true, images = np.stack([np.eye(3)] * 2), np.zeros((2, 1, 16, 16))
    with pytest.raises(ValueError, match="0 methods"):
        qualitative_grid(images, {}, true, info=INFO, meshes=None)
    with pytest.raises(ValueError, match=r"m has rotations of shape \(1, 3, 3\) for 2"):
        qualitative_grid(images, {"m": true[:1]}, true, info=INFO, meshes=None)
