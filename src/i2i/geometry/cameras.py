"""The pinhole camera of every rendered picture, and the rotation that undoes a crop.

Camera axes are OpenGL's: x right, y up, z towards the viewer, so the camera looks along −z. Pixels
are (column, row) with the row down; pixel (i, j) covers the square from i, j to i + 1, j + 1, so
its centre is at i + ½, j + ½.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Camera:
    """Square pinhole camera that looks at the object's centre from a distance.

    Points in "object-centred camera axes" are ``rotation @ x_object``: the axes are the camera's,
    the origin is the object's centre; the camera stands at (0, 0, distance).

    Attributes:
        distance: From the camera to the object's centre, in object units (the mesh fits the unit
            ball).
        fov_deg: Full field of view across the width, and across the height, in degrees.

    Example:
        >>> Camera().project([[0.0, 0.0, 0.0]], 128)
        array([[64., 64.]])
    """

    distance: float = 3.2
    fov_deg: float = 45.0

    def __post_init__(self) -> None:
        if not self.distance > 0:
            raise ValueError(f"camera distance must be positive, got {self.distance}")
        if not 0 < self.fov_deg < 180:
            raise ValueError(f"fov_deg must lie between 0 and 180 degrees, got {self.fov_deg}")

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the camera stands in object-centred camera axes, shape (3,)."""
        return np.array([0.0, 0.0, self.distance])

    def focal_px(self, image_size: int) -> float:
        """Focal length in pixels of an image ``image_size`` wide."""
        return image_size / 2 / math.tan(math.radians(self.fov_deg) / 2)

    def pixel_angle_deg(self, image_size: int) -> float:
        """Angle that one pixel in the middle of the picture spans, in degrees."""
        return 2 * math.degrees(math.atan(0.5 / self.focal_px(image_size)))

    def intrinsics(self, image_size: int) -> NDArray[np.float64]:
        """Matrix K with ``(column, row, 1) ~ K @ (x, −y, −z)`` of a point in camera axes (3, 3)."""
        focal, centre = self.focal_px(image_size), image_size / 2
        return np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1.0]])

    def rays(self, image_size: int) -> NDArray[np.float64]:
        """Unit directions through the pixel centres, in camera axes, shape (H, W, 3)."""
        offset = (np.arange(image_size) + 0.5 - image_size / 2) / self.focal_px(image_size)
        x, y = np.meshgrid(offset, -offset)
        directions = np.stack((x, y, -np.ones_like(x)), axis=-1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def project(self, points: ArrayLike, image_size: int) -> NDArray[np.float64]:
        """Pixel coordinates (column, row) of points in object-centred camera axes.

        Args:
            points: Shape (..., 3).
            image_size: Width and height in pixels.

        Returns:
            Shape (..., 2); NaN for points that are not in front of the camera.
        """
        p = np.asarray(points, dtype=np.float64) - self.position
        return project_points(p, self.intrinsics(image_size))

    def unproject(self, ray_length: ArrayLike) -> NDArray[np.float64]:
        """Points that a picture of ray lengths shows, in object-centred camera axes.

        Args:
            ray_length: Euclidean distance from the camera for each pixel, shape (..., S, S).

        Returns:
            Shape (..., S, S, 3). A ray length of 0 (background) gives the camera's own position.
        """
        depth = np.asarray(ray_length, dtype=np.float64)
        if depth.ndim < 2 or depth.shape[-1] != depth.shape[-2]:
            raise ValueError(f"unproject wants a square picture (..., S, S), got {depth.shape}")
        return self.position + depth[..., None] * self.rays(depth.shape[-1])

    def ball_radius(self) -> float:
        """Radius of the unit ball's silhouette as a fraction of half the image width (0.794)."""
        if self.distance <= 1:
            return math.inf
        half = math.tan(math.radians(self.fov_deg) / 2)
        return 1 / math.sqrt(self.distance**2 - 1) / half


def project_points(points: ArrayLike, intrinsics: ArrayLike) -> NDArray[np.float64]:
    """Pinhole projection of points given in OpenGL camera axes with the camera at the origin.

    Args:
        points: Shape (..., 3); visible ones have z < 0.
        intrinsics: K of the camera in the usual raster form, shape (3, 3).

    Returns:
        (column, row), shape (..., 2); NaN for points that are not in front of the camera.
    """
    p = np.asarray(points, dtype=np.float64) * (
        1.0,
        -1.0,
        -1.0,
    )  # to raster axes: right, down, ahead
    q = p @ np.asarray(intrinsics, dtype=np.float64).T
    ahead = q[..., 2:] > 0
    return np.where(ahead, q[..., :2] / np.where(ahead, q[..., 2:], 1.0), np.nan)


def viewing_ray(center_px: ArrayLike, intrinsics: ArrayLike) -> NDArray[np.float64]:
    """Unit direction, in OpenGL camera axes, in which a pixel looks.

    Args:
        center_px: (column, row) in continuous pixel coordinates.
        intrinsics: K, shape (3, 3).

    Returns:
        Shape (3,).

    Raises:
        ValueError: If K is not a 3×3 matrix with positive focal lengths or the pixel is not two
            numbers.
    """
    k = np.asarray(intrinsics, dtype=np.float64)
    pixel = np.asarray(center_px, dtype=np.float64)
    if k.shape != (3, 3) or not (k[0, 0] > 0 and k[1, 1] > 0) or not np.isfinite(k).all():
        raise ValueError(
            "intrinsics must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, "
            f"got {k.tolist()}"
        )
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise ValueError(f"center_px must be (column, row), got {pixel.tolist()}")
    ray = np.linalg.solve(k, np.append(pixel, 1.0)) * (1.0, -1.0, -1.0)
    return ray / np.linalg.norm(ray)


def crop_rotation(center_px: ArrayLike, intrinsics: ArrayLike) -> NDArray[np.float64]:
    """Rotation from the virtual camera that a crop is seen by to the real camera.

    A network looks at a crop as if its middle lay on the optical axis. A crop around another pixel
    is seen along a tilted ray, so what the network calls the object's rotation is meant in the axes
    of a virtual camera that looks along this ray: the real camera turned by the shortest rotation
    (no roll). The rule is::

        rotation_in_camera = crop_rotation(center_px, K) @ rotation_in_crop

    Args:
        center_px: Middle of the crop, (column, row) in pixels of the whole picture.
        intrinsics: K of the real camera for the whole picture, shape (3, 3).

    Returns:
        R_tilt with ``x_camera = R_tilt @ x_virtual``, shape (3, 3). Identity at the centre.
    """
    x, y, z = viewing_ray(center_px, intrinsics)
    # Shortest rotation from (0, 0, −1) to the ray; z < 0 always, so 1 − z never vanishes.
    h = 1 / (1 - z)
    return np.array(
        [
            [1 - h * x * x, -h * x * y, -x],
            [-h * x * y, 1 - h * y * y, -y],
            [x, y, -z],
        ]
    )
