"""A mesh source and a renderer that take no time, importable in worker processes."""

import os
import signal
from pathlib import Path

import numpy as np
import trimesh

from i2i.data.sources.base import MeshItem, MeshSource
from i2i.errors import MeshError


class FakeSource(MeshSource):
    """Boxes: `counts` objects of each class, some of them broken."""

    name = "fake"
    up_axis = "z"
    licence = "CC0"

    def __init__(self, counts=None, *, broken=(), official=False, kill_at=None, root=None):
        self.counts = counts or {"box": 5, "can": 4}
        self.classes = tuple(self.counts)
        self.symmetry = {name: "z" if name == "can" else "none" for name in self.classes}
        self.broken = set(broken)
        self.official = official
        self.kill_at = kill_at
        self.root = root

    def items(self, classes):
        return [self._item(name, number) for name in classes for number in range(self.counts[name])]

    def _item(self, name, number):
        last = number == self.counts[name] - 1
        split = ("test" if last else "train") if self.official else None
        instance = f"{name}_{number:02d}"
        ref = str(Path(self.root) / f"{instance}.off") if self.root else f"fake:{instance}"
        return MeshItem(name, instance, split, instance, ref, "CC0", "nobody")

    def load(self, item):
        if self.kill_at == item.instance_id:
            # In a pool the parent is what a user's kill -9 hits.
            os.kill(os.getppid() if _in_worker() else os.getpid(), signal.SIGKILL)
            if _in_worker():
                signal.pause()
        if item.instance_id in self.broken:
            raise MeshError(f"{item.ref} holds no faces")
        number = int(item.instance_id.split("_")[1])
        return trimesh.creation.box(extents=(1.0, 2.0 + number, 3.0))


class FakeRenderer:
    """Pictures that are a function of mesh and rotation alone."""

    name = "fake"

    def __init__(self, version="1", modality_channels=1):
        self.version = version

    def render(self, mesh, rotations, *, camera, image_size, modality):
        channels = 3 if modality == "rgb" else 1
        seeds = np.rint((rotations.reshape(len(rotations), 9) + 2) * 1e6).astype(np.uint64)
        pattern = np.arange(channels * image_size**2, dtype=np.uint64)
        weights = np.arange(1, 10, dtype=np.uint64) * np.uint64(2654435761)
        mixed = (
            (seeds @ weights)[:, None]
            + pattern * np.uint64(40503)
            + np.uint64(int(abs(mesh.vertices).sum() * 1000))
        )
        pixels = (mixed >> np.uint64(7)) % np.uint64(251)
        return pixels.astype(np.uint8).reshape(len(rotations), channels, image_size, image_size)

    def depth(self, mesh, rotations, *, camera, image_size):
        pixels = self.render(
            mesh, rotations, camera=camera, image_size=image_size, modality="depth"
        )[:, 0]
        return np.where(pixels < 120, camera.distance - 1 + pixels / 120, 0).astype(np.float32)


def _in_worker():
    import multiprocessing

    return multiprocessing.parent_process() is not None


def folder_bytes(root):
    """Contents of every visible file below a folder."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(Path(root).rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(root).parts)
    }
