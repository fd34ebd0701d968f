"""The report door: files, words of the command line, bad input."""

import pytest
from PIL import Image

from i2i.configuration import compose
from i2i.errors import ConfigurationError
from i2i.report import report

from .conftest import made


def run(*words):
    return report(compose([*words], config_name="report"))


def test_it_writes_every_file(keep, tmp_path):
    folder = keep(made(), made("cnn_gs"), made(modality="rgb"))
    made_of = run(
        "table=1", f"results=[{folder}]", "runs=null", f"output={tmp_path / 'out'}", "seeds=0"
    )
    assert list(made_of) == [1]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "table1.md", "table1.tex", "table1.csv", "table1_bars.png", "table1_bars.svg",
        "table1_recall.png", "table1_recall.svg",
    }  # fmt: skip
    assert Image.open(tmp_path / "out" / "table1_bars.png").width > 300
    assert "<svg" in (tmp_path / "out" / "table1_recall.svg").read_text()


def test_words_choose_among_the_results(keep, tmp_path, monkeypatch):
    monkeypatch.setattr("i2i.report.report_figures", lambda _: {})
    folder = keep(made(), made(data="sweethome", steps=5), made(data="modelnet40", scale="paper"))
    common = ["table=1", f"results={folder}", "runs=null", f"output={tmp_path}"]

    def titles(*words):
        return [section.title for section in run(*common, *words)[1].sections]

    assert len(titles()) == 3
    assert titles("data=sweethome") == ["data=sweethome, scale=small, 5 steps, 32-true"]
    assert titles("steps=5", "scale=small") == ["data=sweethome, scale=small, 5 steps, 32-true"]
    assert titles("data=modelnet40") == ["data=modelnet40, scale=paper, 600 steps, 32-true"]
    assert titles("data=synthetic", "scale=paper") == [""]


@pytest.mark.parametrize("table", ["0", "9", "first"])
def test_unknown_tables_are_refused(table, tmp_path):
    with pytest.raises(ConfigurationError, match="table=all"):
        run(f"table={table}", f"output={tmp_path}")


def test_words_that_are_no_numbers_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="whole numbers"):
        run("table=1", "results=[]", "runs=null", "steps=many", f"output={tmp_path}")


def test_no_results_are_no_error(door, tmp_path):
    done = door("report", "table=2", cwd=tmp_path)
    assert "# Table 2" in done.stdout
    assert "python -m i2i.train -m experiment=table2" in done.stdout
    assert sorted(p.name for p in (tmp_path / "reports").iterdir()) == [
        "table2.csv", "table2.md", "table2.tex",
    ]  # fmt: skip
