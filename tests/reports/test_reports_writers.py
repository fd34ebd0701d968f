"""Markdown, LaTeX and CSV of a report hold its numbers."""

import csv
import io
import re

import pytest

from i2i.reports.build import build_report
from i2i.reports.csv_text import FIELDS, csv_text
from i2i.reports.figures import report_figures
from i2i.reports.latex import escape, latex
from i2i.reports.markdown import markdown
from i2i.reports.paper import load_paper

from .conftest import made


@pytest.fixture
def report(read):
    jobs = [made(m, obj=o, seed=s) for m in ("i2i", "cnn_gs") for o in ("chair", "file_cabinet")
            for s in (0, 1)]  # fmt: skip
    return build_report(1, read(*jobs, made(views=15)), load_paper())


def rows_of(text):
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("|")
    ]


def test_markdown_has_the_papers_line_above_ours(report):
    rows = rows_of(markdown(report))
    head, width = rows[0], len(rows[0])
    column = head.index("chair")
    names = [r[1] for r in rows[: 2 + 2 * 9]]
    place = names.index("I2I")
    assert rows[place][2:4] == ["paper", "63.1"]
    assert rows[place][head.index("mean")] == "12.6"
    ours = rows[place + 1]
    cell = next(r for r in report.sections[0].rows if r.key == "i2i").ours["chair"]
    assert ours[2] == "ours"
    assert ours[column] == (
        f"{cell.value:.1f} ± {cell.spread:.1f} [{cell.low:.1f}, {cell.high:.1f}]"
    )
    assert ours[head.index("desk")] == "–"
    assert ours[head.index("parameters") :] == ["730,951", "2", "8"]
    assert all(len(row) == width for row in rows[: 2 + 2 * 9])
    empty = rows[names.index("EPN") + 1]
    assert set(empty[3:]) == {"–"}


def test_markdown_tells_what_to_type_and_who_is_ahead(report):
    text = markdown(report)
    assert "### I2I against the others" in text
    assert "python -m i2i.train -m experiment=table1" in text
    assert "### Missing:" in text


def test_later_sections_show_only_what_we_have(report):
    text = markdown(report).split("\n## ")[2]
    assert "data.views_per_instance=15" in text
    assert rows_of(text)[0][3:5] == ["chair", "mean"]
    assert "CNN+GS" not in rows_of(text)[2]


def test_latex_is_balanced_and_has_as_many_cells_as_columns(report):
    text = latex(report)
    assert text.count(r"\begin{tabular}") == len(report.sections) == 2
    for kind in ("table", "tabular"):
        assert text.count(rf"\begin{{{kind}}}") == text.count(rf"\end{{{kind}}}")
    bare = re.sub(r"\\[{}]", "", text)
    depth = 0
    for sign in bare:
        depth += (sign == "{") - (sign == "}")
        assert depth >= 0
    assert depth == 0
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert body.isascii()
    assert not re.search(r"(?<!\\)[#_]", re.sub(r"\\(label|begin|end)\{[^}]*\}", "", body))
    assert not re.search(r"(?<!\\)%", body)
    assert len(re.findall(r"(?<!\\)\$", body)) % 2 == 0
    for table in body.split(r"\begin{tabular}")[1:]:
        columns = re.match(r"\{([lr]+)\}", table)[1]
        lines = [line for line in table.splitlines() if line.endswith(r"\\")]
        assert lines
        assert all(len(re.findall(r"(?<!\\)&", line)) == len(columns) - 1 for line in lines)
        order = [table.index(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")]
        assert order == sorted(order)


def test_latex_escapes_every_special_sign():
    assert escape(r"a_b & 5 % {x} \ $ # ~ ^") == (
        r"a\_b \& 5 \% \{x\} \textbackslash{} \$ \# \textasciitilde{} \textasciicircum{}"
    )
    assert escape("1 ± 2 – [3]") == r"1 $\pm$ 2 -- {[}3{]}"


def test_csv_gives_back_the_same_numbers(report):
    lines = list(csv.DictReader(io.StringIO(csv_text(report))))
    assert tuple(lines[0]) == FIELDS
    assert len(lines) == sum(len(s.rows) * len(s.columns) for s in report.sections)
    rows = {(s.title, r.key): r for s in report.sections for r in s.rows}
    filled = 0
    for line in lines:
        row = rows[line["setting"], line["method"]]
        cell = row.ours.get(line["column"])
        paper = row.paper.get(line["column"])
        assert line["paper"] == ("" if paper is None else repr(paper))
        if cell is None:
            assert line["ours"] == line["low"] == line["seeds"] == ""
            continue
        filled += 1
        assert float(line["ours"]) == cell.value
        assert (float(line["low"]), float(line["high"])) == (cell.low, cell.high)
        assert line["seeds"].split() == [str(seed) for seed in cell.seeds]
    assert filled == 2 * 3 + 2


def test_figures_show_our_methods_and_mark_the_published_numbers(report):
    figures = report_figures(report)
    bars, recall = figures["bars"], figures["recall"]
    assert [a.get_title() for a in bars.axes] == ["chair", "file_cabinet", "mean"]
    assert [t.get_text() for t in bars.axes[0].get_yticklabels()] == ["CNN+GS", "I2I"]
    widths = [patch.get_width() for patch in bars.axes[0].patches]
    ours = [r.ours["chair"].value for r in report.sections[0].rows if r.ours]
    assert widths == pytest.approx(ours)
    assert [a.get_title() for a in recall.axes] == ["chair", "file_cabinet", "all classes"]
    row = next(r for r in report.sections[0].rows if r.key == "i2i")
    line = next(x for x in recall.axes[0].lines if x.get_label() == "I2I")
    at_ten = line.get_ydata()[line.get_xdata().searchsorted(10.0)]
    assert at_ten == pytest.approx(100 * (row.errors["chair"] <= 10.0).mean())


def test_nothing_of_ours_makes_no_figures():
    empty = build_report(2, [], load_paper())
    assert report_figures(empty) == {}
    assert "Nothing of ours yet" in markdown(empty)
    assert "Nothing of ours yet" in latex(empty)
