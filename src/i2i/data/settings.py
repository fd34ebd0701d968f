"""The settings of a store, put together from a source, a renderer and what a row holds."""

from __future__ import annotations

import contextlib

from i2i.data.content import check_content
from i2i.data.rows import SURFACE_SAMPLER
from i2i.data.sources.base import MeshSource
from i2i.data.store import StoreSettings
from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering.base import Renderer, canonical_name, get_renderer


def store_settings(
    source: MeshSource,
    *,
    renderer: Renderer | str,
    camera: Camera,
    modality: str,
    image_size: int,
    seed: int,
    num_points: int | None = None,
    camera_set: str | None = None,
    cloud_image_size: int = 128,
) -> StoreSettings:
    """Settings of the stores that a source, a renderer and a camera make.

    Args:
        source: Where the meshes come from.
        renderer: Name of a renderer, or one; whole clouds need none.
        camera: The camera.
        modality: A key of `i2i.data.info.CHANNELS`.
        image_size: Height and width of images and views in pixels; clouds do not depend on it.
        seed: Seed of the views.
        num_points: Points of a cloud; for clouds only.
        camera_set: Name of a camera set of `i2i.geometry.view_sets`; for views only.
        cloud_image_size: Height and width of the depth image behind a partial cloud.

    Raises:
        ValueError: if one of them is not allowed.
    """
    sizes = {"partial_points": cloud_image_size, "full_points": 0}
    size = sizes.get(modality, image_size)
    drawn = modality != "full_points"
    check_content(
        modality, image_size=size if drawn else 1, num_points=num_points, camera_set=camera_set
    )
    name, version = _renderer_name(renderer) if drawn else SURFACE_SAMPLER
    return StoreSettings(
        source=source.name,
        up_axis=source.up_axis,
        renderer=name,
        renderer_version=version,
        camera_distance=float(camera.distance),
        camera_fov_deg=float(camera.fov_deg),
        modality=modality,
        image_size=size,
        seed=seed,
        num_points=num_points,
        camera_set=camera_set,
    )


def _renderer_name(renderer: Renderer | str) -> tuple[str, str | None]:
    """Name of a renderer with its options, and its version if it is installed."""
    name = canonical_name(renderer) if isinstance(renderer, str) else renderer.name
    version = None
    # A finished store can be used where its renderer is not installed.
    with contextlib.suppress(RendererUnavailableError):
        instance = get_renderer(renderer) if isinstance(renderer, str) else renderer
        version = instance.version
    return name, version
