"""Heat on the icosahedron: each rotation has its own corner of a face, against the geometry."""

import numpy as np
import pytest
from matplotlib.colors import Normalize

from i2i.geometry.icosahedron import icosahedron
from i2i.viz.heat import corner_kites, draw_heat, heat_figure
from i2i.viz.style import HEAT, new_figure


def areas(polygons):
    """Areas of planar polygons (N, M, 3)."""
    rolled = np.roll(polygons, -1, axis=1)
    return np.linalg.norm(np.cross(polygons, rolled).sum(axis=1), axis=1) / 2


@pytest.mark.parametrize("frame", ["conjugated", "standard"])
def test_the_corners_are_congruent_and_cover_the_surface(frame):
    kites = corner_kites(icosahedron(1, frame).rotations)
    edge = 2 / np.sqrt(1 + ((1 + np.sqrt(5)) / 2) ** 2)
    np.testing.assert_allclose(areas(kites), 20 * np.sqrt(3) / 4 * edge**2 / 60, rtol=1e-5)
    assert len(np.unique(np.round(kites.mean(axis=1), 4), axis=0)) == 60
    _, faces = np.unique(np.round(kites[:, 2], 4), axis=0, return_counts=True)
    assert faces.tolist() == [3] * 20
    _, vertices = np.unique(np.round(kites[:, 0], 4), axis=0, return_counts=True)
    assert vertices.tolist() == [5] * 12


def test_each_corner_is_below_its_camera_on_the_side_of_its_up_axis():
    group = icosahedron(1).rotations.numpy()
    kites = corner_kites(group)
    np.testing.assert_allclose(kites[:, 0], group[:, :, 2], atol=1e-6)
    into_face = kites[:, 2] - kites[:, 0]
    up, right = group[:, :, 1], group[:, :, 0]
    angle = np.degrees(np.arctan2((into_face * right).sum(1), (into_face * up).sum(1)))
    np.testing.assert_allclose(np.abs(angle), 18.0, atol=1e-4)  # a face reaches 36° to both sides


def test_each_probability_is_drawn_once_in_its_own_corner():
    group = icosahedron(1).rotations.numpy()
    mass = np.random.default_rng(0).dirichlet(np.ones(60))
    figure = heat_figure(mass, rotations=group, target=7)
    sides = {c.get_label(): c for c in figure.axes[0].collections}
    colors = np.concatenate([sides[name].get_facecolors() for name in ("front", "back")])
    from matplotlib import colormaps

    expected = colormaps[HEAT](mass / mass.max())
    np.testing.assert_allclose(sorted(map(tuple, colors)), sorted(map(tuple, expected)))
    assert len(sides["front"].get_paths()) == len(sides["back"].get_paths()) == 30
    # The target's face is the middle of the front view, so that its corner touches the centre.
    index = [np.allclose(c, expected[7]) for c in sides["front"].get_facecolors()].index(True)
    corner = sides["front"].get_paths()[index].vertices
    assert np.linalg.norm(corner, axis=1).min() < 1e-6


def test_other_numbers_of_probabilities_are_refused():
    axes = new_figure(2, 2).subplots()
    with pytest.raises(ValueError, match="12 probabilities for 60"):
        draw_heat(axes, np.ones(12), rotations=icosahedron(1).rotations, norm=Normalize(0, 1))
