"""Re-rendering a class's reference mesh in given orientations, as the network's camera sees it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from i2i.data.info import DataInfo
from i2i.geometry.cameras import Camera
from i2i.rendering.base import CHANNELS, MODALITIES, get_renderer
from i2i.rendering.mesh import RenderMesh
from i2i.viz.style import ImageArray, to_numpy


def rerender(
    mesh: RenderMesh | None,
    rotations: ImageArray,
    *,
    info: DataInfo,
    image_size: int | None = None,
    renderer: str = "embree",
) -> np.ndarray:
    """Render one mesh in several orientations.

    Args:
        mesh: The mesh; with None the pictures are left blank.
        rotations: Object → camera, shape (N, 3, 3).
        info: Modality, camera and background of the training images.
        image_size: Height and width in pixels; the training images' if None.
        renderer: Name of the renderer; the default one needs no system library.

    Returns:
        Shape (N, C, S, S), float32 in [0, 1].
    """
    turns = to_numpy(rotations).astype(np.float64).reshape(-1, 3, 3)
    size = info.image_size if image_size is None else image_size
    modality = drawn_modality(info)
    blank = np.full((len(turns), CHANNELS[modality], size, size), info.background, np.float32)
    # A diverged network predicts what no renderer can draw: such a picture stays blank.
    drawable = np.isfinite(turns).all(axis=(1, 2))
    if mesh is None or not drawable.any():
        return blank
    pixels = get_renderer(renderer).render(
        mesh,
        _nearest_rotations(turns[drawable]),
        camera=Camera(distance=info.camera_distance, fov_deg=info.camera_fov_deg),
        image_size=size,
        modality=modality,
    )
    blank[drawable] = pixels.astype(np.float32) / 255.0
    return blank


def rerender_each(
    meshes: Sequence[RenderMesh | None],
    rotations: ImageArray,
    *,
    info: DataInfo,
    image_size: int | None = None,
    renderer: str = "embree",
) -> np.ndarray:
    """Render the n-th mesh in the n-th orientation; see `rerender`.

    Returns:
        Shape (N, C, S, S), float32 in [0, 1].
    """
    turns = to_numpy(rotations).reshape(-1, 3, 3)
    if len(meshes) != len(turns):
        raise ValueError(f"Got {len(meshes)} meshes for {len(turns)} orientations.")
    groups: dict[int, list[int]] = {}
    for index, mesh in enumerate(meshes):
        groups.setdefault(id(mesh), []).append(index)  # one scene is built for each mesh
    size = info.image_size if image_size is None else image_size
    shape = (len(turns), CHANNELS[drawn_modality(info)], size, size)
    pictures = np.empty(shape, dtype=np.float32)
    for members in groups.values():
        pictures[members] = rerender(
            meshes[members[0]], turns[members], info=info, image_size=size, renderer=renderer
        )
    return pictures


def drawn_modality(info: DataInfo) -> str:
    """Modality of the pictures of a mesh: the network's own, or gray where it sees no image."""
    return info.modality if info.modality in MODALITIES else "gray"


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Rotations nearest to (N, 3, 3) matrices, not quite orthonormal in half precision."""
    left, _, right = np.linalg.svd(matrices)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    return left @ right
