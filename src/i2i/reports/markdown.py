"""A report as Markdown."""

from collections.abc import Sequence

from i2i.reports.model import Report, Row, Section
from i2i.reports.numbers import (
    instances_text,
    interval_text,
    legend,
    paper_parameters_text,
    paper_text,
    parameters_text,
    seeds_text,
    value_text,
)

_SHOWN_MISSING = 12


def markdown(report: Report) -> str:
    """The whole report, ending with a line break."""
    blocks = [f"# Table {report.number}: {report.title}", legend(report)]
    blocks += [f"- {note}" for note in report.notes]
    main, *others = report.sections
    blocks += _section(main, report, shown_missing=_SHOWN_MISSING)
    for section in others:
        blocks += _section(section.only_ours(), report, shown_missing=0)
    return "\n\n".join(blocks) + "\n"


def _section(section: Section, report: Report, *, shown_missing: int) -> list[str]:
    jobs = (
        f" ({section.jobs} result{'s' if section.jobs > 1 else ''})"
        if report.with_parameters
        else ""
    )
    heading = f"{section.title}{jobs}" if section.title else "Nothing of ours yet"
    blocks = [f"## {heading}", _table(section, report)]
    blocks += [f"- {note}" for note in section.notes]
    if section.comparisons:
        blocks += [f"### {section.comparisons[0].reference} against the others", _compared(section)]
    if section.missing:
        count = len(section.missing)
        blocks += [f"### Missing: {count} job{'s' if count > 1 else ''}"]
        blocks += _missing(section, shown_missing)
    return blocks


def _table(section: Section, report: Report) -> str:
    tail = ["parameters", "seeds", "test instances"] if report.with_parameters else []
    names = [column.name for column in section.columns]
    lines = []
    for row in section.rows:
        first = [row.input, row.name, "paper", *(paper_text(c, row) for c in section.columns)]
        second = ["", "", "ours", *(_ours(row, section))]
        if tail:
            first += [paper_parameters_text(row), "", ""]
            second += [parameters_text(row), seeds_text(row), instances_text(row)]
        lines += [first, second]
    return grid(["input", "method", "", *names, *tail], lines, left=3)


def _ours(row: Row, section: Section) -> list[str]:
    return [
        f"{value_text(c, row.ours.get(c.key))} {interval_text(c, row.ours.get(c.key))}".strip()
        for c in section.columns
    ]


def _compared(section: Section) -> str:
    lines = []
    for made in section.comparisons:
        digits, gain = made.column.digits, made.gain
        lines.append([
            made.input,
            made.column.name,
            made.other,
            f"{gain.value:.{digits}f} [{gain.low:.{digits}f}, {gain.high:.{digits}f}]",
            str(made.seeds),
            "touch" if made.touch else "apart",
            made.verdict,
        ])  # fmt: skip
    unit = section.comparisons[0].column.unit
    head = ["input", "column", "against", f"better by ({unit})", "seeds", "intervals", "verdict"]
    return grid(head, lines, left=3)


def _missing(section: Section, count: int) -> list[str]:
    shown = [f"- {line}" for line in section.missing[:count]]
    if shown and len(section.missing) > count:
        shown.append(f"- … and {len(section.missing) - count} more")
    blocks = ["\n".join(shown)] if shown else []
    if section.command:
        blocks += [
            "This trains them; what is done already is skipped:",
            f"```\n{section.command}\n```",
        ]
    return blocks


def grid(head: Sequence[str], lines: Sequence[Sequence[str]], *, left: int) -> str:
    """A Markdown table whose first columns are flush left and the others flush right."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") or " " for cell in cells) + " |"

    rule = "|" + "---|" * left + "--:|" * (len(head) - left)
    return "\n".join([line(head), rule, *map(line, lines)])
