"""Sweeps as plain data: the grids of an experiment, and the jobs that they stand for.

A grid is a dict from a key of the command line to a value or a list of values; its jobs are all
combinations, the first key varying slowest. A key may name several settings, joined by commas: they
are tied, each value goes to all of them. A value that is a list itself is written as a list inside
the list. A sweep is the union of its grids. Nothing is composed here: `expand` needs no models.
"""

import itertools
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from i2i.configuration import config_dir
from i2i.errors import ConfigurationError

_PLAIN_WORD = re.compile(r"[A-Za-z0-9_.:/+-]+")
_Choice = tuple[tuple[str, ...], dict[str, Any]]  # words of the command line, settings by key


@dataclass(frozen=True)
class Job:
    """One job of a sweep.

    Attributes:
        overrides: Words of the command line that make it.
        choices: The same as values by key, such as `{"model": "i2i", "seed": 0}`.
    """

    overrides: tuple[str, ...]
    choices: dict[str, Any] = field(compare=False)


@dataclass(frozen=True)
class _Typed:
    """A word of the command line: its key, and a word and a value for each value of a sweep."""

    name: str
    values: tuple[tuple[str, Any], ...]

    def meant_for(self, grid: Mapping[str, Any], grids: Sequence[Mapping[str, Any]]) -> "_Typed":
        """Without the values that other grids list and this one does not."""
        own, anywhere = _listed(self.name, [grid]), _listed(self.name, grids)
        values = [(w, v) for w, v in self.values if v in own or v not in anywhere]
        return _Typed(self.name, tuple(values))

    def choices(self, followers: Sequence[str] = ()) -> list[_Choice]:
        """One choice a value; tied settings get the same value."""
        return [
            (
                (word, *(f"{name}{word[word.index('=') :]}" for name in followers)),
                dict.fromkeys((self.name, *followers), value),
            )
            for word, value in self.values
        ]


def load_experiment(name: str) -> list[dict[str, Any]]:
    """The grids of a table or another sweep of `conf/experiment`.

    Args:
        name: Name of the file without `.yaml`, such as `table1`.

    Raises:
        ConfigurationError: if there is no such file or it describes a single run.
    """
    grids = _grids_of(Path(config_dir()) / "experiment" / f"{name}.yaml")
    if not grids:
        folder = Path(config_dir()) / "experiment"
        known = sorted(path.stem for path in folder.glob("*.yaml") if _grids_of(path))
        raise ConfigurationError(
            f"experiment={name} is no sweep; sweeps are {', '.join(known) or '(none)'}"
        )
    return grids


def _grids_of(path: Path) -> list[dict[str, Any]]:
    content: Any = yaml.safe_load(path.read_text()) if path.is_file() else {}
    for key in ("hydra", "sweeper", "grids"):
        content = (content or {}).get(key)
    return list(content or [])


def expand(
    grids: Sequence[Mapping[str, Any]],
    overrides: Sequence[str] = (),
    *,
    config_loader: ConfigLoader | None = None,
) -> list[Job]:
    """All jobs of the union of some grids, each once, in the order of the grids.

    Args:
        grids: Each a dict of key → value or list of values; see the top of this file.
        overrides: Words of the command line. A key that grids give is replaced where they give it
            (with the settings tied to it); any other goes to every job. Each may have several
            values: `seed=0,1`. A value that some of the grids list goes to these alone:
            `data.modality=gray` leaves the grids of clouds out.
        config_loader: Hydra's, for words such as `model=glob(i2i*)`.

    Raises:
        ConfigurationError: for a word that has no list of values, such as an interval.
    """
    parser = OverridesParser.create(config_loader=config_loader)
    typed = {t.name: t for t in map(_typed, parser.parse_overrides(list(overrides)))}
    listed = {name for grid in grids for key in grid for name in key.split(",")}
    common = [t.choices() for name, t in typed.items() if name not in listed]
    jobs: dict[frozenset[str], Job] = {}
    for grid in grids or [{}]:
        mine = {t.name: t.meant_for(grid, grids) for t in typed.values()}
        factors = [f for key, value in grid.items() for f in _factors(key, value, mine)] + common
        for combination in itertools.product(*factors):
            words = tuple(word for choice, _ in combination for word in choice)
            settings = {key: v for _, choice in combination for key, v in choice.items()}
            jobs.setdefault(frozenset(words), Job(words, settings))
    return list(jobs.values())


def _listed(name: str, grids: Sequence[Mapping[str, Any]]) -> list[Any]:
    """All values that some grids give a setting."""
    found: list[Any] = []
    for grid in grids:
        for key, value in grid.items():
            if name in key.split(","):
                found += value if isinstance(value, list | tuple) else [value]
    return found


def _factors(key: str, value: object, typed: dict[str, _Typed]) -> list[list[_Choice]]:
    """What a grid's key varies, after the words of the command line."""
    names = key.split(",")
    given = [typed[name] for name in names if name in typed]
    if given:
        followers = [name for name in names if name not in typed]
        return [given[0].choices(followers), *(other.choices() for other in given[1:])]
    values = value if isinstance(value, list | tuple) else [value]
    return [[(tuple(f"{n}={_word(v)}" for n in names), dict.fromkeys(names, v)) for v in values]]


def _typed(override: Override) -> _Typed:
    key = override.get_key_element()
    name = key.lstrip("+~")
    if not override.is_sweep_override():
        line = override.input_line
        assert line is not None
        return _Typed(name, ((line, override.value()),))
    if not override.is_discrete_sweep():
        raise ConfigurationError(
            f"{override.input_line}: a sweep wants a list of values, such as {key}=1,2,3"
        )
    words = [f"{key}={value}" for value in override.sweep_string_iterator()]
    parsed = OverridesParser.create().parse_overrides(words)
    return _Typed(name, tuple((w, o.value()) for w, o in zip(words, parsed, strict=True)))


def _word(value: object) -> str:
    """A value of a YAML file as Hydra reads it on a command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_word, value))}]"
    text = str(value)
    if _PLAIN_WORD.fullmatch(text):
        return text
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def command(job: Job | Sequence[str], *, experiment: str | None = None) -> str:
    """What to type for a job, or for the jobs of a sweep.

    Args:
        job: A job, or words of the command line.
        experiment: A sweep whose jobs are meant; None for a single run.
    """
    words = job.overrides if isinstance(job, Job) else tuple(job)
    head = [
        "python",
        "-m",
        "i2i.train",
        *(["-m", f"experiment={experiment}"] if experiment else []),
    ]
    return shlex.join([*head, *words])
