"""Which jobs of a table are not there, and what to type to have them."""

import json
from collections.abc import Sequence
from typing import Any

from i2i.errors import ConfigurationError
from i2i.reports.results import Filters, Result, Setting, hydra_value, setting_of
from i2i.runs.sweeps import Job, command, expand, load_experiment

# What a job's choice is called in a result.
_FIELDS = {
    "model": "model",
    "seed": "seed",
    "data.object": "object",
    "data.modality": "modality",
    "data.views_per_instance": "views_per_instance",
    "data.shift_px": "shift_px",
    "data.test_shift_px": "test_shift_px",
    "data.depth_shift": "depth_shift",
    "data.test_depth_shift": "test_depth_shift",
}


def missing_at(
    number: int, setting: Setting, members: Sequence[Result], columns_are: str
) -> tuple[tuple[str, ...], str]:
    """What a setting lacks, for the classes and seeds that it has results of.

    Args:
        number: Of the table.
        setting: The setting.
        members: All results at it.
        columns_are: Kind of the table's columns.

    Returns:
        A line a job, and the command; both empty where nothing lacks.
    """
    seeds = ",".join(map(str, sorted({result.seed for result in members})))
    words = [*setting.words(), f"data.object={_objects(setting, members)}", f"seed={seeds}"]
    there = [r for r in members if setting_of(r, columns_are) == setting]
    return _missing(number, words, there)


def missing_everywhere(number: int, filters: Filters) -> tuple[tuple[str, ...], str]:
    """All jobs of a table, for when there is nothing yet."""
    return _missing(number, filters.words(), [])


def _missing(
    number: int, words: Sequence[str], there: Sequence[Result]
) -> tuple[tuple[str, ...], str]:
    try:
        jobs = expand(load_experiment(f"table{number}"), words)
    except ConfigurationError as error:
        return (f"(the jobs are not known: {error})",), ""
    lacking = [job for job in jobs if not any(_same(job, result) for result in there)]
    if not lacking:
        return (), ""
    varied = _varied(jobs)
    lines = tuple(dict.fromkeys(_line(job, varied) for job in lacking))
    return lines, command(words, experiment=f"table{number}")


def _objects(setting: Setting, members: Sequence[Result]) -> str:
    """The value of data.object that gives these jobs."""
    if setting.object:
        return hydra_value(json.loads(setting.object))
    return ",".join(sorted({name for result in members for name in result.classes}))


def _same(job: Job, result: Result) -> bool:
    """Whether a result is that of a job, in everything that tells the jobs of a table apart.

    What is typed for all jobs is the setting's already.
    """
    return all(
        _plain(result.job.get(field)) == _plain(job.choices[key])
        for key, field in _FIELDS.items()
        if key in job.choices
    )


def _plain(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    return list(value) if isinstance(value, list | tuple) else value


def _varied(jobs: Sequence[Job]) -> list[str]:
    """Keys of which the jobs have several values, and the model always."""
    keys = dict.fromkeys(key for job in jobs for key in job.choices)
    return ["model"] + [
        key
        for key in keys
        if key != "model" and len({json.dumps(job.choices.get(key)) for job in jobs}) > 1
    ]


def _line(job: Job, varied: Sequence[str]) -> str:
    return " ".join(f"{k}={hydra_value(job.choices[k])}" for k in varied if k in job.choices)
