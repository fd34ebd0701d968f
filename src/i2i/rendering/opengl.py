"""Which library draws with OpenGL without a display; decided before OpenGL is imported."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
from functools import cache

from i2i.errors import RendererUnavailableError

PLATFORMS = ("egl", "osmesa")
_HELP = (
    "install one of them (Debian, Ubuntu): apt-get install libegl1 libgl1-mesa-dri, or "
    "apt-get install libosmesa6; or use the renderer that needs no system library: renderer=embree"
)

_OSMESA_FILES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")

# Numbers from the EGL 1.5 headers and from EGL_EXT_platform_device.
_EGL_PLATFORM_DEVICE = 0x313F
_MAX_DEVICES = 16


def choose_platform() -> str:
    """The value for PYOPENGL_PLATFORM: the user's, else "egl", else "osmesa".

    Sets EGL_DEVICE_ID to the first device that answers, unless the user chose one: on machines with
    several, the first is often one that this user may not open.

    Raises:
        RendererUnavailableError: if the wish is not an off-screen platform or nothing is installed.
    """
    wished = os.environ.get("PYOPENGL_PLATFORM", "").strip().lower()
    if wished and wished not in PLATFORMS:
        raise RendererUnavailableError(
            f"PYOPENGL_PLATFORM={wished!r} cannot draw without a display; "
            f"unset it or set it to one of {', '.join(PLATFORMS)}"
        )
    device = None if wished == "osmesa" else _working_egl_device()
    if device is not None:
        os.environ.setdefault("EGL_DEVICE_ID", str(device))
        return "egl"
    if wished != "egl" and _load("OSMesa", *_OSMESA_FILES) is not None:
        return "osmesa"
    missing = {
        "egl": "PYOPENGL_PLATFORM=egl, but libEGL or a device for it is missing",
        "osmesa": "PYOPENGL_PLATFORM=osmesa, but libOSMesa is missing",
        "": "neither EGL with a device nor OSMesa was found",
    }[wished]
    raise RendererUnavailableError(f"the renderer 'pyrender' cannot run: {missing}; {_HELP}")


@cache
def _working_egl_device() -> int | None:
    """Number of the first EGL device that can be initialised; None without EGL or devices."""
    library = _load("EGL", "libEGL.so.1")
    if library is None:
        return None
    library.eglGetProcAddress.restype = ctypes.c_void_p
    library.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query = library.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_of = library.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not display_of:
        return None
    devices = (ctypes.c_void_p * _MAX_DEVICES)()
    count = ctypes.c_int(0)
    query_devices = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )(query)
    if not query_devices(_MAX_DEVICES, devices, ctypes.byref(count)):
        return None
    get_display = ctypes.CFUNCTYPE(
        ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
    )(display_of)
    library.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    library.eglTerminate.argtypes = [ctypes.c_void_p]
    for index in range(count.value):
        display = get_display(_EGL_PLATFORM_DEVICE, devices[index], None)
        if display and library.eglInitialize(display, None, None):
            library.eglTerminate(display)
            return index
    return None


def _load(name: str, *files: str) -> ctypes.CDLL | None:
    """A shared library by its file names or by the linker's search; None if it is not installed."""
    for file in (*files, ctypes.util.find_library(name)):
        if file is None:
            continue
        try:
            return ctypes.CDLL(file)
        except OSError:
            continue
    return None
