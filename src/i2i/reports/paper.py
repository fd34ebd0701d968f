"""The published numbers, read from this package's `paper.yaml`."""

from dataclasses import dataclass
from importlib import resources
from typing import Any

import yaml

from i2i.errors import ConfigurationError

COLUMNS_ARE = ("object", "metric", "views", "parameters", "shift")


@dataclass(frozen=True)
class PaperRow:
    """A printed row.

    Attributes:
        input: What the method sees: a modality.
        key: The method, or the kind of shift in the table of shifts.
        values: Published numbers, one a column; None where there is none.
        parameters: Published millions of parameters of the method, None where there are none.
    """

    input: str
    key: str
    values: tuple[float | None, ...]
    parameters: float | None = None

    @property
    def mean(self) -> float | None:
        """Mean over the columns; None unless the paper fills all of them."""
        known = [value for value in self.values if value is not None]
        return sum(known) / len(known) if len(known) == len(self.values) else None


@dataclass(frozen=True)
class PaperTable:
    """A printed table.

    Attributes:
        number: As in the paper.
        title: What it shows.
        task: `pose` or `classification`.
        columns_are: What tells its columns apart, one of `COLUMNS_ARE`.
        columns: Names of the columns.
        rows: Its rows.
        digits: Decimals of the numbers beside it.
        remark: What a reader of the numbers should know.
    """

    number: int
    title: str
    task: str
    columns_are: str
    columns: tuple[str, ...]
    rows: tuple[PaperRow, ...]
    digits: int = 1
    remark: str = ""


@dataclass(frozen=True)
class Paper:
    """All tables and the printed names of the methods."""

    tables: dict[int, PaperTable]
    names: dict[str, str]

    def name(self, key: str) -> str:
        """The printed name of a method, or the key itself."""
        return self.names.get(key, key)

    def table(self, number: int) -> PaperTable:
        """A table by its number.

        Raises:
            ConfigurationError: if the paper has no such table.
        """
        if number not in self.tables:
            known = ", ".join(map(str, self.tables))
            raise ConfigurationError(
                f"table={number}: the paper's tables are {known}; type table=1, or table=all"
            )
        return self.tables[number]


def load_paper() -> Paper:
    """The paper's numbers as this package ships them."""
    return parse_paper(resources.files("i2i.reports").joinpath("paper.yaml").read_text("utf-8"))


def parse_paper(text: str) -> Paper:
    """The paper's numbers from YAML.

    Raises:
        ValueError: if a row has not one number a column, or a table's columns are of no known kind.
    """
    content = yaml.safe_load(text)
    sizes = _sizes(content["tables"])
    tables = {
        number: _table(number, printed, sizes) for number, printed in content["tables"].items()
    }
    return Paper(tables, dict(content["methods"]))


def _sizes(tables: dict[int, dict[str, Any]]) -> dict[str, float]:
    """Published millions of parameters by method."""
    found: dict[str, float] = {}
    for printed in tables.values():
        if printed["columns_are"] == "parameters":
            for rows in printed["rows"].values():
                found |= {method: values[0] for method, values in rows.items()}
    return found


def _table(number: int, printed: dict[str, Any], sizes: dict[str, float]) -> PaperTable:
    columns = tuple(map(str, printed["columns"]))
    if printed["columns_are"] not in COLUMNS_ARE:
        raise ValueError(
            f"table {number}: columns_are={printed['columns_are']!r}; allowed: "
            + ", ".join(COLUMNS_ARE)
        )
    rows = []
    for seen, methods in printed["rows"].items():
        for key, values in methods.items():
            if len(values) != len(columns):
                raise ValueError(
                    f"table {number}, {key}: {len(values)} numbers for {len(columns)} columns"
                )
            # The published sizes are those of the pose networks.
            size = sizes.get(key) if printed["task"] == "pose" else None
            rows.append(PaperRow(seen, key, tuple(values), size))
    return PaperTable(
        number,
        printed["title"],
        printed["task"],
        printed["columns_are"],
        columns,
        tuple(rows),
        printed.get("digits", 1),
        " ".join(printed.get("remark", "").split()),
    )
