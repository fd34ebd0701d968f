"""A report as plain data: what the statistics fill in and the writers write out."""

from dataclasses import dataclass, field, replace

import numpy as np

from i2i.metrics.bootstrap import Interval

MEAN = "mean"
"""Key of the column of means over classes."""


@dataclass(frozen=True)
class Column:
    """A column of numbers.

    Attributes:
        key: A class, a metric, a number of views, an amount of shift, or `mean`.
        name: Heading.
        paper: Whether the paper has this column.
        unit: Of the numbers, for axes and headings.
        factor: Our metric times this is what is printed (100 for percent).
        digits: Decimals.
    """

    key: str
    name: str
    paper: bool = True
    unit: str = "°"
    factor: float = 1.0
    digits: int = 1


@dataclass(frozen=True)
class Cell:
    """One of our numbers; never one of the paper's.

    Attributes:
        value: Mean over seeds (and over classes, where there are several), in the column's unit.
        spread: Standard deviation over seeds; None with fewer than two.
        low: Lower end of the 95 % interval over resampled instances, seeds pooled; None: unknown.
        high: Its upper end.
        seeds: Which seeds.
        instances: Number of test instances.
        classes: Over which classes.
    """

    value: float
    spread: float | None = None
    low: float | None = None
    high: float | None = None
    seeds: tuple[int, ...] = ()
    instances: int = 0
    classes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    """A method: what the paper prints and what we got.

    Attributes:
        input: Modality.
        key: The method.
        name: Its printed name.
        paper: Published numbers by column key.
        ours: Our numbers by column key; absent: not there.
        paper_parameters: Published millions of trainable parameters.
        parameters: Trainable parameters of our networks, each count once, ascending.
        errors: Our errors in degrees of all views and seeds, by column key.
    """

    input: str
    key: str
    name: str
    paper: dict[str, float]
    ours: dict[str, Cell]
    paper_parameters: float | None = None
    parameters: tuple[int, ...] = ()
    errors: dict[str, np.ndarray] = field(default_factory=dict, compare=False, repr=False)


@dataclass(frozen=True)
class Comparison:
    """The reference method against another on the same test images.

    Attributes:
        input: Modality.
        column: The column.
        reference: Printed name of the reference method.
        other: Printed name of the other.
        touch: Whether their two intervals touch.
        gain: By how much the reference is better, resampled in pairs, in the column's unit.
        seeds: Number of seeds that both have.
    """

    input: str
    column: Column
    reference: str
    other: str
    touch: bool
    gain: Interval
    seeds: int

    @property
    def verdict(self) -> str:
        """Which is ahead; undecided where the interval holds 0."""
        if self.gain.low <= 0 <= self.gain.high:
            return "undecided"
        return f"{self.reference if self.gain.low > 0 else self.other} ahead"


@dataclass(frozen=True)
class Section:
    """The table at one setting.

    Attributes:
        title: The setting; empty where there is nothing of ours.
        columns: Of numbers.
        rows: Methods.
        comparisons: Of the reference method with others.
        missing: A line for each job that is not there.
        command: What to type to fill those in; empty if nothing is missing.
        notes: What a reader should know.
        jobs: Number of results in it.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    comparisons: tuple[Comparison, ...] = ()
    missing: tuple[str, ...] = ()
    command: str = ""
    notes: tuple[str, ...] = ()
    jobs: int = 0

    def only_ours(self) -> "Section":
        """The same without the methods and columns that have nothing of ours."""
        rows = tuple(row for row in self.rows if row.ours)
        columns = tuple(c for c in self.columns if any(c.key in row.ours for row in rows))
        return replace(self, rows=rows, columns=columns)


@dataclass(frozen=True)
class Report:
    """One of the paper's tables with ours beside it.

    Attributes:
        number: Of the table.
        title: What it shows.
        sections: One a setting, that with the most jobs first; one without a title if none.
        notes: On the results as a whole.
        with_parameters: Whether methods have a column of parameter counts.
    """

    number: int
    title: str
    sections: tuple[Section, ...]
    notes: tuple[str, ...] = ()
    with_parameters: bool = True
