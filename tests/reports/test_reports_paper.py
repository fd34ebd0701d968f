"""The published numbers that are shipped."""

import pytest

from i2i.errors import ConfigurationError
from i2i.reports.paper import load_paper, parse_paper


def test_every_table_has_a_number_for_each_column_and_a_name_for_each_row():
    paper = load_paper()
    assert list(paper.tables) == [1, 2, 3, 4, 5, 6, 7]
    for table in paper.tables.values():
        for row in table.rows:
            assert len(row.values) == len(table.columns)
            assert row.key in paper.names


def test_means_are_computed_where_a_row_is_whole():
    rows = {row.key: row for row in load_paper().table(1).rows}
    assert rows["i2i"].mean == pytest.approx(12.57)
    assert rows["cnn_gs"].mean == pytest.approx(43.32)
    assert rows["epn"].mean is None
    assert rows["i2i"].parameters == 10.9
    assert rows["e2cnn_eq"].parameters is None


def test_sizes_are_those_of_pose_networks():
    assert all(row.parameters is None for row in load_paper().table(3).rows)


def test_unknown_tables_are_refused():
    with pytest.raises(ConfigurationError, match="1, 2, 3, 4, 5, 6, 7"):
        load_paper().table(9)


def test_rows_of_another_length_are_refused():
    text = "methods: {}\ntables: {1: {title: t, task: pose, columns_are: object, columns: [a, b], "
    with pytest.raises(ValueError, match="1 numbers for 2 columns"):
        parse_paper(text + "rows: {gray: {m: [1.0]}}}}")
    with pytest.raises(ValueError, match="columns_are"):
        parse_paper(text.replace("object", "colour") + "rows: {}}}")
