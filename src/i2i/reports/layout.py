"""Where a result stands in a table: its row, its columns, and what the columns are called."""

from collections.abc import Iterable

from i2i.reports.model import MEAN, Column
from i2i.reports.paper import PaperTable
from i2i.reports.results import Result

METRICS = {
    "accuracy": "accuracy",
    "map_retrieval": "mAP: map_retrieval",
    "map_retrieval_class_first": "map_retrieval_class_first",
    "map_class": "map_class",
}


def belongs(table: PaperTable, result: Result) -> bool:
    """Whether a result is one of those that a table shows."""
    return result.job.get("task") == table.task and bool(places(table, result))


def places(table: PaperTable, result: Result) -> list[tuple[str, str, str]]:
    """Row, column and class of everything that a result says in a table.

    A network of several classes fills several columns.
    """
    job = result.job
    rows = {row.key for row in table.rows if row.input == job.get("modality")}
    model = str(job["model"])
    if _is_shift(table):
        name = result.classes[0]
        return [(row, amount, name) for row, amount in _shifts(result) if row in rows]
    if model not in rows:
        return []
    if table.columns_are == "object":
        return [(model, name, name) for name in result.classes]
    if table.columns_are == "views":
        return [(model, str(job.get("views_per_instance")), name) for name in result.classes]
    return [(model, metric, "") for metric in METRICS if metric in result.metrics]


def columns(table: PaperTable, found: Iterable[str]) -> tuple[Column, ...]:
    """The paper's columns, then those that only we have, then the mean where classes stand apart.

    Args:
        table: The paper's.
        found: Column keys of our results.
    """
    keys = list(dict.fromkeys([*table.columns, *_ordered(found)]))
    made = [_column(table, key) for key in (_ordered(keys) if _is_shift(table) else keys)]
    if table.columns_are == "object":
        made.append(Column(MEAN, "mean", digits=table.digits))
    return tuple(made)


def _is_shift(table: PaperTable) -> bool:
    return table.columns_are == "shift"


def _column(table: PaperTable, key: str) -> Column:
    paper = key in table.columns
    if table.columns_are == "metric":
        return Column(key, METRICS[key], paper, unit="%", factor=100.0, digits=table.digits)
    names = {"views": f"{key} views", "shift": f"±{key}"}
    return Column(key, names.get(table.columns_are, key), paper, digits=table.digits)


def _ordered(keys: Iterable[str]) -> list[str]:
    """Numbers by value, metrics in their usual order, words by the alphabet."""
    metrics = list(METRICS)

    def rank(key: str) -> tuple[float, str]:
        if key in METRICS:
            return (metrics.index(key), key)
        return (float(key), key) if key.replace(".", "", 1).isdigit() else (0.0, key)

    return sorted(set(keys), key=rank)


def _shifts(result: Result) -> list[tuple[str, str]]:
    """Kinds and amounts of shift that a job had both in training and in test.

    The plain amount of training shift (the scale's) does not make a job one of pixel shifts. A test
    without any shift is the reference of both kinds.
    """
    job = result.job
    pixel, test_pixel = job.get("shift_px"), job.get("test_shift_px") or 0
    depth, test_depth = job.get("depth_shift") or 0, job.get("test_depth_shift") or 0
    if result.job["model"] != "i2i":
        return []
    if test_pixel == test_depth == depth == 0:
        return [("pixel_shift", "0"), ("depth_shift", "0")]
    if depth == test_depth == 0 and pixel == test_pixel:
        return [("pixel_shift", f"{pixel:g}")]
    if test_pixel == 0 and depth == test_depth:
        return [("depth_shift", f"{depth:g}")]
    return []
