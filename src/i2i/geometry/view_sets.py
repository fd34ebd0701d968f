"""Cameras around an object that the 60 rotations of the icosahedron permute.

- ``icosahedron_12``: on the 12 corners of the icosahedron.
- ``dodecahedron_20``: on the 20 vertices of the dual dodecahedron, the middles of the faces.
- ``group_60``: one for each rotation; five stand on each corner, a turn of 72° apart.

The object is described in a frame of its own, that of `icosahedron` with a corner on +z, and camera
v shows it as ``x_camera = C_v @ x_frame`` (x right, y up, z towards the viewer). A camera looks at
the centre; where it stands fixes it up to its roll, and the roll of the first two sets is this: the
picture's up is +z of the frame as the camera sees it, or +y where the camera stands on the z axis.
The two corners on that axis are exactly on it and no other camera is within 37° of it, so the
choice never hangs on rounding.

An object turned by an element g shows camera ``perm[g, v]`` what camera v saw before, exactly for
``group_60``, up to a roll of the picture for the others.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from i2i.geometry.icosahedron import icosahedron

CAMERA_SETS = ("icosahedron_12", "dodecahedron_20", "group_60")

_NEAR_POLE = 0.99  # sine of the elevation above which a camera's up is +y of the frame


def camera_rotations(name: str) -> NDArray[np.float64]:
    """From the frame to each camera's axes: ``x_camera = C_v @ x_frame``, shape (V, 3, 3).

    The third row of C_v is the direction of camera v, so ``C_v @ d_v = +z``.

    Raises:
        ValueError: If the set is unknown.
    """
    _check(name)
    if name == "group_60":
        return icosahedron(0).rotations.mT.contiguous().numpy()
    towards = camera_directions(name).numpy()
    return np.stack([_looking_from(direction) for direction in towards])


def camera_directions(name: str) -> Tensor:
    """Unit vectors from the centre to each camera, shape (V, 3), float64.

    Raises:
        ValueError: If the set is unknown.
    """
    _check(name)
    solid = icosahedron(0)
    if name == "icosahedron_12":
        return solid.directions.clone()
    if name == "dodecahedron_20":
        middles = solid.vertices[solid.faces].mean(dim=1)
        return middles / middles.norm(dim=-1, keepdim=True)
    return solid.rotations[:, :, 2].clone()


def view_permutations(name: str) -> Tensor:
    """Number of the camera to which element g takes the place of camera v, (60, V), int64.

    ``rotations[g] @ d_v = d_perm[g, v]``; in ``group_60`` that is row g of the group's table.

    Raises:
        ValueError: If the set is unknown.
    """
    _check(name)
    solid = icosahedron(0)
    if name == "icosahedron_12":
        return solid.action.clone()
    if name == "group_60":
        return solid.multiplication.clone()
    corners = solid.faces.sort(dim=1).values
    number_of = {tuple(face): number for number, face in enumerate(corners.tolist())}
    moved = solid.action[:, corners].sort(dim=2).values  # (60, 20, 3)
    return torch.tensor([[number_of[tuple(face)] for face in row] for row in moved.tolist()])


def num_views(name: str) -> int:
    """Number V of cameras of a set.

    Raises:
        ValueError: If the set is unknown.
    """
    return len(camera_directions(name))


def _check(name: str) -> None:
    if name not in CAMERA_SETS:
        raise ValueError(f"camera set {name!r} is not one of {', '.join(CAMERA_SETS)}")


def _looking_from(towards: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation into the axes of a camera that stands in a direction, by the roll above, (3, 3)."""
    y, z = np.eye(3)[1:]
    above = y if abs(towards[2]) > _NEAR_POLE else z
    up = above - (above @ towards) * towards
    up /= np.linalg.norm(up)
    return np.stack((np.cross(up, towards), up, towards))
