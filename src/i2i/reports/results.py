"""Finished jobs as reports see them: read from folders, told apart by what was set."""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from i2i.runs.identity import changes

# Not part of a setting: told apart by the table's rows and columns, or pooled.
_NEVER_SETTINGS = ("seed", "data.object", "data.modality")
_IN_TITLE = ("trainer.max_steps=", "trainer.precision=")  # said there already
_SHARED_PARTS = ("encoder", "projector", "group_conv", "target", "group_frame")
_PLAIN_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
_NOT_WORDS = ("true", "false", "null", "nan", "inf")
_AXES = {
    "views": ("data.views_per_instance",),
    "shift": ("data.shift_px", "data.test_shift_px", "data.depth_shift", "data.test_depth_shift"),
}


@dataclass(frozen=True)
class Result:
    """One finished job.

    Attributes:
        content: Its JSON.
        path: Where that was read.
    """

    content: dict[str, Any]
    path: Path

    @property
    def job(self) -> dict[str, Any]:
        """The choices that tell jobs apart."""
        job: dict[str, Any] = self.content["job"]
        return job

    @property
    def seed(self) -> int:
        """Of the weights."""
        return int(self.job["seed"])

    @cached_property
    def changes(self) -> dict[str, Any] | None:
        """What differs from the plain composition of model, task, data and scale; None: unknown."""
        identity = self.content.get("identity")
        if identity is None:
            return None
        names = {name: self.job[name] for name in ("model", "task", "data", "scale")}
        return changes(identity, **names)

    @property
    def metrics(self) -> dict[str, float]:
        """Metrics of the test by name."""
        metrics: dict[str, float] = self.content["metrics"]
        return metrics

    @cached_property
    def class_of(self) -> list[str]:
        """The class of each test instance."""
        return [
            name.split("/", 1)[0] if "/" in name else str(self.job.get("object"))
            for name in self.content["instance_names"]
        ]

    @property
    def classes(self) -> list[str]:
        """The classes among the test instances, each once."""
        return list(dict.fromkeys(self.class_of))

    def only(self, class_name: str) -> dict[str, Any]:
        """Seed, instance names and errors of one class, as `i2i.runs.results` pools them."""
        kept = [i for i, name in enumerate(self.class_of) if name == class_name]
        return {
            "job": {"seed": self.seed},
            "instance_names": [self.content["instance_names"][i] for i in kept],
            "errors_deg": [self.content["errors_deg"][i] for i in kept],
        }


@dataclass(frozen=True, order=True)
class Setting:
    """What all jobs of one section share.

    Attributes:
        data: Name of the source.
        scale: Name of the scale.
        precision: Of the arithmetic.
        object: JSON of `data.object` where it is no axis: the classes of one network, else "".
        changes: Other settings that are not the plain ones, as (dotted key, JSON value).
    """

    data: str
    scale: str
    precision: str
    object: str
    changes: tuple[tuple[str, str], ...]

    def title(self, steps: Iterable[int]) -> str:
        """For a heading: what was set, in the words of the command line.

        Args:
            steps: Optimiser steps of the jobs.
        """
        count = sorted(set(steps))
        trained = f"{count[0]}" if len(count) < 2 else f"{count[0]}–{count[-1]}"
        parts = [f"data={self.data}", f"scale={self.scale}", f"{trained} steps"]
        if self.object:
            parts.append(f"data.object={hydra_value(json.loads(self.object))}")
        parts.append(self.precision)
        shown = (word for word in self._changed() if not word.startswith(_IN_TITLE))
        return ", ".join([*parts, *shown])

    def words(self) -> list[str]:
        """The words of a command line that choose this setting, without `data.object`."""
        return [f"scale={self.scale}", f"data={self.data}", *self._changed()]

    def _changed(self) -> list[str]:
        found = []
        for key, value in self.changes:
            # null: a part that the plain job has and this one does not; nothing to type.
            if value != "null":
                found.append(f"{key}={hydra_value(json.loads(value))}")
        return list(dict.fromkeys(found))


@dataclass(frozen=True)
class Filters:
    """Which results to look at; None or empty: all."""

    data: str | None = None
    scale: str | None = None
    steps: int | None = None
    seeds: tuple[int, ...] = ()

    def keep(self, result: Result) -> bool:
        """Whether a result is one of those asked for."""
        job = result.job
        return (
            self.data in (None, job.get("data"))
            and self.scale in (None, job.get("scale"))
            and self.steps in (None, result.content.get("steps"))
            and (not self.seeds or result.seed in self.seeds)
        )

    def words(self) -> list[str]:
        """The same choice as words for the train door."""
        words = [f"scale={self.scale}"] if self.scale else []
        words += [f"data={self.data}"] if self.data else []
        words += [f"trainer.max_steps={self.steps}"] if self.steps is not None else []
        return words + ([f"seed={','.join(map(str, self.seeds))}"] if self.seeds else [])


def read_results(
    results: Sequence[str | Path], runs: str | Path | None
) -> tuple[list[Result], list[str]]:
    """Every finished job below the folders; a job that lies there twice counts once.

    Args:
        results: Folders of published results, any `*.json` below them.
        runs: Folder of run folders, any `result.json` below it.

    Returns:
        The results in the order of their paths, and a line for each file that could not be read.
    """
    paths = [path for folder in results for path in sorted(Path(folder).glob("*.json"))]
    if runs is not None:
        paths += sorted(Path(runs).rglob("result.json"))
    best: dict[str, Result] = {}
    problems = []
    for path in dict.fromkeys(paths):
        try:
            content = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            problems.append(f"{path} could not be read: {error}")
            continue
        if not _is_result(content):
            continue
        known = best.get(content["config_hash"])
        if known is None or known.content["format"] < content["format"]:
            best[content["config_hash"]] = Result(content, path)
    return list(best.values()), problems


def setting_of(result: Result, columns_are: str) -> Setting:
    """The setting of a result in a table whose columns are of the given kind."""
    job, changes = result.job, result.changes or {}
    left_out = {*_NEVER_SETTINGS, *_AXES.get(columns_are, ())}
    # These two follow others unless they were set on their own.
    if changes.get("data.sampler_seed") == result.seed:
        left_out.add("data.sampler_seed")
    if changes.get("task.scheduler.total_steps") == changes.get("trainer.max_steps"):
        left_out.add("task.scheduler.total_steps")
    one_network_a_class = columns_are in ("object", "views") and isinstance(job["object"], str)
    one_network_a_class &= len(result.classes) == 1
    return Setting(
        str(job["data"]),
        str(job["scale"]),
        str(job.get("precision")),
        "" if one_network_a_class else json.dumps(job["object"]),
        tuple(
            sorted(
                (_typed_key(key, job["task"]), json.dumps(value))
                for key, value in changes.items()
                if key not in left_out
            )
        ),
    )


def hydra_value(value: object) -> str:
    """A plain value as it is typed on the command line.

    Example:
        >>> hydra_value([1, "a b", None, {"k": True}])
        '[1,"a b",null,{k:true}]'
    """
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}:{hydra_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(hydra_value, value)) + "]"
    if not isinstance(value, str):
        return json.dumps(value)
    if _PLAIN_WORD.fullmatch(value) and value.lower() not in _NOT_WORDS:
        return value
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def one_a_seed(results: Iterable[Result]) -> tuple[list[Result], list[Result]]:
    """The results, one a seed: of several the newest format, then the longest training.

    Returns:
        The chosen ones in the order of their seeds, and the others.
    """
    ranked = sorted(
        results,
        key=lambda r: (r.content["format"], r.content.get("steps", 0), r.content["config_hash"]),
        reverse=True,
    )
    chosen: dict[int, Result] = {}
    for result in ranked:
        chosen.setdefault(result.seed, result)
    kept = [chosen[seed] for seed in sorted(chosen)]
    return kept, [result for result in ranked if result not in kept]


def _typed_key(key: str, task: str) -> str:
    """The key of a change as it is typed: a job's identity holds one network, resolved."""
    if not key.startswith("model.network."):
        return key
    inside = key.removeprefix("model.network.")
    if inside == "projector.projector_axes":
        return "model.projector_axes"
    shared = inside.split(".")[0] in _SHARED_PARTS
    return f"model.{inside}" if shared else f"model.networks.{task}.{inside}"


def _is_result(content: object) -> bool:
    needed = ("format", "job", "config_hash", "metrics", "instance_names")
    return isinstance(content, dict) and all(key in content for key in needed)
