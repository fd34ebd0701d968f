from __future__ import annotations

import ctypes

import pytest

from i2i.errors import RendererUnavailableError
from i2i.rendering import opengl
from i2i.rendering.opengl import choose_platform


@pytest.fixture
def machine(monkeypatch):
    """Pretends what is installed: `machine(egl=device number or None, osmesa=True or False)`."""

    def pretend(*, egl: int | None, osmesa: bool, wished: str | None = None) -> None:
        monkeypatch.delenv("EGL_DEVICE_ID", raising=False)
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
        if wished is not None:
            monkeypatch.setenv("PYOPENGL_PLATFORM", wished)
        monkeypatch.setattr(opengl, "_working_egl_device", lambda: egl)
        library = ctypes.CDLL(None) if osmesa else None
        monkeypatch.setattr(opengl, "_load", lambda *names: library)

    return pretend


def test_egl_comes_first_and_its_device_is_chosen(machine):
    machine(egl=2, osmesa=True)
    assert choose_platform() == "egl"
    assert opengl.os.environ["EGL_DEVICE_ID"] == "2"


def test_a_chosen_device_is_kept(machine, monkeypatch):
    machine(egl=2, osmesa=True)
    monkeypatch.setenv("EGL_DEVICE_ID", "1")
    choose_platform()
    assert opengl.os.environ["EGL_DEVICE_ID"] == "1"


def test_osmesa_comes_second(machine):
    machine(egl=None, osmesa=True)
    assert choose_platform() == "osmesa"


def test_the_wish_of_the_user_wins(machine):
    machine(egl=0, osmesa=True, wished="osmesa")
    assert choose_platform() == "osmesa"


@pytest.mark.parametrize("wished", [None, "egl", "osmesa"])
def test_nothing_installed_names_the_packages(machine, wished):
    machine(egl=None, osmesa=False, wished=wished)
    with pytest.raises(RendererUnavailableError, match=r"libegl1 libgl1-mesa-dri.*libosmesa6"):
        choose_platform()


def test_a_platform_with_a_window_is_refused(machine):
    machine(egl=0, osmesa=True, wished="glx")
    with pytest.raises(RendererUnavailableError, match="egl, osmesa"):
        choose_platform()


def test_missing_library_is_none():
    assert opengl._load("no-such-library", "libno-such-library.so.1") is None
