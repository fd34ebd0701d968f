"""What one row of a store holds, by modality: an image, a point cloud, or a set of views.

Free of torch, since rendering processes import it; only camera sets load it, when they are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from i2i.data.info import CHANNELS, CLOUDS, VIEWS

SMALLEST_CLOUD = 8
"""Fewest points of a cloud: below it, not even a box has a point near each corner."""


@dataclass(frozen=True)
class Content:
    """The main array of a store.

    Attributes:
        name: Name of the array, and of its file without ``.npy``.
        shape: Shape of one row.
        dtype: Its type.
        pictures: Pictures that are drawn for one row.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    pictures: int = 1


def content_of(settings: Mapping[str, Any]) -> Content:
    """Main array of a store with these settings, as a card tells them."""
    modality, size = settings["modality"], settings["image_size"]
    byte = np.dtype(np.uint8)
    if modality in CLOUDS:
        return Content("points", (settings["num_points"], 3), np.dtype(np.float32))
    if modality == VIEWS:
        from i2i.geometry.view_sets import num_views

        views = num_views(settings["camera_set"])
        return Content("view_sets", (views, CHANNELS[modality], size, size), byte, pictures=views)
    return Content("images", (CHANNELS[modality], size, size), byte)


def content_notes(modality: str) -> dict[str, Any]:
    """What a card says about the values of the main array."""
    if modality in CLOUDS:
        return {"frame": "camera axes, origin at the object's centre", "unit": "object radii"}
    return {"channels": CHANNELS[modality], "background": 255}


def check_content(
    modality: str, *, image_size: int, num_points: int | None, camera_set: str | None
) -> None:
    """Check the settings that say what a row holds.

    Raises:
        ValueError: naming the setting and what is allowed.
    """
    if modality not in CHANNELS:
        raise ValueError(f"data.modality={modality} is not known. Allowed: {', '.join(CHANNELS)}.")
    if image_size < 1:
        name = "cloud_image_size" if modality in CLOUDS else "image_size"
        raise ValueError(f"data.{name}={image_size} is not allowed: give at least 1 pixel.")
    if modality in CLOUDS:
        _check_num_points(modality, num_points)
    elif num_points is not None:
        raise ValueError(
            f"data.num_points={num_points} needs data.modality={' or '.join(CLOUDS)}, but it is "
            f"{modality}: leave the number of points out."
        )
    if modality == VIEWS:
        _check_camera_set(camera_set)
    elif camera_set is not None:
        raise ValueError(
            f"data.camera_set={camera_set} needs data.modality={VIEWS}, but it is {modality}: "
            "leave the camera set out."
        )


def _check_num_points(modality: str, num_points: int | None) -> None:
    if num_points is None or num_points < SMALLEST_CLOUD:
        told = "is missing" if num_points is None else "is not allowed"
        raise ValueError(
            f"data.num_points={num_points} {told}: data.modality={modality} needs the number of "
            f"points of a cloud, at least {SMALLEST_CLOUD}, for example data.num_points=1024."
        )


def _check_camera_set(camera_set: str | None) -> None:
    from i2i.geometry.view_sets import CAMERA_SETS

    if camera_set not in CAMERA_SETS:
        told = "is missing" if camera_set is None else "is not known"
        raise ValueError(
            f"data.camera_set={camera_set} {told}: data.modality={VIEWS} needs one of "
            f"{', '.join(CAMERA_SETS)}."
        )
