"""Fixtures that several test files share."""

import os
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
def door(tmp_path_factory):
    """Runs a door in a subprocess as a user would: `door("train", "scale=tiny", ...)`."""
    import subprocess

    home = tmp_path_factory.mktemp("home")

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
