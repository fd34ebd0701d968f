"""Bars and table show the numbers of the measurement."""

import io

import pytest
from rich.console import Console

from i2i.testing.measured import Measurement
from i2i.viz.equivariance import FLOOR, equivariance_figure, equivariance_table

ROWS = [
    Measurement("stem", "C4", "map -> regular", True, ("90°",), (1e-6,), (0.5,), (2e-6,)),
    Measurement("conv", "I60", "sphere -> group", True, ("0", "1"), (0.0, 0.0), (0.4, 0.3)),
    Measurement("end to end", "C4", "image", False, ("90°",), (0.9,), (float("nan"),), (0.9,)),
]


def test_bars_end_at_the_values():
    axes = equivariance_figure(ROWS, tolerance=1e-3, heading="run").axes[0]
    ends = [[bar.get_x() + bar.get_width() for bar in group] for group in axes.containers]
    assert ends[0] == pytest.approx([1e-6, 1.15 * FLOOR, 0.9])
    assert ends[1] == pytest.approx([2e-6, FLOOR, 0.9])  # no turn of the image: no bar
    assert ends[2] == pytest.approx([0.5, 0.3, FLOOR])
    assert axes.get_xscale() == "log"
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["stem  (C4)", "conv  (I60)", "end to end  (C4)"]


def test_the_table_has_a_verdict_for_each_row():
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(equivariance_table(ROWS, tolerance=1e-3))
    lines = [line for line in console.export_text().splitlines() if "│" in line]
    assert [line.split("│")[-2].strip() for line in lines] == ["exact", "exact", "undecided"]
    assert "(image)" in lines[2]  # in brackets: nobody claims it
    assert "2.0e-06" in lines[0]


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="no measurements"):
        equivariance_figure([], tolerance=1e-3)
