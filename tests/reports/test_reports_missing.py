"""Which jobs are missing, and the command that fills them in."""

import pytest

from i2i.errors import ConfigurationError
from i2i.reports import missing
from i2i.reports.missing import missing_at, missing_everywhere
from i2i.reports.results import Filters, setting_of
from i2i.runs.sweeps import expand, load_experiment

from .conftest import made

GRIDS = [
    {
        "seed": [0, 1, 2],
        "task": "pose",
        "data": "modelnet40",
        "data.modality": "gray",
        "data.object": ["desk", "chair"],
        "model": ["cnn_gs", "i2i"],
    }
]


@pytest.fixture
def grids(monkeypatch):
    monkeypatch.setattr(missing, "load_experiment", lambda name: GRIDS)


@pytest.mark.usefixtures("grids")
def test_what_lacks_is_named_for_the_classes_and_seeds_that_are_there(read):
    members = read(made(), made(seed=1), made("cnn_gs"))
    setting = setting_of(members[0], "object")
    lines, command = missing_at(1, setting, members, "object")
    assert lines == ("model=cnn_gs seed=1",)
    assert command == (
        "python -m i2i.train -m experiment=table1 scale=small data=synthetic "
        "trainer.max_steps=600 data.object=chair seed=0,1"
    )
    assert missing_at(1, setting, [*members, *read(made("cnn_gs", seed=1))], "object") == ((), "")


@pytest.mark.usefixtures("grids")
def test_the_commands_words_make_the_jobs_that_are_there(read):
    """The command is the sweep's own language: its jobs hold those that are done."""
    members = read(made("cnn_gs"), made(obj="sofa", seed=2))
    _, command = missing_at(1, setting_of(members[0], "object"), members, "object")
    jobs = expand(GRIDS, command.split()[5:])
    assert len(jobs) == 2 * 2 * 2
    for result in members:
        choices = {"model": result.job["model"], "data.object": result.job["object"],
                   "seed": result.seed, "data": "synthetic", "scale": "small",
                   "trainer.max_steps": 600}  # fmt: skip
        assert any(choices.items() <= job.choices.items() for job in jobs)


@pytest.mark.usefixtures("grids")
def test_without_results_everything_is_missing():
    lines, command = missing_everywhere(1, Filters(scale="small", seeds=(0,)))
    assert len(lines) == 4
    assert command == "python -m i2i.train -m experiment=table1 scale=small seed=0"


def test_an_experiment_that_is_not_there_is_told(monkeypatch):
    def refuse(name):
        raise ConfigurationError(f"experiment={name} is no sweep")

    monkeypatch.setattr(missing, "load_experiment", refuse)
    assert missing_everywhere(1, Filters()) == (
        ("(the jobs are not known: experiment=table1 is no sweep)",),
        "",
    )


@pytest.mark.parametrize("number", [1, 2, 3, 4, 6, 7])
def test_the_shipped_experiments_hold_the_rows_of_their_tables(number):
    """Every method of the paper's table that sees one image is in the sweep."""
    from i2i.reports.paper import load_paper

    models = {job.choices["model"] for job in expand(load_experiment(f"table{number}"))}
    if number == 6:  # what the paper does not have is a sweep of its own
        models |= {job.choices["model"] for job in expand(load_experiment("beyond"))}
    images = {"gray", "rgb", "depth"}
    rows = {r.key for r in load_paper().table(number).rows if r.input in images}
    assert models >= ({"i2i"} if number == 7 else rows)
