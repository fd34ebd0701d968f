"""Numbers as text, the same in every kind of file."""

from i2i.reports.model import MEAN, Cell, Column, Report, Row

NOTHING = "–"


def paper_text(column: Column, row: Row) -> str:
    """The published number as the paper prints it; a mean is rounded as its column."""
    value = row.paper.get(column.key)
    if value is None:
        return NOTHING
    if column.unit == "parameters":
        return f"{value:g} M"
    if column.key == MEAN:
        return f"{value:.{column.digits}f}"
    printed = len(f"{value:g}".partition(".")[2])
    return f"{value:.{max(printed, column.digits)}f}"


def value_text(column: Column, cell: Cell | None) -> str:
    """Our number with its spread over seeds: `7.9 ± 0.3`."""
    if cell is None:
        return NOTHING
    if column.unit == "parameters":
        return f"{cell.value:,.0f}"
    spread = "" if cell.spread is None else f" ± {cell.spread:.{column.digits}f}"
    return f"{cell.value:.{column.digits}f}{spread}"


def interval_text(column: Column, cell: Cell | None) -> str:
    """Its interval: `[7.1, 8.8]`, or nothing."""
    if cell is None or cell.low is None or cell.high is None:
        return ""
    return f"[{cell.low:.{column.digits}f}, {cell.high:.{column.digits}f}]"


def seeds_text(row: Row) -> str:
    """How many seeds our numbers have: `2`, or `1–2` where they differ."""
    return _range([len(cell.seeds) for key, cell in row.ours.items() if key != MEAN])


def instances_text(row: Row) -> str:
    """How many test instances each of our numbers is over."""
    return _range([cell.instances for key, cell in row.ours.items() if key != MEAN])


def parameters_text(row: Row) -> str:
    """Trainable parameters of our networks."""
    return ", ".join(f"{count:,}" for count in row.parameters) or NOTHING


def paper_parameters_text(row: Row) -> str:
    """The published count."""
    return NOTHING if row.paper_parameters is None else f"{row.paper_parameters:g} M"


def legend(report: Report) -> str:
    """What our numbers are, in a sentence or two."""
    unit = report.sections[0].columns[0].unit
    if unit == "parameters":
        return "Trainable parameters; ours are counted on freshly built networks."
    what = "Median rotation error in degrees" if unit == "°" else "Percent of the test samples"
    return (
        f"{what}. Ours: mean over seeds ± their standard deviation where there are several, and "
        "the 95 % interval of the median of all seeds together, over resampled test instances."
        if unit == "°"
        else f"{what}. Ours: mean over seeds ± their standard deviation where there are several, "
        "and for the accuracy the 95 % interval over resampled test instances, seeds together."
    )


def _range(counts: list[int]) -> str:
    if not counts:
        return NOTHING
    low, high = min(counts), max(counts)
    return f"{low}" if low == high else f"{low}–{high}"
