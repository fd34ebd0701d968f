"""A report as CSV: one line a cell, numbers with all their digits."""

import csv
import io

from i2i.reports.model import Column, Report, Row, Section

FIELDS = (
    "table", "setting", "input", "method", "column", "unit", "paper", "ours", "spread_over_seeds",
    "low", "high", "seeds", "test_instances", "classes", "paper_parameters_millions", "parameters",
)  # fmt: skip


def csv_text(report: Report) -> str:
    """The whole report; what is not there is an empty field, lists are joined by spaces."""
    out = io.StringIO()
    writer = csv.DictWriter(out, FIELDS, lineterminator="\n")
    writer.writeheader()
    for section in report.sections:
        for row in section.rows:
            for column in section.columns:
                writer.writerow(_fields(report, section, row, column))
    return out.getvalue()


def _fields(report: Report, section: Section, row: Row, column: Column) -> dict[str, object]:
    cell = row.ours.get(column.key)
    fields: dict[str, object] = {
        "table": report.number,
        "setting": section.title,
        "input": row.input,
        "method": row.key,
        "column": column.key,
        "unit": column.unit,
        "paper": row.paper.get(column.key),
        "paper_parameters_millions": row.paper_parameters,
        "parameters": " ".join(map(str, row.parameters)),
    }
    if column.unit == "parameters" and column.key in row.paper:
        fields["paper"] = row.paper[column.key] * 1e6
    if cell is not None:
        fields |= {
            "ours": cell.value,
            "spread_over_seeds": cell.spread,
            "low": cell.low,
            "high": cell.high,
            "seeds": " ".join(map(str, cell.seeds)),
            "test_instances": cell.instances or None,
            "classes": " ".join(cell.classes),
        }
    return fields
