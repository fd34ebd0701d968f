"""Cameras by pinhole projection: rays, pixels and tilted crops must agree."""

import math

import numpy as np
import pytest

from i2i.geometry.cameras import Camera, crop_rotation, project_points, viewing_ray
from i2i.geometry.rotations import random_rotations

K = np.array([[900.0, 0, 310], [0, 880, 255], [0, 0, 1]])


@pytest.mark.parametrize("size", [4, 5, 128])
def test_rays_go_through_pixel_centres(size):
    camera = Camera()
    rays = camera.rays(size)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)
    pixels = camera.project(camera.position + 2.7 * rays, size)
    columns, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    np.testing.assert_allclose(pixels[..., 0], columns)
    np.testing.assert_allclose(pixels[..., 1], rows)


def test_rows_go_down_and_columns_right():
    rays = Camera().rays(8)
    assert rays[0, 0, 0] < 0 < rays[0, 0, 1]  # top left pixel: left and up
    assert rays[-1, -1, 0] > 0 > rays[-1, -1, 1]
    assert (rays[..., 2] < 0).all()


def test_field_of_view_reaches_the_edges():
    camera = Camera(distance=2.0, fov_deg=60.0)
    edge = 2.0 * math.tan(math.radians(30))
    corners = camera.project([[edge, edge, 0], [-edge, -edge, 0], [0, 0, 0]], 100)
    np.testing.assert_allclose(corners, [[100, 0], [0, 100], [50, 50]], atol=1e-9)


def test_unit_ball_covers_its_part_of_the_picture():
    camera = Camera()
    assert camera.ball_radius() == pytest.approx(0.794, abs=5e-4)
    rays = camera.rays(512)
    closest = np.linalg.norm(np.cross(rays, camera.position), axis=-1)  # of each ray to the centre
    radius_px = math.sqrt((closest < 1).sum() / math.pi)
    assert radius_px / 256 == pytest.approx(camera.ball_radius(), abs=2e-3)


def test_pixel_angle_is_that_between_neighbours():
    rays = Camera().rays(129)
    cosine = rays[64, 64] @ rays[64, 65]
    assert Camera().pixel_angle_deg(129) == pytest.approx(math.degrees(math.acos(cosine)), rel=1e-3)


def test_unproject_inverts_ray_lengths():
    camera = Camera()
    depth = np.random.default_rng(0).uniform(2.2, 4.2, (2, 16, 16))
    points = camera.unproject(depth)
    np.testing.assert_allclose(np.linalg.norm(points - camera.position, axis=-1), depth)
    np.testing.assert_allclose(camera.project(points, 16)[1, 3, 5], [5.5, 3.5])


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(project_points([0.0, 0.0, 1.0], K)).all()


@pytest.mark.parametrize("arguments", [{"distance": 0}, {"fov_deg": 180}, {"distance": math.nan}])
def test_impossible_cameras_are_refused(arguments):
    with pytest.raises(ValueError, match="must"):
        Camera(**arguments)


# --- Crops --------------------------------------------------------------------------------------


@pytest.mark.parametrize("center", [(310, 255), (20, 40), (600, 255), (900.5, -30.0)])
def test_crop_rotation_turns_the_axis_onto_the_viewing_ray(center):
    tilt = crop_rotation(center, K)
    np.testing.assert_allclose(tilt @ tilt.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(tilt) == pytest.approx(1)
    ray = viewing_ray(center, K)
    np.testing.assert_allclose(tilt @ [0, 0, -1], ray, atol=1e-12)
    np.testing.assert_allclose(project_points(5 * ray, K), center)
    # shortest: its angle is that between the rays, so it has no roll
    angle = math.acos(np.clip((np.trace(tilt) - 1) / 2, -1, 1))
    assert angle == pytest.approx(math.acos(np.clip(-ray[2], -1, 1)), abs=1e-6)


def test_crop_at_the_principal_point_is_not_tilted():
    np.testing.assert_allclose(crop_rotation((310, 255), K), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("center", [(940, 200), (640, 620), (350, 500)])
def test_crop_rule_by_pinhole_projection(center):
    """A plain crop shows the tilted object nearly as the virtual camera sees it, and no other."""
    k = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 3))
    place = 12.0 * viewing_ray(center, k)
    tilt = crop_rotation(center, k)
    for rotation in random_rotations(5).numpy():
        believed = project_points(points @ rotation.T + (0, 0, -12.0), k) - (640, 360)

        def misfit(rotation_in_camera, believed=believed):
            picture = project_points(points @ rotation_in_camera.T + place, k) - center
            scale = (picture * believed).sum() / (believed**2).sum()  # of the longer distance
            return np.abs(picture - scale * believed).mean()

        right, untilted, inverse = (misfit(t @ rotation) for t in (tilt, np.eye(3), tilt.T))
        assert right < 0.3 * untilted
        assert untilted < inverse


def test_crop_rule_is_an_exact_homography():
    """Real and virtual pictures differ by the homography of a pure camera rotation."""
    center, distance = (1150, 90), 6.0
    k = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    flip = np.diag([1.0, -1, -1])
    tilt = crop_rotation(center, k)
    rotation = random_rotations(1).numpy()[0]
    points = np.random.default_rng(1).uniform(-1, 1, (30, 3))
    real = project_points(points @ (tilt @ rotation).T + distance * viewing_ray(center, k), k)
    virtual = project_points(points @ rotation.T + (0, 0, -distance), k)
    homography = k @ flip @ tilt @ flip @ np.linalg.inv(k)
    mapped = np.c_[virtual, np.ones(30)] @ homography.T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], real, atol=1e-8)


@pytest.mark.parametrize(
    ("center", "k", "message"),
    [
        ((1, 2, 3), K, "column, row"),
        ((1, 2), np.zeros((3, 3)), "fx, fy > 0"),
        ((1, math.nan), K, "row"),
    ],
)
def test_wrong_crops_are_refused(center, k, message):
    with pytest.raises(ValueError, match=message):
        crop_rotation(center, k)
