"""The figures of a report: its first setting's numbers, as `i2i.viz.report` draws them."""

from matplotlib.figure import Figure

from i2i.reports.model import MEAN, Column, Report, Row
from i2i.viz.report import Bar, bar_figure, recall_figure

_UNITS = {"°": "median error (degrees)", "%": "percent", "parameters": "million parameters"}


def report_figures(report: Report) -> dict[str, Figure]:
    """`bars` and, where there are errors of views, `recall`; nothing where nothing is ours."""
    section = report.sections[0]
    rows = [row for row in section.rows if row.ours]
    columns = [column for column in section.columns if _worth_a_panel(column, rows)]
    if not columns:
        return {}
    names = _names(rows)
    heading = f"Table {report.number}, {section.title}"
    bars = {
        column.name: [_bar(name, row, column) for name, row in zip(names, rows, strict=True)]
        for column in columns
    }
    unit = _UNITS[columns[0].unit]
    figures = {"bars": bar_figure(bars, unit=unit, heading=heading)}
    curves = {
        "all classes" if column.key == MEAN else column.name: {
            name: row.errors[column.key]
            for name, row in zip(names, rows, strict=True)
            if column.key in row.errors
        }
        for column in columns
    }
    if any(curves.values()):
        figures["recall"] = recall_figure(curves, names=names, heading=heading)
    return figures


def _worth_a_panel(column: Column, rows: list[Row]) -> bool:
    """Columns with something of ours; the mean only where it is over several classes."""
    cells = [row.ours[column.key] for row in rows if column.key in row.ours]
    return any(column.key != MEAN or len(cell.classes) > 1 for cell in cells)


def _names(rows: list[Row]) -> list[str]:
    """Names of methods, with what they see where the table has several inputs."""
    several = len({row.input for row in rows}) > 1
    return [f"{row.name} ({row.input})" if several else row.name for row in rows]


def _bar(name: str, row: Row, column: Column) -> Bar:
    paper, cell = row.paper.get(column.key), row.ours.get(column.key)
    if cell is None:
        return Bar(name, paper=paper)
    if column.unit == "parameters":
        return Bar(name, cell.value / 1e6, paper=paper)
    return Bar(name, cell.value, cell.low, cell.high, paper)
