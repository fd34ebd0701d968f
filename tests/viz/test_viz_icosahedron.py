"""Figures of the network's inner steps: points where the geometry says, sizes as documented."""

import numpy as np

from i2i.geometry.icosahedron import icosahedron
from i2i.viz.icosahedron import filter_figure, icosahedron_figure, projection_figure


def offsets(axes):
    return np.asarray(axes.collections[0].get_offsets())


def test_the_visible_half_is_drawn_x_right_y_up():
    mesh = icosahedron(1)
    flat = icosahedron_figure(mesh).axes[1]
    np.testing.assert_allclose(offsets(flat), mesh.visible_xy.numpy())
    assert [text.get_text() for text in flat.texts] == [str(i) for i in mesh.visible.tolist()]
    assert flat.get_ylim()[0] < flat.get_ylim()[1]


def test_sampling_points_lie_on_the_same_spots_of_image_and_map():
    mesh = icosahedron(1)
    a, b = mesh.visible_xy.numpy().T
    positions = np.stack([4 - 3.6 * b, 4 + 3.6 * a], axis=1)  # row, column
    figure = projection_figure(
        np.zeros((1, 64, 64)), feature_map=np.ones((5, 8, 8)), positions=positions,
        signal=np.ones((16, 5)), mesh=mesh,
    )  # fmt: skip
    image, feature_map = figure.axes[:2]
    # imshow puts the centre of pixel 0 at 0, so half a pixel lies between its axes and ours.
    np.testing.assert_allclose(np.stack(image.lines[0].get_data()[::-1], 1) + 0.5, positions * 8)
    np.testing.assert_allclose(np.stack(feature_map.lines[0].get_data()[::-1], 1), positions)
    np.testing.assert_allclose(np.asarray(feature_map.images[0].get_array()), 5**0.5)


def test_filter_has_a_panel_for_each_output():
    mesh = icosahedron(1)
    dynamic_filter = np.random.default_rng(0).random((16, 3, 7))
    figure = filter_figure(dynamic_filter, mesh=mesh)
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert len(panels) == 7
    drawn = np.asarray(panels[2].collections[0].get_array())
    np.testing.assert_allclose(drawn, np.linalg.norm(dynamic_filter[:, :, 2], axis=1))
