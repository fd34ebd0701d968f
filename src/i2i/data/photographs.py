"""A user's picture turned into the network's input: cut out, squared, scaled as in training.

The scale rule: training images hold the unit sphere that the object was normalised to, and that
sphere's silhouette covers ``1 / (sqrt(d² − 1) · tan(fov / 2))`` of the half-width, 79.4 % for the
paper's camera. Where the object's outline is known (alpha, mask or box), the crop is centred on
the outline's smallest enclosing circle and sized so that this circle covers as much of the
half-width as the outline of an object typically does in training: 0.86 of the sphere's silhouette
(`TYPICAL_OUTLINE`), so 68 % of the half-width; ``margin`` scales the crop. The circle, unlike a
bounding box, does not change when the picture is turned. Where no outline is known, the picture is
taken as it is, squared and padded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from scipy.spatial import ConvexHull

from i2i.data.pictures import Picture, read_mask, read_picture
from i2i.errors import ImageError
from i2i.geometry.cameras import Camera, crop_rotation

TYPICAL_OUTLINE = 0.86
"""Radius of an outline's enclosing circle over that of the unit sphere's silhouette: the median
over 550 random views of the eleven synthetic classes (medians of the classes: 0.69 to 0.96)."""

_BORDER_TOLERANCE = 0.08  # JPEG noise on a plain background stays below this
_BORDER_SHARE = 0.02  # of the border's pixels may differ, such as a speck of dust


@dataclass(frozen=True)
class PreparedImage:
    """A picture ready for a network, and what was done to it.

    Attributes:
        tensor: Shape (1, C, S, S), float32 in [0, 1], row down, padded with the background.
        crop_box: (x0, y0, x1, y1) in pixels of the upright picture; may reach beyond its edges.
        warnings: Plain sentences for the user; empty if nothing looked wrong.
        camera_from_crop: Shape (3, 3), float64. Turns directions of the crop's own camera, which
            looks at the crop's centre, into the real camera's; the identity without intrinsics.
    """

    tensor: torch.Tensor
    crop_box: tuple[float, float, float, float]
    warnings: tuple[str, ...]
    camera_from_crop: np.ndarray


def prepare_photograph(
    picture: Picture,
    *,
    channels: int,
    image_size: int,
    background: float = 1.0,
    mask: Picture | None = None,
    box: Sequence[float] | None = None,
    intrinsics: Sequence[float] | None = None,
    margin: float = 1.0,
    camera: Camera | None = None,
) -> PreparedImage:
    """Turn a picture into a network's input (see the module's docstring for the scale rule).

    Pixel coordinates are continuous, x right and y down, with pixel centres at i + ½.

    Args:
        picture: Path, PIL image, or array (H, W), (H, W, 1 | 3 | 4), uint8 or float in [0, 1].
            A photograph that carries an EXIF orientation is put upright first.
        channels: The network's image channels; 1 takes the mean of red, green and blue, as the
            gray training images do.
        image_size: The network's image size S in pixels.
        background: Value of a background pixel in training, in [0, 1].
        mask: Picture of the same size that is non-zero on the object.
        box: (x0, y0, x1, y1) around the object; what lies outside becomes background.
        intrinsics: (fx, fy, cx, cy) of the real camera in pixels of the upright picture.
        margin: Factor on the side of the crop; above 1 the object becomes smaller.
        camera: The training camera; the paper's if None.

    Returns:
        The prepared picture.

    Raises:
        ImageError: if a picture cannot be read, or mask, box or intrinsics do not fit it.
    """
    warnings: list[str] = []
    if margin <= 0:
        raise ImageError(f"margin={margin} was given; it must be positive, such as margin=1.1.")
    color, alpha = read_picture(picture, what="image", warnings=warnings)
    region = None if box is None else _box_region(box, shape=alpha.shape)
    given_mask = None if mask is None else read_mask(mask, shape=alpha.shape)

    cut_out = given_mask is not None or bool(alpha.min() < 1.0)
    coverage = alpha if given_mask is None else alpha * given_mask
    coverage = coverage if region is None else coverage * region
    composited = color
    if cut_out or region is not None:
        composited = coverage[..., None] * color + (1.0 - coverage[..., None]) * background

    if cut_out or region is not None:
        crop_box = _object_crop(
            _outline_circle(coverage, is_box=not cut_out, warnings=warnings),
            fill=TYPICAL_OUTLINE * (camera or Camera()).ball_radius() / margin,
        )
    else:
        crop_box = _whole_crop(alpha.shape, margin=margin)
    if composited.strides[2] == 0:  # a gray picture: all channels are one
        composited = composited[..., :1]
    if not cut_out:
        inside = composited if region is None else _crop_to(composited, region)
        warnings += _border_warnings(inside, background=background)
    if crop_box[2] - crop_box[0] < 0.5 * image_size:
        warnings.append(
            f"The crop is only {crop_box[2] - crop_box[0]:.0f} px wide and is enlarged to "
            f"{image_size} px: use a picture in which the object is larger."
        )
    pixels = _resample(
        _to_channels(composited, channels=channels), crop_box,
        image_size=image_size, background=background,
    )  # fmt: skip
    return PreparedImage(
        tensor=torch.from_numpy(pixels).clamp(0.0, 1.0)[None],
        crop_box=crop_box,
        warnings=tuple(warnings),
        camera_from_crop=_camera_from_crop(intrinsics, crop_box=crop_box),
    )


def enclosing_circle(points: np.ndarray) -> tuple[float, float, float]:
    """Smallest circle around points in the plane, by Welzl's incremental construction.

    Args:
        points: Shape (N, 2), not all on one line.

    Returns:
        Centre x, centre y and radius, in the unit of the points.
    """
    hull = points[ConvexHull(points).vertices].astype(np.float64)
    hull = hull[np.random.default_rng(0).permutation(len(hull))]  # expected linear time
    center, radius = hull[0], 0.0

    def outside(point: np.ndarray) -> bool:
        return bool(np.linalg.norm(point - center) > radius * (1 + 1e-9) + 1e-9)

    for i, first in enumerate(hull):
        if not outside(first):
            continue
        center, radius = first, 0.0
        for j, second in enumerate(hull[:i]):
            if not outside(second):
                continue
            center = (first + second) / 2
            radius = float(np.linalg.norm(first - second)) / 2
            for third in hull[:j]:
                if outside(third):
                    center = _circumcenter(first, second, third)
                    radius = float(np.linalg.norm(first - center))
    return float(center[0]), float(center[1]), radius


def _circumcenter(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Centre of the circle through three points of the plane."""
    edges = np.stack([second - first, third - first])
    return first + np.linalg.solve(2 * edges, (edges**2).sum(axis=1))


# --- cropping --------------------------------------------------------------------------------


def _box_region(box: Sequence[float], *, shape: tuple[int, ...]) -> np.ndarray:
    """One inside the box, zero outside, (H, W)."""
    height, width = shape
    if len(box) != 4:
        raise ImageError(f"box={list(box)} has {len(box)} numbers; give box=[x0,y0,x1,y1].")
    x0, y0, x1, y1 = (round(float(value)) for value in box)
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    if x1 - x0 < 2 or y1 - y0 < 2:
        raise ImageError(
            f"box={list(box)} covers nothing of the picture, which has {width}×{height} px. "
            "Give box=[x0,y0,x1,y1] with x0 < x1 and y0 < y1, in pixels from the top left."
        )
    region = np.zeros(shape, dtype=np.float32)
    region[y0:y1, x0:x1] = 1.0
    return region


def _outline_circle(
    coverage: np.ndarray, *, is_box: bool, warnings: list[str]
) -> tuple[float, float, float]:
    """Centre x, y and radius, in pixels, of the object that covers the non-zero pixels."""
    rows, columns = np.nonzero(coverage > 0.5)
    if rows.size == 0:
        raise ImageError(
            "Nothing of the picture is left after alpha, mask and box were applied: at least one "
            "of them is transparent or empty where the others are not."
        )
    x0, x1, y0, y1 = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    height, width = coverage.shape
    if is_box:  # the object touches the box's sides, so its longer side is about the diameter
        return (x0 + x1) / 2, (y0 + y1) / 2, max(x1 - x0, y1 - y0) / 2
    if x0 == 0 or y0 == 0 or x1 == width or y1 == height:
        warnings.append(
            "The object touches the edge of the picture: if it is cut off, its size and its "
            "centre are guessed wrongly."
        )
    corners = [np.stack([columns + i, rows + j], axis=1) for i in (0, 1) for j in (0, 1)]
    return enclosing_circle(np.concatenate(corners))


def _object_crop(
    circle: tuple[float, float, float], *, fill: float
) -> tuple[float, float, float, float]:
    """Square in which the circle covers ``fill`` of the half-width."""
    x, y, radius = circle
    half = radius / fill
    return x - half, y - half, x + half, y + half


def _whole_crop(shape: tuple[int, ...], *, margin: float) -> tuple[float, float, float, float]:
    """Square around the whole picture."""
    height, width = shape
    half = margin * max(height, width) / 2
    return width / 2 - half, height / 2 - half, width / 2 + half, height / 2 + half


def _crop_to(pixels: np.ndarray, region: np.ndarray) -> np.ndarray:
    """The rectangle of ``pixels`` in which ``region`` is one."""
    rows, columns = np.nonzero(region)
    return pixels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def _border_warnings(pixels: np.ndarray, *, background: float) -> list[str]:
    """Compare the picture's border with the background that the network was trained on."""
    width = max(1, round(0.01 * min(pixels.shape[:2])))
    inner = pixels[width:-width]
    sides = (pixels[:width], pixels[-width:], inner[:, :width], inner[:, -width:])
    values = np.concatenate([side.reshape(-1, pixels.shape[2]) for side in sides])
    typical = np.broadcast_to(np.median(values, axis=0), 3)

    def share_off(reference: np.ndarray | float) -> float:
        return float((np.abs(values - reference).max(axis=1) > _BORDER_TOLERANCE).mean())

    if share_off(background) <= _BORDER_SHARE:
        return []
    help_text = (
        f"The network was trained on a plain background of {background:g} (0 black, 1 white): "
        "give a picture with an alpha channel, or mask=."
    )
    if share_off(typical) > _BORDER_SHARE:
        return [f"The border is not a uniform background. {help_text}"]
    shown = "/".join(f"{value:.2f}" for value in typical)
    return [f"The border is uniform, but its red/green/blue is {shown}. {help_text}"]


def _to_channels(pixels: np.ndarray, *, channels: int) -> np.ndarray:
    """Pixels (H, W, 1 | 3) as float32 (C, H, W)."""
    if channels not in (1, 3):
        raise ImageError(f"channels={channels}: photographs fit networks of 1 or 3 channels.")
    planes = pixels.transpose(2, 0, 1).astype(np.float32, copy=False)
    if len(planes) == 1:
        return np.broadcast_to(planes, (channels, *planes.shape[1:]))
    return ((planes[0] + planes[1] + planes[2]) / 3)[None] if channels == 1 else planes


def _resample(
    planes: np.ndarray,
    crop_box: tuple[float, float, float, float],
    *,
    image_size: int,
    background: float,
) -> np.ndarray:
    """Cut a square out of (C, H, W) and scale it to (C, S, S); outside is background."""
    height, width = planes.shape[1:]
    x0, y0, x1, y1 = crop_box
    left, top, right, bottom = math.floor(x0), math.floor(y0), math.ceil(x1), math.ceil(y1)
    window = planes[:, max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    padding = (
        (0, 0),
        (max(-top, 0), max(bottom - height, 0)),
        (max(-left, 0), max(right - width, 0)),
    )
    if any(map(any, padding)):
        window = np.pad(window, padding, constant_values=background)
    box = (x0 - left, y0 - top, x1 - left, y1 - top)
    # Bilinear in PIL averages over the source pixels when it shrinks, and never overshoots.
    resized = [
        Image.fromarray(np.ascontiguousarray(plane)).resize(
            (image_size, image_size), Image.Resampling.BILINEAR, box=box
        )
        for plane in window
    ]
    return np.stack([np.asarray(plane) for plane in resized])


def _camera_from_crop(
    intrinsics: Sequence[float] | None, *, crop_box: tuple[float, float, float, float]
) -> np.ndarray:
    """Rotation from the camera that looks at the crop's centre to the real camera, (3, 3)."""
    if intrinsics is None:
        return np.eye(3)
    if len(intrinsics) != 4 or not np.isfinite(intrinsics).all() or min(intrinsics[:2]) <= 0:
        raise ImageError(
            f"intrinsics={list(intrinsics)} does not fit; give [fx,fy,cx,cy] in pixels of the "
            "picture, focal lengths positive."
        )
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    center = np.array([(crop_box[0] + crop_box[2]) / 2, (crop_box[1] + crop_box[3]) / 2])
    return np.asarray(crop_rotation(center, matrix), dtype=np.float64)
