"""Sweeps as plain data: unions of grids, tied settings, what is typed, and the tables."""

import itertools

import pytest

from i2i.configuration import compose, modalities, plain
from i2i.errors import ConfigurationError
from i2i.runs.building import check_fit
from i2i.runs.identity import config_hash
from i2i.runs.sweeps import Job, command, expand, load_experiment

TABLES = {  # jobs of one seed, counted in the paper's tables, with second readings in 1, 4 and 6
    "table1": 6 * 10 + 3 * 5, "table2": 6 * 8, "table3": 3 * 2 + 2 + 3, "table4": 4 * 2 * 10,
    "table6": 6 * 2 * 10, "table7": 6 + 6,
}  # fmt: skip


def choices(jobs):
    return [job.choices for job in jobs]


def test_a_sweep_is_the_union_of_its_grids_without_repetitions():
    grids = [{"model": ["i2i", "cnn_gs"], "seed": [0, 1]}, {"model": "i2i", "seed": [1, 2]}]
    assert choices(expand(grids)) == [
        {"model": model, "seed": seed}
        for model, seed in [("i2i", 0), ("i2i", 1), ("cnn_gs", 0), ("cnn_gs", 1), ("i2i", 2)]
    ]


def test_tied_settings_get_the_same_value():
    jobs = expand([{"data.shift_px,data.test_shift_px": [5, 10], "seed": 0}])
    assert [job.overrides for job in jobs] == [
        ("data.shift_px=5", "data.test_shift_px=5", "seed=0"),
        ("data.shift_px=10", "data.test_shift_px=10", "seed=0"),
    ]


def test_what_is_typed_replaces_the_grids_values_and_goes_to_every_job():
    grids = [{"model": ["i2i", "cnn_gs"], "seed": [0, 1, 2]}]
    jobs = expand(grids, ["seed=7,8", "scale=small", "label='two words'"])
    expected = itertools.product(["i2i", "cnn_gs"], [7, 8])
    assert choices(jobs) == [
        {"model": model, "seed": seed, "scale": "small", "label": "two words"}
        for model, seed in expected
    ]


def test_typing_one_tied_setting_sets_all_of_them_and_typing_all_unties_them():
    tied = [{"a,b": [1, 2]}]
    assert choices(expand(tied, ["a=5,6"])) == [{"a": 5, "b": 5}, {"a": 6, "b": 6}]
    assert choices(expand(tied, ["a=5", "b=6,7"])) == [{"a": 5, "b": 6}, {"a": 5, "b": 7}]


def test_a_setting_that_only_some_grids_give_is_replaced_only_there():
    words = ["data.shift_px=5,30", "data.depth_shift=5", "seed=0"]
    shifts = [
        tuple(job.choices.get(f"data.{key}") for key in
              ("shift_px", "test_shift_px", "depth_shift", "test_depth_shift"))
        for job in expand(load_experiment("table7"), words)
    ]  # fmt: skip
    assert shifts == [(5, 5, None, None), (30, 30, None, None), (None, None, 5, 5)]


def test_without_grids_every_combination_of_what_is_typed_is_a_job():
    jobs = expand([], ["seed=range(0,2)", "data.object=chair,car", "+trainer.x=1", "~logger"])
    assert len(jobs) == 4
    assert jobs[0].overrides == ("seed=0", "data.object=chair", "+trainer.x=1", "~logger")
    assert expand([]) == [Job((), {})]


@pytest.mark.parametrize("value", [None, True, 3, 0.5, "chair", "two words", "it's", ["a", "b"]])
def test_values_of_a_file_reach_hydra_as_they_are(value):
    job = expand([{"label": [value]}])[0]
    assert plain(compose(job.overrides))["label"] == value


def test_intervals_are_refused():
    with pytest.raises(ConfigurationError, match="seed=1,2,3"):
        expand([], ["seed=interval(0,1)"])


@pytest.mark.parametrize("table", sorted(TABLES))
def test_a_table_has_the_papers_jobs_at_the_papers_scale(table):
    jobs = expand(load_experiment(table), ["seed=0"])
    assert len(jobs) == TABLES[table]
    assert len(expand(load_experiment(table))) == 3 * len(jobs)
    cfg = compose([*jobs[0].overrides, f"experiment={table}"])
    check_fit(cfg)
    config = plain(cfg)
    assert config["scale"]["name"] == "paper"
    assert config["paths"]["results_dir"] == "results"
    # The command of a missing job, typed alone, makes the same job.
    assert config_hash(config) == config_hash(plain(compose(jobs[0].overrides)))


def test_every_model_of_the_tables_sees_its_images_and_does_its_task():
    jobs = [job.choices for table in TABLES for job in expand(load_experiment(table), ["seed=0"])]
    wanted = {(job["model"], job["task"], job["data.modality"]) for job in jobs}
    models = {name: compose([f"model={name}"]).model for name, _, _ in wanted}
    for name, task, modality in wanted:
        assert modality in modalities(models[name].modalities, task), name
        assert models[name].networks[task], name


def test_a_value_that_some_grids_list_goes_to_these_alone():
    grids = [{"input": "gray", "model": ["i2i", "cnn"]}, {"input": "points", "model": ["epn"]}]
    assert choices(expand(grids, ["model=cnn,epn"])) == [
        {"input": "gray", "model": "cnn"},
        {"input": "points", "model": "epn"},
    ]
    assert choices(expand(grids, ["input=points"])) == [{"input": "points", "model": "epn"}]
    # What no grid lists goes to all of them.
    assert len(expand(grids, ["model=theirs"])) == 2
    assert len(expand(grids, ["input=rgb"])) == 3


def test_the_scale_that_is_typed_counts_for_the_papers_sources_too():
    job = expand(load_experiment("table1"), ["scale=small", "seed=0"])[0]
    assert plain(compose(job.overrides))["scale"]["name"] == "small"


def test_commands_can_be_pasted_into_a_shell():
    job = expand([{"model": "i2i", "data.object": [["chair", "car"]]}])[0]
    assert command(job) == "python -m i2i.train model=i2i 'data.object=[chair,car]'"
    assert command(["seed=0,1"], experiment="table1") == (
        "python -m i2i.train -m experiment=table1 seed=0,1"
    )


def test_an_experiment_that_is_no_sweep_is_refused_with_those_that_are():
    with pytest.raises(ConfigurationError, match="table1, table2"):
        load_experiment("demo")
