"""Point clouds from files, as the cloud networks want them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
import trimesh
from torch import Tensor

from i2i.errors import ImageError
from i2i.geometry.points import farthest_point_sample, normalize_points

SUFFIXES = (".ply", ".xyz", ".npy", ".npz")
AXES = {"opengl": np.eye(3), "opencv": np.diag([1.0, -1.0, -1.0])}
"""Camera axes of a file -> ours (x right, y up, z to the viewer)."""

_FEWEST = 32  # points that still have a shape
_MOST = 20_000  # points that farthest-point sampling looks at

Cloud = str | os.PathLike[str] | np.ndarray


def read_points(source: Cloud) -> np.ndarray:
    """Points of a file or an array, shape (N, 3), float64.

    Args:
        source: A .ply, .xyz, .npy (N, 3 or more columns) or .npz (its entry `points`) file, or an
            array.

    Raises:
        ImageError: if there is no such file, or it holds no points.
    """
    name = "the array" if isinstance(source, np.ndarray) else str(source)
    try:
        points = np.asarray(source if isinstance(source, np.ndarray) else _load(Path(source)))
    except FileNotFoundError:
        raise ImageError(
            f"input={name}: no such file; give a cloud, {', '.join(SUFFIXES)}"
        ) from None
    except (OSError, EOFError, BadZipFile, ValueError, KeyError, IndexError) as error:
        raise ImageError(
            f"input={name} cannot be read as points ({type(error).__name__}: {error}); "
            f"give {', '.join(SUFFIXES)}"
        ) from error
    if points.ndim != 2 or points.shape[1] < 3 or not np.issubdtype(points.dtype, np.number):
        raise ImageError(f"{name} has shape {points.shape}; a cloud is (N, 3), one point a row")
    points = points[:, :3].astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]  # depth cameras mark what they miss with NaN
    if len(points) < _FEWEST:
        raise ImageError(f"{name} has {len(points)} finite points; give at least {_FEWEST}")
    if np.ptp(points, axis=0).max() == 0:
        raise ImageError(f"all {len(points)} points of {name} are the same point")
    return points


def prepare_cloud(source: Cloud, *, num_points: int, axes: str = "opengl") -> Tensor:
    """Points of an object alone as a network's input: sampled, centred and scaled.

    Args:
        source: See `read_points`; in the axes of the camera that saw it.
        num_points: Points P that the network was trained with.
        axes: Camera axes of the file: `"opengl"` (x right, y up, z to the viewer) or `"opencv"`
            (x right, y down, z away from the viewer).

    Returns:
        Shape (1, P, 3), float32, largest norm 1, in axes x right, y up, z to the viewer.

    Raises:
        ImageError: if there are no points.
        ValueError: if the axes are unknown.
    """
    if axes not in AXES:
        raise ValueError(f"axes={axes!r} is not known: choose one of {', '.join(AXES)}")
    points = read_points(source)
    if len(points) > _MOST:  # a fixed choice, so that the same file gives the same answer
        points = points[np.random.default_rng(0).choice(len(points), _MOST, replace=False)]
    cloud = torch.from_numpy(points @ AXES[axes].T)[None]
    cloud = cloud - cloud.mean(dim=1, keepdim=True)  # before float32: far clouds keep their digits
    order = farthest_point_sample(cloud, min(num_points, len(points)))[0]
    order = order.repeat(-(-num_points // len(order)))[:num_points]
    return normalize_points(cloud[:, order]).float()


def _load(path: Path) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return np.asarray(np.load(path, allow_pickle=False))
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as stored:
            return np.asarray(stored["points"])
    if suffix == ".xyz":
        return np.loadtxt(path, ndmin=2)
    if suffix != ".ply":
        raise ValueError(f"{suffix or 'no suffix'} is not a cloud's")
    with path.open("rb") as stream:
        loaded: Any = trimesh.load(stream, file_type="ply", process=False)
    return np.asarray(getattr(loaded, "vertices", np.empty((0, 3))))  # a file without any: a scene
