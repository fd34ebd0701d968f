"""Parameter counts without training."""

from i2i.reports import capacity
from i2i.reports.capacity import capacity_report, count_parameters
from i2i.reports.csv_text import csv_text
from i2i.reports.markdown import markdown
from i2i.reports.paper import load_paper


def test_the_papers_network_has_its_parameters():
    assert count_parameters("i2i", "pose") == 10_861_283
    assert count_parameters("cnn_gs", "pose") == 11_176_006
    assert count_parameters("cnn_gs", "classification") is None


def test_all_models_stand_below_the_papers(monkeypatch):
    monkeypatch.setattr(capacity, "model_names", lambda: ["cnn_gs", "i2i", "new", "odd"])

    def count(model, task, *, scale):
        if model == "odd":
            raise ValueError("does not fit\nat all")
        return {"cnn_gs": 11, "i2i": 12, "new": 13}[model] if task == "pose" else None

    monkeypatch.setattr(capacity, "count_parameters", count)
    report = capacity_report(5, load_paper())
    rows = {row.key: row for row in report.sections[0].rows}
    assert list(rows) == [
        "cnn_gs", "cnn_procrustes", "cnn_s3exp", "cnn_ier", "i2i", "new", "odd",
    ]  # fmt: skip
    assert rows["i2i"].ours["pose"].value == 12
    assert rows["i2i"].paper == {"pose": 10.9}
    assert not rows["cnn_ier"].ours  # not among the models: the paper's number alone
    assert not rows["new"].paper
    assert report.sections[0].notes[0] == "odd, pose: could not be built: does not fit"
    assert "| CNN+GS | paper | 11.2 M |" in markdown(report)
    assert "11200000.0,11.0" in csv_text(report)
