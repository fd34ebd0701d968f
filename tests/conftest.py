"""Fixtures that several test files share."""

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
# OpenGL's platform is chosen when pyrender is first imported; no test has a display.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")


@pytest.fixture(autouse=True)
def _one_seed():
    torch.manual_seed(0)
    torch.set_num_threads(1)  # two cores, and OpenMP waits in a busy loop


@pytest.fixture(scope="session")
def home(tmp_path_factory):
    """The home folder of those who run doors."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="session")
def fresh_door(home):
    """Runs a door as a user does, in a new interpreter: `fresh_door("train", "scale=tiny")`."""

    def run(name, *words, cwd, check=True, timeout=600):
        done = subprocess.run(
            [sys.executable, "-m", f"i2i.{name}", *words],
            cwd=cwd,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
            env={**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1"},
        )
        assert not check or done.returncode == 0, f"{done.stdout}\n{done.stderr}"
        return done

    return run


@pytest.fixture(scope="session")
def door(home, tmp_path_factory):
    """Like `fresh_door`, but forked from a process that has imported the doors (door_server.py)."""
    environment = {**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1"}
    out, err = (tmp_path_factory.mktemp("said") / name for name in ("stdout", "stderr"))
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).parent / "door_server.py")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )

    def run(name, *words, cwd, check=True, timeout=600):
        request = {
            "name": name, "words": words, "cwd": str(cwd), "stdout": str(out), "stderr": str(err),
            "environment": {**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1"},
        }  # fmt: skip
        server.stdin.write(json.dumps(request) + "\n")
        server.stdin.flush()
        ready, _, _ = select.select([server.stdout], [], [], timeout)
        if not ready:
            os.killpg(server.pid, signal.SIGKILL)
            raise AssertionError(f"i2i.{name} {words}: no end after {timeout} s")
        status = int(server.stdout.readline())
        done = subprocess.CompletedProcess(words, status, out.read_text(), err.read_text())
        assert not check or status == 0, f"{done.stdout}\n{done.stderr}"
        return done

    yield run
    server.stdin.close()
    server.wait(timeout=60)


@pytest.fixture(scope="session")
def pyrender():
    """The one OpenGL context of this process: a second one, when closed, would end the first."""
    import trimesh

    from i2i.errors import RendererUnavailableError
    from i2i.rendering import get_renderer, prepare_mesh

    try:
        renderer = get_renderer("pyrender")
        sphere = prepare_mesh(trimesh.creation.icosphere(subdivisions=1))
        renderer.render(sphere, np.eye(3)[None], image_size=16)
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    yield renderer
    renderer.close()
