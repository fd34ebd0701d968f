"""Re-rendering: the right mesh in the right orientation, blank where nothing can be drawn."""

import numpy as np
import pytest
import trimesh

from i2i.data.info import DataInfo
from i2i.rendering.mesh import prepare_mesh
from i2i.viz.rerender import rerender, rerender_each

INFO = DataInfo(("a",), ("none",), channels=1, image_size=24, modality="gray")


@pytest.fixture(scope="module")
def stick():
    return prepare_mesh(trimesh.creation.box((0.2, 0.2, 2.0)))


def extent(image):
    rows, columns = np.nonzero(image < 0.95)
    return np.ptp(columns) + 1, np.ptp(rows) + 1


def test_object_to_camera_rotation_with_rows_down(stick):
    along_z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # object z becomes camera y (up)
    along_x = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # object z becomes camera x
    upright, lying = rerender(stick, np.stack([along_z_up, along_x]), info=INFO)[:, 0]
    assert extent(upright)[1] > 3 * extent(upright)[0]
    assert extent(lying)[0] > 3 * extent(lying)[1]


def test_each_sample_gets_its_own_mesh_and_missing_ones_stay_blank(stick):
    ball = prepare_mesh(trimesh.creation.icosphere())
    turns = np.stack([np.eye(3)] * 4)
    pictures = rerender_each([stick, None, ball, stick], turns, info=INFO)
    np.testing.assert_array_equal(pictures[0], rerender(stick, turns[:1], info=INFO)[0])
    np.testing.assert_array_equal(pictures[3], pictures[0])
    assert (pictures[1] == 1.0).all()
    assert (pictures[2] < 0.95).mean() > 2 * (pictures[0] < 0.95).mean()


def test_not_finite_and_half_precision_rotations(stick):
    turns = np.stack([np.full((3, 3), np.nan), np.eye(3) * 1.004])
    pictures = rerender(stick, turns, info=INFO, image_size=32)
    assert pictures.shape == (2, 1, 32, 32)
    assert (pictures[0] == 1.0).all()
    np.testing.assert_array_equal(
        pictures[1], rerender(stick, np.eye(3)[None], info=INFO, image_size=32)[0]
    )


def test_channels_follow_the_modality(stick):
    info = DataInfo(("a",), ("none",), channels=3, image_size=16, modality="rgb")
    assert rerender(stick, np.eye(3)[None], info=info).shape == (1, 3, 16, 16)
    with pytest.raises(ValueError, match="1 meshes for 2"):
        rerender_each([stick], np.stack([np.eye(3)] * 2), info=info)
