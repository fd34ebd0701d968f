"""Making the rows of clouds and view sets: for each rotation, what is stored beside it.

This module stays free of torch until a cloud is asked for: processes that render pictures should
start quickly.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from i2i.data.content import SMALLEST_CLOUD
from i2i.errors import MeshError
from i2i.geometry.cameras import Camera
from i2i.geometry.seeding import uniform_hash

if TYPE_CHECKING:
    from i2i.rendering.base import Renderer
    from i2i.rendering.mesh import RenderMesh

SURFACE_SAMPLER = ("surface", "1")
"""Name and version that stand for the renderer of whole clouds; raise it when points change."""


def visible_clouds(
    renderer: Renderer,
    mesh: RenderMesh,
    rotations: NDArray[np.float64],
    *,
    camera: Camera,
    image_size: int,
    num_points: int,
) -> NDArray[np.float32]:
    """Partial clouds: farthest points among those that the pixels of a depth image show.

    Where fewer pixels than ``num_points`` show the object, their order repeats.

    Args:
        renderer: Draws the depth images.
        mesh: In the object frame.
        rotations: Object to camera, shape (N, 3, 3).
        camera: The camera.
        image_size: Height and width of the depth images in pixels.
        num_points: Points of a cloud, P.

    Returns:
        Shape (N, P, 3), float32, in camera axes with the origin at the object's centre.

    Raises:
        MeshError: if hardly a pixel shows the object.
    """
    depth = renderer.depth(mesh, rotations, camera=camera, image_size=image_size)
    clouds = np.empty((len(rotations), num_points, 3), np.float32)
    for cloud, ray_length in zip(clouds, depth, strict=True):
        visible = camera.unproject(ray_length)[ray_length > 0].astype(np.float32)
        if len(visible) < SMALLEST_CLOUD:
            raise MeshError(
                f"{len(visible) or 'no'} pixels of the {image_size} px depth image show the mesh: "
                "its parts are too thin; give a larger data.cloud_image_size"
            )
        cloud[:] = visible[_farthest(visible, num_points)]
    return clouds


def _farthest(points: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Indices of ``count`` farthest points of (N, 3), beginning again if there are fewer."""
    import torch

    from i2i.geometry.points import farthest_point_sample

    there = min(count, len(points))
    order = farthest_point_sample(torch.from_numpy(points)[None], there)[0].numpy()
    return order[np.arange(count) % there]


def surface_clouds(
    mesh: RenderMesh,
    rotations: NDArray[np.float64],
    *,
    seeds: list[int],
    num_points: int,
) -> NDArray[np.float32]:
    """Whole clouds: points uniform by area on the surface, inner parts too, then turned.

    Args:
        mesh: In the object frame.
        rotations: Object to camera, shape (N, 3, 3).
        seeds: Seed of the points of each cloud, N (see `surface_seed`).
        num_points: Points of a cloud, P.

    Returns:
        Shape (N, P, 3), float32, in camera axes with the origin at the object's centre.
    """
    from i2i.geometry.points import sample_surface

    clouds = np.empty((len(rotations), num_points, 3), np.float32)
    for cloud, rotation, seed in zip(clouds, rotations, seeds, strict=True):
        uniforms = uniform_hash(seed, np.arange(num_points)[:, None], np.arange(3))
        cloud[:] = sample_surface(mesh.vertices, mesh.faces, uniforms) @ rotation.T
    return clouds


def surface_seed(
    dataset: str, split: str, class_name: str, instance_id: str, view: int, seed: int
) -> int:
    """Seed of the points of one whole cloud; the address is that of `view_rotation`."""
    address = ["surface", dataset, split, class_name, str(instance_id), view, seed]
    digest = hashlib.sha256(json.dumps(address, default=int).encode()).digest()
    return int.from_bytes(digest[:8], "little")


def view_sets(
    renderer: Renderer,
    mesh: RenderMesh,
    rotations: NDArray[np.float64],
    *,
    camera: Camera,
    image_size: int,
    cameras: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Gray views of the object from every camera of a set that surrounds it.

    Args:
        renderer: Draws the views.
        mesh: In the object frame.
        rotations: Object to the common frame of the set, shape (N, 3, 3).
        camera: Distance and field of view of each camera.
        image_size: Height and width of a view in pixels.
        cameras: Common frame to the axes of each camera, shape (V, 3, 3).

    Returns:
        Shape (N, V, 1, S, S), uint8; view v shows the object in ``cameras[v] @ rotation``.
    """
    turned = cameras @ rotations[:, None]  # (N, V, 3, 3)
    pictures = renderer.render(
        mesh, turned.reshape(-1, 3, 3), camera=camera, image_size=image_size, modality="gray"
    )
    return pictures.reshape(*turned.shape[:2], *pictures.shape[1:])
