"""A report as LaTeX tables in the manner of booktabs: one `table` a setting."""

from i2i.reports.model import Column, Report, Row, Section
from i2i.reports.numbers import (
    interval_text,
    legend,
    paper_parameters_text,
    paper_text,
    parameters_text,
    value_text,
)

_ESCAPES = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "_": r"\_", "%": r"\%", "&": r"\&",
    "#": r"\#", "$": r"\$", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "–": "--", "±": r"$\pm$", "°": r"$^\circ$", "−": "$-$", "×": r"$\times$", "“": "``", "”": "''",
    "<": r"\textless{}", ">": r"\textgreater{}", "[": "{[}", "]": "{]}", '"': r"\textquotedbl{}",
}  # fmt: skip


def latex(report: Report) -> str:
    """The tables of a report, for a document that loads booktabs."""
    head = [
        f"% Table {report.number} of the paper beside ours. Needs \\usepackage{{booktabs}},",
        "% \\usepackage[T1]{fontenc} and, for wide tables, landscape pages or a smaller font.",
    ]
    main, *others = report.sections
    sections = [main, *(section.only_ours() for section in others)]
    tables = [_table(section, report, index) for index, section in enumerate(sections, 1)]
    return "\n".join(head) + "\n" + "\n".join(tables)


def escape(text: str) -> str:
    r"""Plain text as LaTeX.

    Example:
        >>> print(escape("95 % of i2i_sparse"))
        95 \% of i2i\_sparse
    """
    return "".join(_ESCAPES.get(sign, sign) for sign in text)


def _table(section: Section, report: Report, index: int) -> str:
    count = len(section.columns) + report.with_parameters
    names = [column.name for column in section.columns]
    names += ["parameters"] if report.with_parameters else []
    caption = f"{report.title}. {legend(report)} {section.title or 'Nothing of ours yet'}."
    lines = [
        r"\begin{table}",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{escape(caption)}}}",
        rf"\label{{tab:i2i-report-{report.number}-{index}}}",
        rf"\begin{{tabular}}{{lll{'r' * count}}}",
        r"\toprule",
        _line(["input", "method", "", *names]),
    ]
    seen = None
    for row in section.rows:
        if row.input != seen:
            lines.append(r"\midrule")
        lines += _lines(row, section, report, first=row.input != seen)
        seen = row.input
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]) + "\n"


def _lines(row: Row, section: Section, report: Report, *, first: bool) -> list[str]:
    """The paper's line, ours, and the intervals of ours where there are any."""
    columns, more = section.columns, report.with_parameters
    printed = [paper_text(column, row) for column in columns]
    ours = [value_text(column, row.ours.get(column.key)) for column in columns]
    intervals = [_interval(column, row) for column in columns]
    lines = [
        _line([row.input if first else "", row.name, "paper", *printed]
              + ([paper_parameters_text(row)] if more else [])),
        _line(["", "", "ours", *ours] + ([parameters_text(row)] if more else [])),
    ]  # fmt: skip
    if any(intervals):
        lines.append(_line(["", "", "95 %", *intervals] + ([""] if more else [])))
    return lines


def _interval(column: Column, row: Row) -> str:
    return interval_text(column, row.ours.get(column.key))


def _line(cells: list[str]) -> str:
    return " & ".join(map(escape, cells)) + r" \\"
