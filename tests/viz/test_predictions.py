"""The picture of one answer: panels, texts and warnings."""

import numpy as np

from i2i.viz.predictions import class_figure, pose_figure


def test_prediction_and_alternatives_have_a_panel_each():
    views = np.random.default_rng(0).random((3, 1, 8, 8))
    figure = pose_figure(
        np.zeros((1, 8, 8)), views=views, class_name="chair", euler_deg=(10.0, 20.0, 30.0),
        probabilities=[0.83, 0.1, 0.004], warnings=["A long sentence."],
    )  # fmt: skip
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[0] == "input: chair"
    assert "83 %" in titles[1]
    assert "10°, 20°, 30°" in titles[1]
    assert titles[2:] == ["alternative 1\n10 %", "alternative 2\n< 1 %"]
    for axes, view in zip(figure.axes[1:], views, strict=True):
        np.testing.assert_array_equal(np.asarray(axes.images[0].get_array()), view[0])
    assert "A long sentence." in figure.get_supxlabel()


def test_without_a_mesh_the_numbers_are_still_there():
    figure = pose_figure(
        np.zeros((1, 8, 8)), views=None, class_name="chair", euler_deg=(1.0, 2.0, 3.0),
        probabilities=[None],
    )  # fmt: skip
    assert "no reference mesh" in figure.axes[1].texts[0].get_text()


def test_class_bars_from_the_most_probable_down():
    axes = class_figure(np.zeros((1, 8, 8)), probabilities={"sofa": 0.7, "bed": 0.3}).axes[1]
    assert [bar.get_width() for bar in axes.patches] == [70.0, 30.0]
    assert axes.yaxis_inverted()
