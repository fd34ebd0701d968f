"""Blender in a process of its own: both ends of the pipe.

Loaded as a module, Blender writes to the standard output, puts its script folders first on Python's
path, which processes started later inherit, and waits for ever when the process ends while anything
still refers to it. None of this may reach a training or rendering process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera

if TYPE_CHECKING:
    from i2i.rendering.mesh import RenderMesh

_PATIENCE_S = 10  # for a process that has been told to end
_LIBRARIES = "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libxext6 libsm6 libice6 libgl1"


class BlenderProcess:
    """A running Blender that draws one mesh at a time; it ends when its input is closed.

    Raises:
        RendererUnavailableError: from every method, if Blender cannot start or died.
    """

    def __init__(self) -> None:
        # Python's path as it is here: a package may have been found through it alone.
        path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path},
        )

    def set_up(
        self,
        mesh: RenderMesh,
        modality: str,
        camera: Camera,
        image_size: int,
        *,
        samples: int,
        bounces: int,
        denoise: bool,
    ) -> None:
        """Replace what is drawn; see `CyclesScene` for the arguments."""
        options = {"samples": samples, "bounces": bounces, "denoise": denoise}
        self._ask(("set up", (mesh, modality, camera, image_size), options))

    def shoot(self, rotation: NDArray[np.float64]) -> NDArray[np.float32]:
        """One picture of the mesh; see `CyclesScene.shoot`."""
        picture: NDArray[np.float32] = self._ask(("shoot", (rotation,), {}))
        return picture

    @property
    def running(self) -> bool:
        """False once Blender has died."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _ask(self, request: tuple[str, tuple[Any, ...], dict[str, Any]]) -> Any:  # noqa: ANN401
        """Send a request and wait for the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump(request, self._process.stdin)
            self._process.stdin.flush()
            error, answer = pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as gone:
            self._process.kill()  # if it lives after all: what it would say next fits no question
            code = self._process.wait()
            raise RendererUnavailableError(
                f"Blender's process ended (exit code {code}), perhaps for lack of memory; try "
                "fewer processes (data.render_workers=1) or another renderer: renderer=embree"
            ) from gone
        if error is not None:
            raise RendererUnavailableError(error)
        return answer


def serve(requests: IO[bytes], replies: IO[bytes], folder: Path) -> None:
    """Answer requests until there are no more: (error or None, answer) for each.

    Args:
        requests: Pickled (name, arguments, options), one after the other.
        replies: Where the pickled answers go.
        folder: For temporary files.
    """
    from i2i.rendering.blender_scene import CyclesScene

    scene: CyclesScene | None = None
    while True:
        try:
            name, arguments, options = pickle.load(requests)
        except EOFError:
            break
        error, answer = None, None
        try:
            if name == "set up":
                scene = CyclesScene(*arguments, **options, folder=folder)
            else:
                assert scene is not None
                answer = scene.shoot(*arguments)
        except ImportError as missing:
            error = (
                f"the renderer 'blender' cannot load bpy ({missing}); it needs these libraries "
                f"(Debian, Ubuntu): apt-get install {_LIBRARIES}, or use the default: "
                "renderer=embree"
            )
        # Blender raises what it likes; all of it is told to whoever asked.
        except Exception:
            error = f"Blender failed:\n{traceback.format_exc()}"
        pickle.dump((error, answer), replies)
        replies.flush()


def main() -> None:
    """Serve on the standard input and output; what Blender prints goes nowhere."""
    # Both reach the whole group of processes. The one who asks decides; when it ends, so does the
    # input, and the folder below is removed. An exception in the middle of Blender would hang it.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    replies = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    code = 1
    try:
        with tempfile.TemporaryDirectory(prefix="i2i-blender-") as folder:
            os.environ["TMPDIR"] = folder  # Blender's own temporary files, too
            with contextlib.suppress(BrokenPipeError):
                serve(sys.stdin.buffer, replies, Path(folder))
                code = 0
    finally:
        os._exit(code)  # without Blender's own end, which can wait for ever


if __name__ == "__main__":
    main()
