"""How far a job has come: whether its result is there, or a broken run that can be gone on with."""

from pathlib import Path
from typing import Any

from i2i.runs.folder import RunFolder, read_json


def find_done(config: dict[str, Any], identity: str) -> Path | None:
    """The result file or the run folder of a finished job; None if there is neither.

    Args:
        config: The job's resolved configuration; says where to look and whether a test is wanted.
        identity: Its hash.
    """
    results_dir = config["paths"]["results_dir"]
    tested = "test" in config["run"]
    if results_dir and tested:
        for path in sorted(Path(results_dir).glob(f"*{identity}.json")):
            if _read(path).get("config_hash") == identity:
                return path
    for folder, status in _runs_of(config, identity):
        if _is_done(folder, status, tested=tested):
            return folder.path
    return None


def find_broken(config: dict[str, Any], identity: str) -> Path | None:
    """The latest run folder of an unfinished job that has a checkpoint to go on from.

    A run that still goes on looks the same: hold the job's lock (`job_lock`) before using it.
    """
    tested = "test" in config["run"]
    broken = [
        (str(status.get("updated", "")), folder.path)
        for folder, status in _runs_of(config, identity)
        if not _is_done(folder, status, tested=tested)
        and (folder.checkpoints / "last.ckpt").is_file()
    ]
    return max(broken)[1] if broken else None


def _runs_of(config: dict[str, Any], identity: str) -> list[tuple[RunFolder, dict[str, Any]]]:
    found = []
    for path in sorted(Path(config["paths"]["runs_dir"]).rglob("status.json")):
        status = _read(path)
        if status.get("config_hash") == identity:
            found.append((RunFolder(path.parent), status))
    return found


def _is_done(folder: RunFolder, status: dict[str, Any], *, tested: bool) -> bool:
    """A run of the fit alone is not done when a test is wanted."""
    if status.get("state") != "done":
        return False
    return not tested or (folder.path / "result.json").is_file()


def _read(path: Path) -> dict[str, Any]:
    """A JSON file; empty if it is no longer there or cannot be read."""
    try:
        return read_json(path)
    except (OSError, ValueError):
        return {}
