"""What the sweeper does before and after a launcher: what is left to do, and what came out."""

import gc
import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig

from i2i.cli import given_overrides, readable
from i2i.configuration import plain
from i2i.errors import ConfigurationError, DatasetNotFoundError, I2IError
from i2i.runs.building import check_fit
from i2i.runs.identity import config_hash
from i2i.runs.progress import find_broken, find_done
from i2i.runs.sweeps import Job


class JobFailedError(I2IError):
    """A job of a sweep failed; holds the reason only, so that what the job held can be freed."""


@dataclass(frozen=True)
class Rules:
    """What a door's jobs are to the sweeper. Each function gets a resolved configuration.

    Attributes:
        identity: Gives a hash; jobs with the same one are one.
        done: Gives where a finished job's result is, from its hash as well; None if it is not.
        broken: The same for what an unfinished one left behind and can go on from.
        left_to_others: Whether a job that another process runs is left to that; else waits for it.
    """

    identity: Callable[[dict[str, Any]], str]
    done: Callable[[dict[str, Any], str], Path | None]
    broken: Callable[[dict[str, Any], str], Path | None]
    left_to_others: bool


TRAINING = Rules(config_hash, find_done, find_broken, left_to_others=True)


@dataclass(frozen=True)
class Planned:
    """A job and what is to be done with it.

    Attributes:
        job: The job.
        state: `done`, `continue`, `start`, `left out` or `failed` (it cannot be composed).
        why: Where its result or its broken run is, or the reason.
        config: Its resolved configuration; empty where it failed.
        identity: Its hash; empty where it failed, the run folder where `resume` was typed.
    """

    job: Job
    state: str
    why: str
    config: dict[str, Any]
    identity: str


def plan(
    jobs: Iterable[Job],
    compose: Callable[[Sequence[str]], DictConfig],
    rules: Rules = TRAINING,
) -> list[Planned]:
    """Find out what is done, broken, new and impossible; jobs of the same identity count once.

    Args:
        jobs: Of `i2i.runs.sweeps.expand`.
        compose: Gives a job's configuration without Hydra's own part, from its words.
        rules: Of the door.
    """
    planned: dict[str, Planned] = {}
    sources: dict[str, Any] = {}
    for job in jobs:
        try:
            cfg = compose(job.overrides)
            config = plain(cfg)
            reason = _left_out(cfg, config, sources)
            identity = str(config["resume"] or rules.identity(config))
            if identity not in planned:
                planned[identity] = _planned(job, config, identity, reason, rules)
        except Exception as error:  # one job that makes no sense stops no other
            planned[str(job)] = Planned(job, "failed", one_line(error), {}, "")
    return list(planned.values())


def _planned(
    job: Job, config: dict[str, Any], identity: str, reason: str | None, rules: Rules
) -> Planned:
    if reason:
        return Planned(job, "left out", reason, config, identity)
    if config["resume"]:  # that run's own configuration counts, not what is composed here
        return Planned(job, "continue", identity, config, identity)
    if done := rules.done(config, identity):
        return Planned(job, "done", str(done), config, identity)
    if broken := rules.broken(config, identity):
        return Planned(job, "continue", str(broken), config, identity)
    return Planned(job, "start", "", config, identity)


def _left_out(cfg: DictConfig, config: dict[str, Any], sources: dict[str, Any]) -> str | None:
    """Why a job makes no sense: the model does not see the data, or the class is not there."""
    try:
        check_fit(cfg)
    except ConfigurationError as error:
        return str(error)
    data = config["data"]
    if "source" not in data or data["object"] == "all":
        return None
    key = repr(data["source"])
    try:
        if key not in sources:
            sources[key] = instantiate(data["source"], _convert_="all")
        wanted = data["object"]
        sources[key].check_classes([wanted] if isinstance(wanted, str) else wanted)
    except DatasetNotFoundError:
        return None  # the job itself says what is missing and how to get it
    except ValueError as error:
        return str(error)
    return None


def tell_plan(planned: Sequence[Planned]) -> None:
    """Print what will be done with every job."""
    shown = _distinguishing([p.job for p in planned])
    counts = [
        f"{sum(p.state == state for p in planned)} {words}"
        for state, words in (
            ("done", "done"), ("continue", "to continue"), ("start", "to start"),
            ("left out", "left out"), ("failed", "not possible"),
        )
        if any(p.state == state for p in planned)
    ]  # fmt: skip
    print(f"sweep of {len(planned)} jobs: {', '.join(counts)}")
    for p in planned:
        if p.state in ("done", "continue", "start"):
            print(f"  {p.state:<8}  {shown(p.job)}" + (f"  ({p.why})" if p.why else ""))
    for state, words in (("left out", "left out"), ("failed", "not possible")):
        _tell_reasons(words, [(p.job, p.why) for p in planned if p.state == state], shown)
    sys.stdout.flush()


def tell_end(planned: Sequence[Planned], failures: dict[str, str], rules: Rules = TRAINING) -> bool:
    """Print what came out of the jobs that were launched or could not be.

    Args:
        planned: All jobs.
        failures: Reason by identity of the jobs that failed.
        rules: Of the door.

    Returns:
        Whether all went well.
    """
    shown = _distinguishing([p.job for p in planned])
    launched = [p for p in planned if p.state in ("continue", "start")]
    quiet = [p for p in launched if p.identity not in failures and not p.config["resume"]]
    elsewhere = [p for p in quiet if rules.left_to_others and not rules.done(p.config, p.identity)]
    failed = [(p.job, failures[p.identity]) for p in launched if p.identity in failures]
    done = len(launched) - len(elsewhere) - len(failed)
    failed += [(p.job, p.why) for p in planned if p.state == "failed"]
    print(
        f"\nsweep over: {done} done now, {sum(p.state == 'done' for p in planned)} before, "
        f"{len(elsewhere)} running elsewhere, {len(failed)} failed"
    )
    for p in elsewhere:
        print(f"  elsewhere {shown(p.job)}")
    _tell_reasons("failed", failed, shown)
    if failed:
        print("the same command again does what is left")
    sys.stdout.flush()
    return not failed


def _tell_reasons(
    words: str, reasons: Sequence[tuple[Job, str]], shown: Callable[[Job], str]
) -> None:
    """Print jobs below the reason that they have in common."""
    grouped: dict[str, list[Job]] = {}
    for job, reason in reasons:
        grouped.setdefault(reason, []).append(job)
    for reason, jobs in grouped.items():
        print(f"{words}: {reason}")
        for job in jobs:
            print(f"  {shown(job)}")


def run_job(work: Callable[[], None], *, clean: Callable[[], object] = gc.collect) -> None:
    """Run one job of a sweep, and leave nothing of it in this process, which may have others.

    Args:
        work: The job.
        clean: Called after it, whatever came out.

    Raises:
        JobFailedError: with the reason alone: a traceback would keep alive what the job held.
    """
    words = [word for word in given_overrides() if not word.startswith("experiment=")]
    print(f"\njob {HydraConfig.get().job.num}: {' '.join(words)}", flush=True)
    if multiprocessing.get_start_method(allow_none=True) == "loky":
        # Joblib's processes cannot start others in its own way, as rendering must.
        multiprocessing.set_start_method(None, force=True)
    reason = ""
    try:
        work()
    except Exception as error:
        reason = one_line(error)
        expected = isinstance(error, I2IError | ValueError | OSError)
        if not expected or "HYDRA_FULL_ERROR" in os.environ:
            traceback.print_exc()
    clean()
    if reason:
        print(f"failed: {reason}", file=sys.stderr, flush=True)
        raise JobFailedError(reason)


def one_line(error: BaseException) -> str:
    """The reason of an error in one line."""
    text = " ".join(readable(error).split()).split(" Config search path:")[0]
    text = text or type(error).__name__
    known = isinstance(error, I2IError | ValueError | OSError | HydraException)
    return text if known else f"{type(error).__name__}: {text}"


def _distinguishing(jobs: Sequence[Job]) -> Callable[[Job], str]:
    """A job in words, without the words that all jobs share."""
    shared = set.intersection(*(set(job.overrides) for job in jobs)) if len(jobs) > 1 else set()
    return lambda job: " ".join(w for w in job.overrides if w not in shared) or "(one job)"
