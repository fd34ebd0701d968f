"""Bars and recall curves of reports."""

import numpy as np
import pytest

from i2i.viz.report import Bar, bar_figure, recall_figure


def test_bars_have_their_length_interval_and_mark():
    figure = bar_figure({"chair": [Bar("a", 10.0, 8.0, 13.0, 20.0), Bar("b")]}, unit="degrees")
    (axes,) = figure.axes
    assert [patch.get_width() for patch in axes.patches] == [10.0]
    drawn = [line.get_xdata().tolist() for line in axes.lines]
    assert [8.0, 13.0] in drawn
    assert [20.0] in drawn
    assert axes.get_xlabel() == "degrees"
    assert "–" in [text.get_text() for text in axes.texts]
    low, high = axes.get_ylim()
    assert low > high  # the first on top
    assert figure.legends


def test_without_published_numbers_nothing_is_marked():
    assert not bar_figure({"chair": [Bar("a", 1.0)]}, unit="°").legends


def test_panels_wrap_and_spare_ones_are_removed():
    figure = bar_figure({str(i): [Bar("a", 1.0)] for i in range(6)}, unit="°")
    assert len(figure.axes) == 6
    assert figure.get_size_inches()[1] > 2


def test_recall_is_the_share_under_each_error_in_one_colour_a_method():
    panels = {"x": {"a": np.array([10.0, 20.0, 90.0, 170.0])}, "y": {"b": np.array([1.0])}}
    figure = recall_figure(panels, names=["a", "b"])
    first, second = ({line.get_label(): line for line in axes.lines} for axes in figure.axes)
    angles, share = first["a"].get_data()
    for angle, expected in ((9.0, 0.0), (45.0, 50.0), (120.0, 75.0), (180.0, 100.0)):
        assert share[np.searchsorted(angles, angle)] == expected
    assert first["a"].get_color() != second["b"].get_color()
    chance = first["random guess"].get_ydata()
    assert (chance[0], chance[-1]) == pytest.approx((0.0, 100.0))
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["a", "b", "random guess"]


@pytest.mark.parametrize("count", [3, 10])
@pytest.mark.parametrize("length", [5, 40])
def test_the_legend_lies_inside_the_figure(count, length):
    names = [f"{i}".ljust(length, "m") for i in range(count)]
    figure = recall_figure({"x": {name: np.array([10.0]) for name in names}})
    figure.canvas.draw()
    inside = figure.legends[0].get_window_extent()
    assert inside.x0 >= 0
    assert inside.x1 <= figure.bbox.x1


def test_no_panels_are_refused():
    with pytest.raises(ValueError, match="no panels"):
        recall_figure({})
