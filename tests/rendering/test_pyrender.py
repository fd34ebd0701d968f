from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering import prepare_mesh
from i2i.rendering import pyrender as module
from i2i.rendering.opengl import _OSMESA_FILES, _load

OSMESA_SCRIPT = """
import numpy as np, trimesh
from i2i.rendering import get_renderer, prepare_mesh
mesh = prepare_mesh(trimesh.creation.box((1, 2, 3)))
turn = np.eye(3)[None]
depths = [get_renderer(name).depth(mesh, turn, image_size=64) for name in ("embree", "pyrender")]
hits = [depth > 0 for depth in depths]
assert (hits[0] & hits[1]).sum() / (hits[0] | hits[1]).sum() > 0.98
gray = get_renderer("pyrender").render(mesh, turn, image_size=64)
assert gray[0, 0, 0, 0] == 255 and 20 < gray[0, 0, 22, 26] < 255
print("drawn by", get_renderer("pyrender").version)
"""


def test_osmesa_draws_too():
    if _load("OSMesa", *_OSMESA_FILES) is None:
        pytest.skip("libOSMesa is missing: apt-get install libosmesa6")
    done = subprocess.run(
        [sys.executable, "-c", OSMESA_SCRIPT],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "PYOPENGL_PLATFORM": "osmesa"},
    )
    assert done.returncode == 0, done.stderr
    assert "on osmesa" in done.stdout


def test_depth_is_ray_length_not_z(pyrender):
    """A plate across the axis: the same z everywhere, longer rays towards its corners."""
    plate = prepare_mesh(trimesh.creation.box((2, 2, 0.001)))
    depth = pyrender.depth(plate, np.eye(3)[None])[0]
    z = -depth * Camera().rays(128)[..., 2]
    hit = depth > 0
    assert np.ptp(z[hit]) < 1e-3
    assert np.ptp(depth[hit]) > 0.05


def test_one_context_serves_all_views_and_sizes(pyrender, wedge, rotations):
    first = pyrender.render(wedge, rotations, image_size=64)
    context = pyrender._context
    pyrender.render(wedge, rotations, image_size=32)
    np.testing.assert_array_equal(pyrender.render(wedge, rotations, image_size=64), first)
    assert pyrender._context is context


def test_failing_context_is_reported_with_packages(monkeypatch, wedge, rotations):
    monkeypatch.setattr(module, "choose_platform", lambda: "egl")
    renderer = module.PyrenderRenderer()

    def fail(*size: int) -> None:
        raise AssertionError("no display")

    real = pytest.importorskip("pyrender")
    monkeypatch.setattr(real, "OffscreenRenderer", fail)
    with pytest.raises(RendererUnavailableError, match=r"libosmesa6.*renderer=embree"):
        renderer.render(wedge, rotations)


def test_missing_package_is_reported(monkeypatch):
    def missing(name: str) -> str:
        raise module.PackageNotFoundError(name)

    monkeypatch.setattr(module, "package_version", missing)
    with pytest.raises(RendererUnavailableError, match="pip install pyrender"):
        module.PyrenderRenderer.available()
