"""Sweeps of the render door: classes and parts as jobs, and the same bytes as of one command."""

import importlib.util

import pytest

TINY = (
    "scale=tiny", "data=synthetic", "data.source.instances_per_class=5",
    "data.source.test_instances_per_class=3", "data.views_per_instance=4",
    "data.test_views_per_instance=2", "data.render_workers=0",
)  # fmt: skip


def stores(folder):
    """Contents of every visible file below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.parts)
    }


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    return tmp_path_factory.mktemp("rendering")


@pytest.fixture(scope="module")
def expected(door, workplace):
    door("render", *TINY, "data.object=[chair,car]", "paths.data_dir=once", cwd=workplace)
    return stores(workplace / "once")


@pytest.fixture(scope="module")
def by_class(door, workplace):
    """Two classes and one that is not there, each a job."""
    words = ("-m", *TINY, "data.object=chair,car,nope", "paths.data_dir=classes")
    return words, door("render", *words, cwd=workplace).stdout


def test_classes_as_jobs_give_the_bytes_of_one_command(workplace, expected, by_class):
    _, told = by_class
    assert expected
    assert stores(workplace / "classes") == expected
    assert "sweep of 3 jobs: 2 to start, 1 left out" in told
    assert "2 done now, 0 before, 0 running elsewhere, 0 failed" in told


def test_classes_that_are_rendered_are_done(door, workplace, by_class):
    words, _ = by_class
    again = door("render", *words, "data.views_per_instance=4,5", cwd=workplace).stdout
    assert "2 done, 2 to start" in again  # one more view is another job
    assert "sweep of 6 jobs" in again
    whole = door("render", *words, "data.views_per_instance=5", cwd=workplace).stdout
    assert "sweep of 3 jobs: 2 done, 1 left out" in whole


def test_networks_that_see_the_same_are_one_job(door, workplace, expected):
    words = ("-m", *TINY, "data.object=chair", "model=i2i,cnn_gs", "paths.data_dir=once")
    assert "sweep of 1 jobs: 1 done" in door("render", *words, cwd=workplace).stdout


def test_parts_as_jobs_and_one_command_give_the_same_bytes(door, workplace, expected):
    words = (*TINY, "data.object=[chair,car]", "paths.data_dir=parts")
    parts = ("-m", *words, "parts=3", "part=1,2,3")
    assert "3 done now" in door("render", *parts, cwd=workplace).stdout
    assert not stores(workplace / "parts")
    assert "sweep of 3 jobs: 3 done" in door("render", *parts, cwd=workplace).stdout
    door("render", *words, cwd=workplace)
    assert stores(workplace / "parts") == expected


@pytest.mark.parametrize("words", [("part=4", "parts=3"), ("part=1",), ("parts=3",)])
def test_parts_that_are_none_are_refused(door, workplace, words):
    done = door("render", *TINY, *words, cwd=workplace, check=False)
    assert done.returncode == 1
    assert "give both, such as part=1 parts=8" in done.stderr


def test_parts_do_not_throw_away_what_others_made(door, workplace):
    words = (*TINY, "part=1", "parts=2", "overwrite=true")
    done = door("render", *words, cwd=workplace, check=False)
    assert done.returncode == 1
    assert "overwrite=true with part" in done.stderr


def test_a_failing_class_stops_no_other_and_is_told(door, workplace):
    words = ("-m", *TINY, "data.object=desk", "data.render_workers=-1,0", "paths.data_dir=failing")
    done = door("render", *words, "data.seed=0,1", cwd=workplace, check=False)
    assert done.returncode == 1
    assert "failed: data.render_workers=-1 is not allowed" in done.stderr  # in the job's own log
    assert "failed: data.render_workers=-1 is not allowed" in done.stdout.split("sweep over")[1]


@pytest.mark.parametrize(
    ("launcher", "module", "more"),
    [
        ("joblib", "hydra_joblib_launcher", "hydra.launcher.n_jobs=2"),
        ("submitit_local", "hydra_submitit_launcher", "hydra.launcher.timeout_min=10"),
    ],
)
def test_a_launcher_renders_in_processes_of_its_own(
    door, workplace, expected, launcher, module, more
):
    if not importlib.util.find_spec(f"hydra_plugins.{module}"):
        pytest.skip(f"hydra_plugins.{module} is not installed")
    # With workers: rendering starts processes from within the launcher's.
    words = [w for w in TINY if not w.startswith("data.render_workers")]
    words += ["data.render_workers=2", "data.object=chair,car", f"paths.data_dir={launcher}"]
    done = door("render", "-m", *words, f"hydra/launcher={launcher}", more, cwd=workplace)
    assert "2 done now, 0 before, 0 running elsewhere, 0 failed" in done.stdout
    assert stores(workplace / launcher) == expected
