"""Sweeps, run as a user runs them: killed, continued, two at once, with every launcher."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.hydra_config import HydraConfig

from i2i.configuration import compose, config_dir
from i2i.errors import ConfigurationError
from i2i.reports.build import build_report
from i2i.reports.markdown import markdown
from i2i.reports.paper import load_paper
from i2i.reports.results import read_results
from i2i.training import refuse_table, train

TINY = (
    "scale=tiny", "data.source.instances_per_class=6", "data.source.test_instances_per_class=3",
    "data.views_per_instance=8", "data.test_views_per_instance=4", "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false", "trainer.enable_model_summary=false", "data=synthetic",
    "callbacks=no_pictures",
)  # fmt: skip
# One model of a table: the table's own values of these keys are replaced.
SWEEP = ("-m", "experiment=table1", *TINY, "model=i2i", "data.object=chair", "seed=0,1,2")
LONG = "trainer.max_steps=40"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A user's folder; its stores are shared by the tests of this file."""
    return tmp_path_factory.mktemp("workplace")


def start(workplace, *words):
    return subprocess.Popen(
        [sys.executable, "-m", "i2i.train", *words], cwd=workplace, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def results(workplace, folder="results"):
    return sorted((workplace / folder).glob("*.json"))


def wait_until(condition, process, seconds=300):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    assert condition()


@pytest.fixture(scope="module")
def broken(workplace):
    """A sweep of three jobs that was killed in its second; gives the first's result and its age."""
    process = start(workplace, *SWEEP, LONG)
    runs = workplace / "runs"
    wait_until(lambda: len(list(runs.glob("*-s1-*/checkpoints/last.ckpt"))) == 1, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    (first,) = results(workplace)
    return first, first.stat().st_mtime_ns


def test_two_sweeps_at_once_end_a_killed_one_and_share_what_is_left(door, workplace, broken):
    pair = [start(workplace, *SWEEP, LONG) for _ in range(2)]
    told = [process.communicate(timeout=600)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], told
    for text in told:
        assert "sweep of 3 jobs: 1 done" in text
    assert any("1 to continue" in text for text in told)
    # Nothing was done twice: one folder and one result a job, and the first's is untouched.
    folders = sorted((workplace / "runs").glob("i2i-*"))
    assert len(folders) == len(results(workplace)) == 3
    ended = [line for text in told for line in text.splitlines() if line.startswith("run runs/")]
    assert len(ended) == len(set(ended)) == 2
    first, written = broken
    assert first.stat().st_mtime_ns == written


def test_the_broken_job_ends_as_if_it_had_run_through(workplace, broken, monkeypatch):
    (continued,) = (workplace / "runs").glob("*-s1-*")
    monkeypatch.chdir(workplace)
    train(compose([*TINY, LONG, "data.object=chair", "seed=1", "run_name=whole"]))
    one, other = (
        json.loads((workplace / "runs" / name / "result.json").read_text())
        for name in (continued.name, "whole")
    )
    for key in ("config_hash", "errors_deg", "metrics", "steps"):
        assert one[key] == other[key], key
    assert report_with(workplace, continued.name) == report_with(workplace, "whole")


def report_with(workplace, run):
    """The table of the sweep's results, with that of seed 1 from a certain run."""
    folder = workplace / f"results_with_{run}"
    folder.mkdir()
    for path in results(workplace):
        if json.loads(path.read_text())["job"]["seed"] != 1:
            shutil.copy(path, folder)
    shutil.copy(workplace / "runs" / run / "result.json", folder)
    found, problems = read_results([folder], None)
    assert len(found) == 3
    return markdown(build_report(1, found, load_paper(), problems=problems))


def test_a_failing_job_stops_no_other_and_is_told_at_the_end(door, workplace, broken):
    words = [w for w in SWEEP if not w.startswith("seed=")]
    done = door(
        "train", *words, LONG, "seed=0,3", "trainer.devices=2,1", cwd=workplace, check=False
    )
    assert done.returncode == 1
    assert "sweep of 4 jobs: 1 done, 3 to start" in done.stdout
    assert "1 done now, 1 before, 0 running elsewhere, 2 failed" in done.stdout
    reason = done.stdout.split("sweep over")[1]
    assert "failed: a sweep (-m) with 2 processes a job" in reason
    assert "  seed=3 trainer.devices=2" in reason


def test_a_table_without_m_is_refused_with_the_command(monkeypatch):
    words = ["experiment=table4", "seed=0"]
    with initialize_config_dir(config_dir(), version_base="1.3"):
        cfg = hydra_compose("train", overrides=words, return_hydra_config=True)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", cfg)
    with pytest.raises(ConfigurationError, match=r"i2i\.train -m experiment=table4 seed=0"):
        refuse_table()


@pytest.mark.parametrize(
    ("launcher", "module", "more", "unseen"),
    [
        ("joblib", "hydra_joblib_launcher", "hydra.launcher.n_jobs=2", "bench"),
        ("submitit_local", "hydra_submitit_launcher", "hydra.launcher.timeout_min=10", "table"),
    ],
)
def test_a_launcher_runs_jobs_in_processes_of_its_own(
    door, workplace, launcher, module, more, unseen
):
    if not importlib.util.find_spec(f"hydra_plugins.{module}"):
        pytest.skip(f"hydra_plugins.{module} is not installed")
    # A class that is not rendered yet: rendering starts processes from within the launcher's.
    words = [w for w in SWEEP if not w.startswith(("seed=", "data.object="))]
    words += ["trainer.max_steps=5", "seed=0", f"data.object={unseen}", "paths.runs_dir=others"]
    done = door("train", *words, f"hydra/launcher={launcher}", more, cwd=workplace)
    assert "1 done now, 0 before, 0 running elsewhere, 0 failed" in done.stdout
    assert len(list((workplace / "results").glob(f"*-{unseen}-*"))) == 1
