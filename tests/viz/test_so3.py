"""Distributions over SO(3): projection, turns, masses and equivalents against closed forms."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from i2i.geometry.icosahedron import icosahedron
from i2i.models.prediction import PosePrediction
from i2i.viz.so3 import PoseSample, RotationDistribution, so3_figure
from i2i.viz.sphere import map_coordinates
from i2i.viz.style import HUES, angle_color, figure_to_array


def view_at(longitude_deg, latitude_deg, turn_deg):
    """Object → camera rotation whose place and turn on the view's map are given."""
    angles = [longitude_deg, 90.0 - latitude_deg, turn_deg]
    return Rotation.from_euler("ZYZ", angles, degrees=True).as_matrix().T


def drawn(axes, label):
    """Scatters and lines of the map with a label."""
    return [c for c in axes.collections if c.get_label() == label]


def maps(figure):
    return [axes for axes in figure.axes if axes.name == "mollweide"]


def test_map_coordinates_are_the_zyz_angles():
    rng = np.random.default_rng(0)
    expected = rng.uniform((-179.0, -89.0, 1.0), (179.0, 89.0, 359.0), (50, 3))
    turns = np.stack([view_at(*angles) for angles in expected])
    longitude, latitude, turn = map_coordinates(torch.from_numpy(turns))
    np.testing.assert_allclose(np.degrees(longitude), expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(np.degrees(latitude), expected[:, 1], atol=1e-6)
    np.testing.assert_allclose(turn, expected[:, 2], atol=1e-6)


def test_at_a_pole_the_turn_is_counted_from_longitude_zero():
    _, latitude, turn = map_coordinates(view_at(0.0, 90.0, 40.0)[None])
    assert np.degrees(latitude[0]) == pytest.approx(90.0)
    assert turn[0] == pytest.approx(40.0)


def test_in_the_cameras_map_right_is_right_and_the_viewer_is_in_the_middle():
    to_viewer = np.eye(3)  # object z to the viewer, object y up
    to_the_right = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # z right, x up, y to the viewer
    upwards = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up, y away from the viewer
    longitude, latitude, turn = map_coordinates(
        np.stack([to_viewer, to_the_right, upwards]), "object"
    )
    np.testing.assert_allclose(np.degrees(longitude[:2]), [0.0, 90.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(latitude), [0.0, 0.0, 90.0], atol=1e-9)
    # y points up the map in the middle; seen from the right side, the viewer is in the west.
    np.testing.assert_allclose(turn[:2], [90.0, 180.0], atol=1e-9)


def test_turning_the_picture_turns_the_colour_and_nothing_else():
    turns = Rotation.random(20, random_state=0).as_matrix()
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    longitude, latitude, turn = map_coordinates(turns)
    after = map_coordinates(quarter @ turns)  # the object turns, so the camera turns back
    np.testing.assert_allclose(after[0], longitude, atol=1e-9)
    np.testing.assert_allclose(after[1], latitude, atol=1e-9)
    np.testing.assert_allclose((after[2] - turn) % 360.0, 270.0, atol=1e-6)


def test_the_map_is_mollweides():
    axes = maps(so3_figure(RotationDistribution.from_samples(np.eye(3)[None])))[0]
    project = axes.transProjection.transform
    width, height = 2.0 * np.sqrt(2.0), np.sqrt(2.0)
    spots = np.array([[0.0, np.pi / 2], [0.0, -np.pi / 2], [0.0, 0.0], [np.pi, 0.0], [-2.0, 0.0]])
    expected = [[0, height], [0, -height], [0, 0], [width, 0], [-2.0 / np.pi * width, 0]]
    np.testing.assert_allclose(project(spots), expected, atol=1e-6)
    for latitude in (0.3, 1.0):  # 2t + sin 2t = π sin(latitude), checked after the fact
        y = project([[0.0, latitude]])[0, 1]
        t = np.arcsin(y / height)
        assert 2 * t + np.sin(2 * t) == pytest.approx(np.pi * np.sin(latitude), abs=1e-4)


def test_equal_areas_of_the_sphere_are_equal_areas_of_the_map():
    figure = so3_figure(
        RotationDistribution.from_samples(Rotation.random(4000, random_state=0).as_matrix())
    )
    axes = maps(figure)[0]
    spots = np.asarray(drawn(axes, "mass")[0].get_offsets())
    x, y = axes.transProjection.transform(spots).T / np.array([[2.0], [1.0]])
    radius_squared = (x**2 + y**2) / 2.0
    assert radius_squared.max() <= 1.0 + 1e-9
    # Uniform on the ellipse: uniform radius², uniform angle, to the Monte Carlo error.
    shares = (
        np.histogram2d(
            radius_squared,
            np.arctan2(y, x),
            bins=[np.linspace(0, 1, 4), np.linspace(-np.pi, np.pi, 7)],
        )[0].ravel()
        / 4000.0
    )
    np.testing.assert_allclose(shares, 1 / 18, atol=4 * np.sqrt(1 / 18 / 4000))


def test_areas_are_the_masses_and_colours_the_turns():
    rng = np.random.default_rng(1)
    turns = Rotation.random(40, random_state=1).as_matrix()
    mass = rng.dirichlet(np.full(40, 0.5))
    distribution = RotationDistribution.from_candidates(turns, np.log(mass), max_kept=40)
    axes = maps(so3_figure(distribution))[0]
    dots = drawn(axes, "mass")[0]
    kept = np.argsort(-mass)[: len(dots.get_offsets())]
    areas = dots.get_sizes()
    np.testing.assert_allclose(areas / areas.sum(), mass[kept] / mass[kept].sum(), rtol=1e-9)
    longitude, latitude, turn = map_coordinates(turns[kept])
    np.testing.assert_allclose(dots.get_offsets(), np.stack([longitude, latitude], axis=1))
    np.testing.assert_allclose(dots.get_facecolors()[:, :3], angle_color(turn)[:, :3])
    assert f"{100 * mass[kept].sum():.3g} % of the mass" in axes.texts[-1].get_text()


def test_only_negligible_candidates_are_left_out():
    log_prob = torch.log_softmax(torch.tensor([9.0, 8.0, 7.0, -9.0]).repeat(25), dim=0)
    turns = torch.from_numpy(Rotation.random(100, random_state=0).as_matrix()).float()
    everything = RotationDistribution.from_candidates(turns, log_prob)
    assert everything.candidates == 100
    assert len(everything.mass) <= 75
    assert 0.999 <= everything.mass.sum() <= 1.0
    few = RotationDistribution.from_candidates(turns, log_prob, max_kept=25)
    np.testing.assert_allclose(few.mass, log_prob.exp().max().item(), rtol=1e-5)
    chosen = {tuple(row) for row in turns[::4].reshape(25, 9).numpy().astype(np.float64).tolist()}
    assert {tuple(row) for row in few.rotations.reshape(25, 9).tolist()} == chosen


def test_shared_and_own_candidates_of_a_prediction():
    turns = torch.from_numpy(Rotation.random(6, random_state=0).as_matrix()).reshape(2, 3, 3, 3)
    log_prob = torch.tensor([[0.5, 0.3, 0.2], [0.2, 0.3, 0.5]]).log()
    own = PosePrediction(turns[:, 0], log_prob=log_prob, candidates=turns)
    shared = PosePrediction(turns[:, 0], log_prob=log_prob, candidates=turns[0])
    found = RotationDistribution.from_prediction(own, 1)
    np.testing.assert_allclose(found.rotations, turns[1].flip(0).numpy())
    np.testing.assert_allclose(found.mass, [0.5, 0.3, 0.2], rtol=1e-6)
    found = RotationDistribution.from_prediction(shared, 1)
    np.testing.assert_allclose(found.rotations, turns[0].flip(0).numpy())
    assert RotationDistribution.from_prediction(PosePrediction(turns[:, 0])) is None


def test_equivalents_are_a_circle_of_latitude_or_two_opposite_rings():
    bare = RotationDistribution.from_samples(np.eye(3)[None])
    true = view_at(30.0, 50.0, 70.0)
    figure = so3_figure([PoseSample(bare, true=true, symmetry=s) for s in ("none", "z2", "z")])
    none, half, full = (drawn(axes, "true") for axes in maps(figure))
    np.testing.assert_allclose(np.degrees(none[0].get_offsets()), [[30.0, 50.0]])
    spots = sorted(np.degrees(ring.get_offsets())[0].tolist() for ring in half)
    np.testing.assert_allclose(spots, [[-150.0, 50.0], [30.0, 50.0]])
    segments = np.degrees(np.concatenate(full[1].get_segments()))
    np.testing.assert_allclose(segments[:, 1], 50.0)
    assert len(np.unique(np.round(segments[:, 0]))) > 350
    np.testing.assert_allclose(full[1].get_colors(), angle_color(np.full(1, 70.0))[[0] * 359])


@pytest.mark.parametrize(("symmetry", "arcs"), [("none", 1), ("z2", 2), ("z", 36)])
def test_about_the_objects_own_axis_one_ring_has_all_colours(symmetry, arcs):
    bare = RotationDistribution.from_samples(np.eye(3)[None])
    true = Rotation.random(random_state=5).as_matrix()
    axes = maps(so3_figure([PoseSample(bare, true=true, symmetry=symmetry)], axis="object"))[0]
    assert len(drawn(axes, "true")) == 1
    colors = [arc.get_edgecolor()[0] for arc in drawn(axes, "turn")]
    own = map_coordinates(true[None], "object")[2][0]
    expected = angle_color(own + np.arange(arcs) * 360.0 / arcs)
    np.testing.assert_allclose(sorted(map(tuple, colors)), sorted(map(tuple, expected)), atol=0.03)


def test_one_row_a_sample_with_image_map_and_icosahedron():
    group = icosahedron(1).rotations
    mass = torch.full((60,), 1 / 60)
    sample = PoseSample(
        RotationDistribution.from_candidates(group.mT, mass.log()),
        image=np.zeros((1, 8, 8)), true=np.eye(3), predicted=np.full((3, 3), np.nan),
        group_mass=mass, group_target=0, title="chair",
    )  # fmt: skip
    figure = so3_figure([sample] * 2, group=group, heading="both")
    assert len(maps(figure)) == 2
    assert [axes.get_title() for axes in figure.axes if axes.images] == ["chair"] * 2
    assert len([axes for axes in figure.axes if drawn(axes, "front")]) == 2
    assert not drawn(maps(figure)[0], "predicted")  # a diverged network predicts no place
    assert figure_to_array(figure).std() > 0


def test_colours_meet_at_the_ends_and_none_is_as_light_as_paper():
    colors = HUES(np.arange(256))[:, :3]
    steps = np.linalg.norm(np.diff(colors, axis=0, append=colors[:1]), axis=1)
    assert steps.max() < 0.1  # red fades into nothing quickly at teal
    assert steps[-1] < 0.02
    assert (colors @ [0.2126, 0.7152, 0.0722]).max() < 0.85
    np.testing.assert_array_equal(angle_color(np.array([-90.0])), angle_color(np.array([270.0])))


def test_what_cannot_be_drawn_is_refused():
    turns = np.stack([np.eye(3)] * 4)
    with pytest.raises(ValueError, match="not of a density"):
        RotationDistribution.from_candidates(turns, np.zeros(4))
    with pytest.raises(ValueError, match="not to 1"):
        RotationDistribution.from_candidates(turns, np.full(4, np.nan))
    with pytest.raises(ValueError, match="one image's distribution"):
        RotationDistribution.from_candidates(turns, np.zeros((2, 4)))
    with pytest.raises(ValueError, match="Allowed: view, object"):
        map_coordinates(turns, "x")
    with pytest.raises(ValueError, match="no samples"):
        so3_figure([])
