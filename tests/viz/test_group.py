"""The 60 rotations laid out as a table and on a map: against the geometry itself."""

import numpy as np
import pytest

from i2i.geometry.icosahedron import icosahedron
from i2i.viz.group import group_figure, group_layout


@pytest.fixture(scope="module")
def rotations():
    return icosahedron(1).rotations.numpy()


def test_each_cell_holds_one_element(rotations):
    layout = group_layout(rotations)
    assert sorted(zip(layout.row, layout.column, strict=True)) == [
        (row, column) for row in range(12) for column in range(5)
    ]


def test_rows_are_camera_directions_from_north_to_south(rotations):
    layout = group_layout(rotations)
    np.testing.assert_allclose(layout.directions[layout.row], rotations[:, :, 2], atol=1e-5)
    heights = layout.directions[:, 2]
    assert (np.diff(heights) <= 1e-6).all()
    np.testing.assert_allclose(heights, [1, *[5**-0.5] * 5, *[-(5**-0.5)] * 5, -1], atol=1e-5)


def test_columns_are_turns_by_72_degrees_about_the_viewing_axis(rotations):
    layout = group_layout(rotations)
    angle = np.radians(72.0)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    for row in range(12):
        members = np.flatnonzero(layout.row == row)
        by_column = members[np.argsort(layout.column[members])]
        for this, following in zip(by_column, np.roll(by_column, -1), strict=True):
            np.testing.assert_allclose(rotations[this] @ turn, rotations[following], atol=1e-9)


def test_sectors_point_where_the_cameras_up_axis_does(rotations):
    layout = group_layout(rotations)
    for element in range(60):
        direction, up = rotations[element][:, 2], rotations[element][:, 1]
        if abs(direction[2]) > 0.99:
            continue
        # A small step along the up axis moves by this much in latitude and longitude.
        moved = direction + 1e-6 * up
        moved /= np.linalg.norm(moved)
        latitude = (np.arcsin(moved[2]) - np.arcsin(direction[2])) / 1e-6
        longitude = np.arctan2(moved[1], moved[0]) - np.arctan2(direction[1], direction[0])
        eastward = np.remainder(longitude + np.pi, 2 * np.pi) - np.pi
        eastward *= np.hypot(direction[0], direction[1]) / 1e-6
        expected = np.degrees(np.arctan2(latitude, eastward))
        difference = (layout.up_deg[element] - expected + 180.0) % 360.0 - 180.0
        assert abs(difference) < 0.01


def test_the_published_frame_can_be_drawn_too():
    layout = group_layout(icosahedron(1, "standard").rotations)
    assert np.bincount(layout.row).tolist() == [5] * 12


def test_table_shows_each_probability_in_its_cell(rotations):
    mass = np.arange(60) / np.arange(60).sum()
    figure = group_figure(mass, rotations=rotations, target=3)
    table = figure.axes[0].images[0].get_array()
    layout = group_layout(rotations)
    np.testing.assert_allclose(np.asarray(table)[layout.row, layout.column], mass)
    marker = figure.axes[0].lines[0]
    assert (marker.get_xdata()[0], marker.get_ydata()[0]) == (layout.column[3], layout.row[3])


def test_other_rotations_are_refused(rotations):
    with pytest.raises(ValueError, match="icosahedr"):
        group_layout(rotations[:30])
    with pytest.raises(ValueError, match="12 probabilities for 60"):
        group_figure(np.ones(12), rotations=rotations)
