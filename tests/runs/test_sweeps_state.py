"""What is left of a sweep: done, broken and impossible jobs, and locks that end with a process."""

import json
import os
import signal
import subprocess
import sys

import pytest

from i2i.configuration import compose, plain
from i2i.runs.identity import config_hash
from i2i.runs.locks import job_lock
from i2i.runs.progress import find_broken, find_done
from i2i.runs.sweeps import expand
from i2i.sweeping import plan, tell_end, tell_plan


@pytest.fixture
def words(tmp_path):
    return [f"paths.runs_dir={tmp_path}/runs", f"paths.results_dir={tmp_path}/results"]


def run_folder(tmp_path, name, state, identity, *, files=()):
    folder = tmp_path / "runs" / name
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text("{}")
    folder.mkdir(parents=True, exist_ok=True)
    status = {"state": state, "config_hash": identity, "updated": name}
    (folder / "status.json").write_text(json.dumps(status))
    return folder


def test_done_broken_and_new_jobs_are_told_apart(tmp_path, words, capsys):
    jobs = expand([{"seed": [0, 1, 2, 3, 4]}], words)
    composed = {job.overrides: compose(job.overrides) for job in jobs}
    hashes = [config_hash(plain(cfg)) for cfg in composed.values()]
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / f"x-{hashes[0]}.json").write_text(f'{{"config_hash": "{hashes[0]}"}}')
    run_folder(tmp_path, "whole", "done", hashes[1], files=["result.json"])
    last = "checkpoints/last.ckpt"
    run_folder(tmp_path, "old", "running", hashes[2], files=[last])
    newest = run_folder(tmp_path, "other", "failed", hashes[2], files=[last])
    run_folder(tmp_path, "nothing", "interrupted", hashes[3])
    (tmp_path / "runs" / "half").mkdir()
    (tmp_path / "runs" / "half" / "status.json").write_text('{"state": ')
    planned = plan(jobs, composed.__getitem__)
    assert [p.state for p in planned] == ["done", "done", "continue", "start", "start"]
    assert planned[2].why == str(newest)
    tell_plan(planned)
    told = capsys.readouterr().out
    assert "sweep of 5 jobs: 2 done, 1 to continue, 2 to start" in told
    assert str(newest) in told


def test_a_fit_alone_is_done_only_where_no_test_is_wanted(tmp_path, words):
    config = plain(compose(words))
    identity = config_hash(config)
    folder = run_folder(tmp_path, "fit", "done", identity, files=["checkpoints/last.ckpt"])
    assert find_done(config, identity) is None
    assert find_broken(config, identity) == folder
    assert find_done(config | {"run": ["fit"]}, identity) == folder


def test_jobs_that_make_no_sense_are_left_out_or_fail_and_the_others_stay(words, capsys):
    grids = [{"model": ["cnn_gs", "nope"], "data.object": ["chair", "bed"]},
             {"model": "cnn_gs", "task": "classification"}]  # fmt: skip
    planned = plan(expand(grids, words), compose)
    assert [p.state for p in planned] == ["start", "left out", "failed", "failed", "left out"]
    tell_plan(planned)
    told = capsys.readouterr().out
    assert "left out: synthetic has no class bed" in told
    assert "left out: model=cnn_gs has no network for task=classification" in told
    assert told.count("Could not find 'model/nope'") == 1  # once for both jobs
    assert not tell_end(planned, {planned[0].identity: "the disk is full"})
    told = capsys.readouterr().out
    assert "0 done now, 0 before, 0 running elsewhere, 3 failed" in told
    assert "failed: the disk is full\n  model=cnn_gs data.object=chair" in told


def test_jobs_of_the_same_identity_are_one(words):
    same = [["data.render_workers=1"], ["data.render_workers=2"]]
    jobs = [job for more in same for job in expand([], [*words, *more])]
    assert len(jobs) == 2
    assert len(plan(jobs, compose)) == 1


def test_a_lock_is_held_by_one_at_a_time(tmp_path):
    with job_lock(tmp_path, "a") as first, job_lock(tmp_path, "b") as other:
        assert first
        assert other
        with job_lock(tmp_path, "a") as second:
            assert not second
    with job_lock(tmp_path, "a") as again:
        assert again


def test_a_lock_ends_with_its_process_even_if_a_forked_worker_lives_on(tmp_path):
    script = (
        "import os, pathlib, signal, sys, time\n"
        "from i2i.runs.locks import job_lock\n"
        "with job_lock(pathlib.Path(sys.argv[1]), 'a') as ours:\n"
        "    child = os.fork()\n"
        "    if child == 0:\n"
        "        time.sleep(60)\n"
        "        os._exit(0)\n"
        "    print(child, ours, flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    child, ours = process.stdout.readline().split()
    try:
        assert ours == "True"
        with job_lock(tmp_path, "a") as mine:
            assert not mine
        process.kill()
        process.wait()
        with job_lock(tmp_path, "a") as mine:
            assert mine
    finally:
        process.kill()
        os.kill(int(child), signal.SIGKILL)
