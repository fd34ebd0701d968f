"""A report of one table: sections by setting, rows by method, comparisons, what is missing."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from i2i.reports.layout import belongs, columns, places
from i2i.reports.missing import missing_at, missing_everywhere
from i2i.reports.model import MEAN, Cell, Column, Comparison, Report, Row, Section
from i2i.reports.paper import Paper, PaperRow, PaperTable
from i2i.reports.results import Filters, Result, Setting, one_a_seed, setting_of
from i2i.reports.statistics import accuracy_gain, median_cell, median_gain, metric_cell, pooled

REFERENCE = "i2i"
ByClass = dict[str, list[Result]]
ByColumn = dict[str, ByClass]
Placed = dict[tuple[str, str], ByColumn]
"""Results by (input, row), column and class, one a seed."""


def build_report(
    number: int,
    results: Sequence[Result],
    paper: Paper,
    *,
    filters: Filters | None = None,
    problems: Sequence[str] = (),
) -> Report:
    """One of the paper's tables with ours beside it.

    Args:
        number: Of the table.
        results: Of `read_results`.
        paper: The published numbers.
        filters: Which of the results to show.
        problems: Lines about results that could not be read.

    Raises:
        ConfigurationError: if the paper has no such table.
    """
    table, filters = paper.table(number), filters or Filters()
    mine = [result for result in results if belongs(table, result)]
    kept = [result for result in mine if filters.keep(result)]
    known = [result for result in kept if result.changes is not None]
    settings: dict[Setting, list[Result]] = defaultdict(list)
    for result in known:
        settings[setting_of(result, table.columns_are)].append(result)
    order = sorted(settings, key=lambda setting: (-len(settings[setting]), setting))
    sections = [_section(table, paper, setting, settings[setting]) for setting in order]
    notes = [table.remark] if table.remark else []
    notes += _left_out(mine, kept, known, filters)
    notes += problems
    return Report(
        number, table.title, tuple(sections or [_empty(table, paper, filters)]), tuple(notes)
    )


def _left_out(
    mine: Sequence[Result], kept: Sequence[Result], known: Sequence[Result], filters: Filters
) -> list[str]:
    """Lines on the results that the report does not show."""
    notes = []
    if len(kept) < len(mine):
        chosen = " ".join(filters.words())
        notes.append(f"Results of this table that are not at {chosen}: {len(mine) - len(kept)}.")
    if len(known) < len(kept):
        notes.append(
            f"Results that are left out: {len(kept) - len(known)}. They do not say in what their "
            "settings differ from the plain ones (results of an older version, or of a model or "
            "data file of another package), so they cannot be told apart; train again to have "
            "them here."
        )
    return notes


def _empty(table: PaperTable, paper: Paper, filters: Filters) -> Section:
    """The paper's table alone, with the command that fills ours."""
    lines, command = missing_everywhere(table.number, filters)
    shown = columns(table, ())
    rows = [_row(paper, printed, shown, {}, ()) for printed in table.rows]
    return Section("", shown, tuple(rows), missing=lines, command=command)


def _section(
    table: PaperTable, paper: Paper, setting: Setting, members: Sequence[Result]
) -> Section:
    placed, notes = _placed(table, members)
    shown = columns(table, (key for row in placed.values() for key in row))
    rows = [
        _row(paper, row, shown, placed.get((row.input, row.key), {}), _counts(placed, row))
        for row in table.rows
    ]
    lines, command = missing_at(table.number, setting, members, table.columns_are)
    return Section(
        setting.title(result.content["steps"] for result in members),
        shown,
        tuple(rows),
        tuple(_comparisons(paper, placed, rows, shown)),
        lines,
        command,
        (*_over_classes(table, rows), *notes),
        len(members),
    )


def _placed(table: PaperTable, members: Sequence[Result]) -> tuple[Placed, list[str]]:
    """The results where they belong, and a note on those that had no place of their own."""
    found: dict[tuple[str, str], dict[str, dict[str, list[Result]]]] = {}
    for result in members:
        for row, column, name in places(table, result):
            by_column = found.setdefault((str(result.job["modality"]), row), {})
            by_column.setdefault(column, {}).setdefault(name, []).append(result)
    doubled: dict[str, str] = {}
    for by_column in found.values():
        for by_class in by_column.values():
            for name, several in by_class.items():
                by_class[name], others = one_a_seed(several)
                chosen = {r.seed: r for r in by_class[name]}
                doubled |= {str(r.path): str(chosen[r.seed].path) for r in others}
    notes = [
        f"{other} is not counted: {chosen} has the same settings and seed."
        for other, chosen in sorted(doubled.items())
    ]
    return found, notes


def _counts(placed: Placed, row: PaperRow) -> tuple[int, ...]:
    by_column = placed.get((row.input, row.key), {})
    results = [
        r for by_class in by_column.values() for members in by_class.values() for r in members
    ]
    return tuple(sorted({result.content["parameters"] for result in results}))


def _row(
    paper: Paper,
    printed: PaperRow,
    shown: Sequence[Column],
    by_column: ByColumn,
    parameters: tuple[int, ...],
) -> Row:
    in_paper = [column.key for column in shown if column.paper and column.key != MEAN]
    numbers = {k: v for k, v in zip(in_paper, printed.values, strict=True) if v is not None}
    if printed.mean is not None and any(column.key == MEAN for column in shown):
        numbers[MEAN] = printed.mean
    ours, errors = {}, {}
    for column in shown:
        groups = _groups(by_column, column.key)
        cell = _cell(groups, column)
        if cell is not None:
            ours[column.key] = cell
        if groups and column.factor == 1.0:
            errors[column.key] = np.concatenate([pooled(n, r)[0] for n, r in groups.items()])
    return Row(
        printed.input,
        printed.key,
        paper.name(printed.key),
        numbers,
        ours,
        printed.parameters,
        parameters,
        errors,
    )


def _groups(by_column: ByColumn, key: str) -> ByClass:
    """Results by class of a column; the mean is over all classes."""
    if key != MEAN:
        return by_column.get(key, {})
    return {name: results for by_class in by_column.values() for name, results in by_class.items()}


def _cell(groups: ByClass, column: Column) -> Cell | None:
    if not groups:
        return None
    if column.factor != 1.0:
        return metric_cell(groups[""], column.key, factor=column.factor)
    return median_cell(groups)


def _comparisons(
    paper: Paper, placed: Placed, rows: Sequence[Row], shown: Sequence[Column]
) -> list[Comparison]:
    """The reference method against each other one that sees the same, column by column."""
    made = []
    for column in shown:
        for row in rows:
            ours, theirs = (
                _groups(placed.get((row.input, key), {}), column.key)
                for key in (REFERENCE, row.key)
            )
            both = [name for name in ours if name in theirs]
            if row.key == REFERENCE or not both or (column.key == MEAN and len(both) < 2):
                continue  # the mean over one class is that class's own column
            ours, theirs = ({n: groups[n] for n in both} for groups in (ours, theirs))
            cells = [_cell(groups, column) for groups in (ours, theirs)]
            found = (
                median_gain(ours, theirs)
                if column.factor == 1.0
                else accuracy_gain(ours[""], theirs[""], factor=column.factor)
                if column.key == "accuracy"
                else None  # no job keeps the average precision of each query
            )
            if found is not None:
                made.append(
                    Comparison(
                        row.input, column, paper.name(REFERENCE), row.name, _touch(*cells), *found
                    )
                )
    return made


def _touch(first: Cell | None, second: Cell | None) -> bool:
    """Whether two intervals have a point in common; unknown ones might."""
    ends = [end for cell in (first, second) if cell for end in (cell.low, cell.high)]
    if len(ends) < 4 or None in ends:
        return True
    a, b, c, d = (end for end in ends if end is not None)
    return a <= d and c <= b


def _over_classes(table: PaperTable, rows: Sequence[Row]) -> list[str]:
    """Over which classes our means are, by method where methods differ."""
    cells = [cell for row in rows for cell in row.ours.values()]
    if table.columns_are == "metric":
        names = sorted({name for cell in cells for name in cell.classes})
        return [f"Ours are over {len(names)} classes: {', '.join(names)}."]
    if table.columns_are == "shift":
        return []
    over: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        for column, cell in row.ours.items():
            if column == MEAN or table.columns_are == "views":
                where = f" ({column} views)" if table.columns_are == "views" else ""
                over[", ".join(sorted(cell.classes))].append(f"{row.name}{where}")
    if len(over) == 1:
        return [f"Our means are over: {next(iter(over))}."]
    return [f"Our mean is over {classes} for {', '.join(who)}." for classes, who in over.items()]
