"""Figures as pure functions: arrays in, matplotlib figures out, without pyplot's global state."""

from i2i.viz.classes import confusion_figure
from i2i.viz.compare import compare_errors, compare_runs
from i2i.viz.curves import read_curves, training_figure
from i2i.viz.errors import error_figure, recall_at
from i2i.viz.grids import class_grid, prediction_grid
from i2i.viz.group import group_figure, group_layout
from i2i.viz.heat import heat_figure
from i2i.viz.icosahedron import filter_figure, icosahedron_figure, projection_figure
from i2i.viz.predictions import class_figure, pose_figure
from i2i.viz.qualitative import qualitative_grid
from i2i.viz.rerender import rerender, rerender_each
from i2i.viz.results import result_figures
from i2i.viz.so3 import PoseSample, RotationDistribution, so3_figure
from i2i.viz.style import figure_to_array, new_figure, save_figure

__all__ = [
    "PoseSample",
    "RotationDistribution",
    "class_figure",
    "class_grid",
    "compare_errors",
    "compare_runs",
    "confusion_figure",
    "error_figure",
    "figure_to_array",
    "filter_figure",
    "group_figure",
    "group_layout",
    "heat_figure",
    "icosahedron_figure",
    "new_figure",
    "pose_figure",
    "prediction_grid",
    "projection_figure",
    "qualitative_grid",
    "read_curves",
    "recall_at",
    "rerender",
    "rerender_each",
    "result_figures",
    "save_figure",
    "so3_figure",
    "training_figure",
]
