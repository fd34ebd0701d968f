"""Clouds and view sets against the mesh that they were made from."""

import numpy as np
import pytest
import trimesh
from mesh_distance import distance_to
from scipy.stats import chisquare, kstest

from i2i.data.rows import surface_clouds, surface_seed, view_sets, visible_clouds
from i2i.data.sources.synthetic import SyntheticSource
from i2i.errors import MeshError, RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.geometry.seeding import view_rotation
from i2i.geometry.view_sets import CAMERA_SETS, camera_rotations
from i2i.rendering import get_renderer, prepare_mesh

CAMERA = Camera()


@pytest.fixture(params=["embree", "pyrender", "blender"], scope="module")
def renderer(request):
    if request.param == "pyrender":
        return request.getfixturevalue("pyrender")
    try:
        renderer = get_renderer(request.param)
        sphere = prepare_mesh(trimesh.creation.icosphere(subdivisions=1))
        renderer.depth(sphere, np.eye(3)[None], image_size=16)
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    return renderer


@pytest.fixture(scope="module")
def chair():
    source = SyntheticSource(instances_per_class=1, test_instances_per_class=1)
    return prepare_mesh(source.load(source.items(["chair"])[0]), up_axis=source.up_axis)


@pytest.fixture(scope="module")
def rotations():
    return np.stack([view_rotation("a", "train", "b", "c", view) for view in range(3)])


def test_visible_points_lie_on_the_rotated_mesh(renderer, chair, rotations):
    clouds = visible_clouds(
        renderer, chair, rotations, camera=CAMERA, image_size=128, num_points=128
    )
    assert clouds.shape == (3, 128, 3)
    assert clouds.dtype == np.float32
    for cloud, rotation in zip(clouds.astype(np.float64), rotations, strict=True):
        assert distance_to(chair, cloud @ rotation).max() < 1e-3
        assert distance_to(chair, cloud[:9] @ rotation.T).max() > 0.05  # the inverse would be wrong
        # Each is what one pixel shows: its projection is the middle of a pixel.
        assert np.abs(CAMERA.project(cloud, 128) % 1 - 0.5).max() < 1e-3
        assert len(np.unique(cloud, axis=0)) == 128


def test_only_the_near_side_is_visible(renderer, rotations):
    sphere = prepare_mesh(trimesh.creation.icosphere(subdivisions=5))
    [cloud, *_] = visible_clouds(
        renderer, sphere, rotations, camera=CAMERA, image_size=64, num_points=400
    )
    # Rays touch the unit sphere where z is 1/distance.
    assert cloud[:, 2].min() > 1 / CAMERA.distance - 0.01
    assert cloud[:, 2].max() > 0.99
    assert np.abs(np.linalg.norm(cloud, axis=1) - 1).max() < 2e-3
    # Farthest points reach the rim on all sides.
    angle = np.sort(np.arctan2(cloud[:, 1], cloud[:, 0])[cloud[:, 2] < 0.6])
    assert np.diff(angle, append=angle[0] + 2 * np.pi).max() < 0.5


def test_few_visible_pixels_repeat_in_the_same_order(chair, rotations):
    embree = get_renderer("embree")
    clouds = visible_clouds(embree, chair, rotations, camera=CAMERA, image_size=16, num_points=200)
    visible = (embree.depth(chair, rotations, image_size=16) > 0).sum(axis=(1, 2))
    for cloud, count in zip(clouds, visible, strict=True):
        assert 8 < count < 100
        assert len(np.unique(cloud[:count], axis=0)) == count
        assert (cloud == cloud[np.arange(200) % count]).all()
    # The first of many farthest points are the few.
    many = visible_clouds(embree, chair, rotations, camera=CAMERA, image_size=16, num_points=9)
    assert (many == clouds[:, :9]).all()


def test_an_object_that_no_pixel_shows_is_an_error(rotations):
    needle = trimesh.Trimesh([[0, 0, -1], [0, 0, 1], [1e-6, 0, 0]], [[0, 1, 2]])
    with pytest.raises(MeshError, match=r"no pixels of the 16 px.*data\.cloud_image_size"):
        visible_clouds(
            get_renderer("embree"),
            prepare_mesh(needle),
            rotations,
            camera=CAMERA,
            image_size=16,
            num_points=8,
        )


def test_an_object_that_a_handful_of_pixels_shows_is_an_error():
    rod = prepare_mesh(trimesh.creation.box((0.02, 0.02, 1)))
    end_on = np.eye(3)[None]
    with pytest.raises(MeshError, match=r"\d pixels of the 128 px.*data\.cloud_image_size"):
        visible_clouds(
            get_renderer("embree"), rod, end_on, camera=CAMERA, image_size=128, num_points=64
        )


def test_surface_points_are_uniform_by_area(rotations):
    box = prepare_mesh(trimesh.creation.box(extents=(1.0, 2.0, 4.0)))
    half = box.vertices.max(axis=0)
    [cloud] = surface_clouds(box, rotations[:1], seeds=[5], num_points=20_000)
    points = cloud.astype(np.float64) @ rotations[0]
    share = np.abs(points) / half
    assert np.abs(share.max(axis=1) - 1).max() < 1e-5  # on a face, none beyond
    axis = share.argmax(axis=1)
    side = 2 * axis + (points[np.arange(len(points)), axis] > 0)
    area = np.repeat([8.0, 4.0, 2.0], 2)
    assert chisquare(np.bincount(side, minlength=6), 20_000 * area / area.sum()).pvalue > 0.001
    for number in range(6):  # and uniform within each face, along both of its axes
        for other in {0, 1, 2} - {number // 2}:
            spread = points[side == number, other] / half[other]
            assert kstest(spread, "uniform", args=(-1, 2)).pvalue > 0.001
    # As a control, points that are spread over faces instead of area fail.
    assert chisquare(np.bincount(side, minlength=6)).pvalue < 1e-9


def test_surface_points_turn_with_the_view_and_are_new_in_each(chair, rotations):
    seeds = [surface_seed("a", "train", "b", "c", view, 0) for view in range(3)]
    assert len({*seeds, surface_seed("a", "test", "b", "c", 0, 0)}) == 4
    clouds = surface_clouds(chair, rotations, seeds=seeds, num_points=64).astype(np.float64)
    for cloud, rotation in zip(clouds, rotations, strict=True):
        assert distance_to(chair, cloud @ rotation).max() < 1e-5
    assert np.abs(clouds[0] @ rotations[0] - clouds[1] @ rotations[1]).max() > 0.1
    same = surface_clouds(chair, rotations, seeds=seeds[:1] * 3, num_points=64)
    assert np.abs(same[0] @ rotations[0] - same[1] @ rotations[1]).max() < 1e-5
    # Fewer points are the first of more.
    few = surface_clouds(chair, rotations[:1], seeds=seeds[:1], num_points=16)
    assert np.abs(few[0] - clouds[0, :16]).max() < 1e-6


@pytest.mark.parametrize("name", CAMERA_SETS)
def test_each_view_shows_the_object_in_the_rotation_of_its_camera(chair, rotations, name):
    embree, rotations = get_renderer("embree"), rotations[:2]
    cameras = camera_rotations(name)
    sets = view_sets(embree, chair, rotations, camera=CAMERA, image_size=24, cameras=cameras)
    assert sets.shape == (2, len(cameras), 1, 24, 24)
    for pictures, rotation in zip(sets, rotations, strict=True):
        turned = np.stack([camera @ rotation for camera in cameras])
        expected = embree.render(chair, turned, camera=CAMERA, image_size=24)
        assert np.abs(pictures.astype(int) - expected).max() <= 1
        wrong = np.stack([rotation @ camera for camera in cameras])
        other = embree.render(chair, wrong, camera=CAMERA, image_size=24)
        assert np.abs(pictures.astype(int) - other).mean() > 5


def test_a_camera_sees_what_points_at_it(rotations):
    """Independent of the renderer's own idea of a rotation: a knob on the side of camera v."""
    cameras = camera_rotations("dodecahedron_20")
    towards = cameras[7].T @ [0.0, 0.0, 1.0]  # where camera 7 stands, in the common frame
    knob = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    knob.apply_translation(rotations[0].T @ towards)
    counterweight = knob.copy()
    counterweight.apply_scale(-1)
    mesh = prepare_mesh(trimesh.util.concatenate([knob, counterweight]))
    [pictures] = view_sets(
        get_renderer("embree"),
        mesh,
        rotations[:1],
        camera=CAMERA,
        image_size=32,
        cameras=cameras,
    )
    middle = pictures[:, 0, 14:18, 14:18] < 255
    opposite = int(np.argmin(cameras[:, 2] @ towards))
    assert sorted(np.flatnonzero(middle.any(axis=(1, 2)))) == sorted([7, opposite])
