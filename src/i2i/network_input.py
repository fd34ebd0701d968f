"""From a user's picture or cloud to what a network gets, one by one or ahead of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import numpy as np
from torch import Tensor

from i2i.data.info import DataInfo
from i2i.data.photographs import prepare_photograph
from i2i.data.pictures import Picture
from i2i.data.point_files import Cloud, prepare_cloud
from i2i.errors import ConfigurationError
from i2i.geometry.cameras import Camera

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Seen:
    """What the network gets (without the class), and what was done to it.

    Attributes:
        batch: `image` (1, C, S, S) or `points` (1, P, 3).
        crop_box: (x0, y0, x1, y1) in pixels of the picture; None for a cloud.
        warnings: Sentences for the user.
        camera_from_crop: Shape (3, 3), see `i2i.data.photographs.PreparedImage`.
    """

    batch: dict[str, Tensor]
    crop_box: tuple[float, float, float, float] | None
    warnings: tuple[str, ...]
    camera_from_crop: np.ndarray


def see(
    image: Picture | Cloud,
    info: DataInfo,
    *,
    mask: Picture | None = None,
    box: Sequence[float] | None = None,
    intrinsics: Sequence[float] | None = None,
    margin: float = 1.0,
    axes: str = "opengl",
) -> Seen:
    """A picture or a cloud as a network wants it.

    Args:
        image: See `i2i.predictor.Predictor.predict`, as the other arguments.
        info: What the network was trained on.
        mask: White on the object.
        box: Around the object.
        intrinsics: Of the camera.
        margin: Factor on the side of the crop.
        axes: Camera axes of a cloud.

    Raises:
        ImageError: if it cannot be read, or mask, box or intrinsics do not fit it.
        ConfigurationError: if what is meant for pictures was given with a cloud, or the other way
            round, or the network looks at several views.
    """
    if info.num_points is not None:
        given = {"mask": mask, "box": box, "intrinsics": intrinsics,
                 "margin": None if margin == 1 else margin}  # fmt: skip
        wrong = [name for name, value in given.items() if value is not None]
        if wrong:
            raise ConfigurationError(
                f"{wrong[0]}= is for pictures, and this network sees {info.modality}: "
                "give the points of the object alone"
            )
        points = prepare_cloud(image, num_points=info.num_points, axes=axes)  # type: ignore[arg-type]
        return Seen({"points": points}, None, (), np.eye(3))
    if axes != "opengl":
        raise ConfigurationError(
            f"axes={axes} is for clouds, and this network sees {info.modality}: leave it out"
        )
    if info.num_views is not None:
        raise ConfigurationError(
            f"This network looks at {info.num_views} views of one object at once, from "
            "fixed cameras around it: it cannot answer for a single picture. Use a run with "
            "data.modality=gray | depth | rgb."
        )
    prepared = prepare_photograph(
        image, channels=info.channels, image_size=info.image_size,  # type: ignore[arg-type]
        background=info.background, mask=mask, box=box, intrinsics=intrinsics, margin=margin,
        camera=Camera(distance=info.camera_distance, fov_deg=info.camera_fov_deg),
    )  # fmt: skip
    return Seen(
        {"image": prepared.tensor}, prepared.crop_box,
        (*prepared.warnings, *_modality_warnings(info)), prepared.camera_from_crop,
    )  # fmt: skip


def _modality_warnings(info: DataInfo) -> tuple[str, ...]:
    if info.modality != "depth":
        return ()
    return (
        "The network was trained on depth images (near white, far black, background white), "
        "not on photographs: give such a depth image.",
    )


def in_batches(
    make: Callable[[_Item], _Made], items: Iterable[_Item], *, workers: int, size: int, lead: int
) -> Iterator[list[Future[_Made]]]:
    """What a function makes of items, in their order, made in threads.

    Args:
        make: Called with each item.
        items: Taken a batch at a time.
        workers: Threads.
        size: Items of a batch.
        lead: Batches that are being made while one is handed out.

    Yields:
        Futures that are done: `result()` gives what was made, or raises what `make` raised.
    """
    pool = ThreadPoolExecutor(workers)
    waiting: deque[list[Future[_Made]]] = deque()
    rest = iter(items)
    try:
        while some := list(islice(rest, size)):
            waiting.append([pool.submit(make, item) for item in some])
            if len(waiting) > lead:
                yield _done(waiting.popleft())
        while waiting:
            yield _done(waiting.popleft())
    finally:  # also where nobody asks any more
        pool.shutdown(wait=False, cancel_futures=True)


def _done(batch: list[Future[_Made]]) -> list[Future[_Made]]:
    wait(batch)
    return batch
