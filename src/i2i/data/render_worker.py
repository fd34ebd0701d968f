"""Rendering of single objects into chunk files, in this process or in a pool of processes.

This module and what it imports stay free of torch: a worker process should start quickly.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import multiprocessing
import os
import signal
import sys
import threading
import types
import zipfile
from collections.abc import Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from i2i.data.rows import surface_clouds, surface_seed, view_sets, visible_clouds
from i2i.data.sources.base import MeshItem, MeshSource
from i2i.data.store import StoreSettings
from i2i.errors import MeshError
from i2i.geometry.cameras import Camera
from i2i.geometry.seeding import view_rotation

if TYPE_CHECKING:
    from i2i.rendering.base import Renderer
    from i2i.rendering.mesh import RenderMesh

VIEWS_PER_CHUNK = 240
"""Views in one task: bounds the memory of a task and lets several processes share one object."""


@dataclass(frozen=True)
class Chunk:
    """One task: some views of one object, and the file that they go into.

    Attributes:
        item: The object.
        split: Split whose views are rendered.
        start: First view.
        stop: One past the last view.
        path: Chunk file.
        tag: Hash of everything that the contents depend on.
    """

    item: MeshItem
    split: str
    start: int
    stop: int
    path: Path
    tag: str


@dataclass(frozen=True)
class ChunkData:
    """Contents of a chunk file: main array (N, ...), rotations (N, 3, 3), mesh transform (4, 4)."""

    content: np.ndarray
    rotations: np.ndarray
    object_from_mesh: np.ndarray


@dataclass
class RenderContext:
    """What a process needs for every task; sent to each worker once.

    Attributes:
        source: Where meshes come from.
        renderer: A renderer or its name; a name is looked up in the process that renders.
        settings: Camera, image and seed.
        cameras: Of view sets: common frame to the axes of each camera, shape (V, 3, 3).
    """

    source: MeshSource
    renderer: Renderer | str
    settings: StoreSettings
    cameras: np.ndarray | None = None
    _last: tuple[MeshItem, RenderMesh] | None = None

    def mesh(self, item: MeshItem) -> RenderMesh:
        """Load and prepare a mesh; the last one is kept for the next chunk of the same object."""
        if self._last is None or self._last[0] != item:
            from i2i.rendering.mesh import prepare_mesh

            loaded = self.source.load(item)
            self._last = (item, prepare_mesh(loaded, up_axis=self.source.up_axis))
        return self._last[1]

    def render(self, chunk: Chunk) -> str | None:
        """Render one chunk into its file.

        Returns:
            None, or why the mesh cannot be used.
        """
        try:
            mesh = self.mesh(chunk.item)
        except (MeshError, ValueError, OSError) as error:
            # A broken file is a reason to skip it; a full disk or a programming error is not.
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EMFILE):
                raise
            return (
                str(error) if isinstance(error, MeshError) else f"{type(error).__name__}: {error}"
            )
        rotations = np.stack([view_rotation(**address) for address in self._addresses(chunk)])
        try:
            content = self._rows(mesh, rotations, chunk)
        except MeshError as error:  # a view that shows hardly anything of the object
            return str(error)
        write_chunk(chunk, ChunkData(content, rotations, mesh.object_from_mesh))
        return None

    def _addresses(self, chunk: Chunk) -> list[dict[str, Any]]:
        """What the random numbers of each view depend on."""
        return [
            {
                "dataset": self.settings.source,
                "split": chunk.split,
                "class_name": chunk.item.class_name,
                "instance_id": chunk.item.instance_id,
                "view": view,
                "seed": self.settings.seed,
            }
            for view in range(chunk.start, chunk.stop)
        ]

    def _rows(self, mesh: RenderMesh, rotations: np.ndarray, chunk: Chunk) -> np.ndarray:
        """Main array of the views: images, clouds or view sets.

        Raises:
            MeshError: if a partial cloud has hardly a point.
        """
        settings = self.settings
        camera = Camera(distance=settings.camera_distance, fov_deg=settings.camera_fov_deg)
        drawing: dict[str, Any] = {"camera": camera, "image_size": settings.image_size}
        if settings.num_points is not None:
            if settings.modality == "partial_points":
                return visible_clouds(
                    self._renderer(), mesh, rotations, num_points=settings.num_points, **drawing
                )
            seeds = [surface_seed(**address) for address in self._addresses(chunk)]
            return surface_clouds(mesh, rotations, seeds=seeds, num_points=settings.num_points)
        if self.cameras is not None:
            return view_sets(self._renderer(), mesh, rotations, cameras=self.cameras, **drawing)
        return self._renderer().render(mesh, rotations, modality=settings.modality, **drawing)

    def _renderer(self) -> Renderer:
        if isinstance(self.renderer, str):
            from i2i.rendering.base import get_renderer

            self.renderer = get_renderer(self.renderer)
        return self.renderer


def chunk_tag(settings: StoreSettings, item: MeshItem, fingerprint: str) -> str:
    """Hash of settings and mesh: a chunk file with another one is of no use."""
    parts = [settings.told(), item.class_name, item.instance_id, fingerprint]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def write_chunk(chunk: Chunk, data: ChunkData) -> None:
    """Write a chunk file so that it is either whole or absent."""
    chunk.path.parent.mkdir(parents=True, exist_ok=True)
    temporary = chunk.path.with_name(f".{chunk.path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            np.savez(stream, tag=np.array(chunk.tag), **_arrays(data))
        os.replace(temporary, chunk.path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _arrays(data: ChunkData) -> dict[str, np.ndarray]:
    """Fields of a chunk by name, without copying."""
    return {name: getattr(data, name) for name in ChunkData.__dataclass_fields__}


def read_chunk(chunk: Chunk) -> ChunkData | None:
    """Contents of a chunk file; None if it is absent, damaged, or of other settings or meshes."""
    try:
        # The zip container has a CRC for each array, so a damaged file is noticed here.
        with np.load(chunk.path) as stored:
            if str(stored["tag"]) != chunk.tag:
                return None
            return ChunkData(**{name: stored[name] for name in ChunkData.__dataclass_fields__})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def has_chunk(chunk: Chunk) -> bool:
    """Whether a chunk file is there, of these settings and this mesh; its pixels are not read."""
    try:
        with np.load(chunk.path) as stored:
            return str(stored["tag"]) == chunk.tag
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return False


def render_chunks(
    context: RenderContext, chunks: list[Chunk], *, num_workers: int
) -> Generator[tuple[Chunk, str | None], None, None]:
    """Render chunks; the files do not depend on the number of processes or on their order.

    Args:
        context: What every task needs.
        chunks: The tasks.
        num_workers: Processes; 0 or 1 for this process.

    Yields:
        Each chunk when it is finished, with None or why its mesh cannot be used.
    """
    workers = min(num_workers, len(chunks))
    if workers <= 1:
        for chunk in chunks:
            yield chunk, context.render(chunk)
        return
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start_worker, (context,)
    )
    try:
        with _light_start(context):
            futures = {pool.submit(_render_in_worker, chunk): chunk for chunk in chunks}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_CONTEXT: RenderContext | None = None


def _start_worker(context: RenderContext) -> None:
    """Set up a worker process."""
    global _CONTEXT
    _CONTEXT = context
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """End this worker when its parent is killed; else it would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _render_in_worker(chunk: Chunk) -> str | None:
    assert _CONTEXT is not None
    return _CONTEXT.render(chunk)


@contextlib.contextmanager
def _light_start(context: RenderContext) -> Iterator[None]:
    """Let worker processes start without importing the main program and with one thread each.

    A spawned process imports the parent's main module, which may pull in torch and Lightning; that
    takes longer than rendering a small data set.
    """
    needs_main = "__main__" in (type(context.source).__module__, type(context.renderer).__module__)
    main = sys.modules["__main__"]
    threads = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    os.environ.update(dict.fromkeys(threads, "1"))
    if not needs_main:
        sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        for name, value in threads.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
