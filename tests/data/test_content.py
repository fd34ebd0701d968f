"""What a row holds: keys that stay as they were, shapes, and settings that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from render_fakes import FakeRenderer, FakeSource

from i2i.data.content import content_of
from i2i.data.settings import store_settings
from i2i.data.store import StoreSettings
from i2i.geometry.cameras import Camera

IMAGE = StoreSettings(
    source="synthetic",
    up_axis="z",
    renderer="embree",
    renderer_version="embreex 2.17.7.post7, shading 1, samples 4",
    camera_distance=3.2,
    camera_fov_deg=45.0,
    modality="gray",
    image_size=64,
    seed=0,
)


def settings(modality, **options):
    options = {
        "renderer": FakeRenderer(),
        "camera": Camera(),
        "image_size": 16,
        "seed": 0,
    } | options
    return store_settings(FakeSource(), modality=modality, **options)


def test_keys_of_image_stores_are_those_of_version_0_1():
    """A change here makes everybody's stores useless."""
    assert IMAGE.key == "gray_64px_embree_bdb5e0f4"
    blender = replace(IMAGE, renderer="blender:bounces=1,samples=16", image_size=128)
    blender = replace(blender, source="sweethome", up_axis="y", modality="rgb", seed=7)
    assert blender.key == "rgb_128px_blender_2e59bf52"
    assert set(IMAGE.told()) == set(IMAGE.__dict__) - {"num_points", "camera_set"}
    assert replace(IMAGE, renderer_version=None).told()["renderer_version"] is None


def test_a_key_depends_on_what_the_rows_depend_on_and_on_nothing_else():
    def partial(**options):
        return settings("partial_points", **{"num_points": 64, **options}).key

    def full(**options):
        return settings("full_points", **{"num_points": 64, **options}).key

    def views(**options):
        return settings("views", **{"camera_set": "icosahedron_12", **options}).key

    assert partial().startswith("partial_points_64_fake_")
    assert full().startswith("full_points_64_surface_")
    assert views().startswith("views_16px_fake_")
    assert partial(image_size=8) == partial() != partial(cloud_image_size=64)
    assert full(image_size=8) == full() == full(cloud_image_size=64) == full(renderer="embree")
    assert views(cloud_image_size=64) == views() != views(image_size=8)
    others = [partial(num_points=65), full(num_points=65), views(camera_set="dodecahedron_20")]
    assert len({partial(), full(), views(), *others}) == 6
    assert len({make() for make in (partial, full, views)} | {partial(seed=1), full(seed=1)}) == 5


def test_whole_clouds_need_no_renderer():
    """Not even one that is installed."""
    told = settings("full_points", num_points=8, renderer="blender")
    assert (told.renderer, told.image_size) == ("surface", 0)
    assert told.renderer_version is not None


@pytest.mark.parametrize(
    ("modality", "options", "name", "shape", "dtype", "pictures"),
    [
        ("rgb", {}, "images", (3, 16, 16), np.uint8, 1),
        ("depth", {}, "images", (1, 16, 16), np.uint8, 1),
        ("partial_points", {"num_points": 9}, "points", (9, 3), np.float32, 1),
        ("full_points", {"num_points": 8}, "points", (8, 3), np.float32, 1),
        ("views", {"camera_set": "icosahedron_12"}, "view_sets", (12, 1, 16, 16), np.uint8, 12),
        ("views", {"camera_set": "dodecahedron_20"}, "view_sets", (20, 1, 16, 16), np.uint8, 20),
        ("views", {"camera_set": "group_60"}, "view_sets", (60, 1, 16, 16), np.uint8, 60),
    ],
)
def test_content(modality, options, name, shape, dtype, pictures):
    content = content_of(settings(modality, **options).told())
    assert (content.name, content.shape, content.dtype) == (name, shape, np.dtype(dtype))
    assert content.pictures == pictures


@pytest.mark.parametrize(
    ("modality", "options", "message"),
    [
        ("points", {}, r"modality=points.*gray.*partial_points, full_points, views"),
        ("partial_points", {}, r"num_points=None is missing.*at least 8"),
        ("full_points", {}, r"num_points=None is missing.*num_points=1024"),
        ("full_points", {"num_points": 7}, r"num_points=7 is not allowed.*at least 8"),
        ("gray", {"num_points": 64}, r"num_points=64.*partial_points or full_points.*gray"),
        ("views", {}, r"camera_set=None is missing.*icosahedron_12, dodecahedron_20, group_60"),
        ("views", {"camera_set": "cube_6"}, r"camera_set=cube_6 is not known.*icosahedron_12"),
        ("depth", {"camera_set": "group_60"}, r"camera_set=group_60 needs data\.modality=views"),
        ("partial_points", {"num_points": 8, "cloud_image_size": 0}, r"data\.cloud_image_size=0"),
        ("views", {"camera_set": "group_60", "image_size": 0}, r"data\.image_size=0"),
    ],
)
def test_wrong_settings_are_refused(modality, options, message):
    with pytest.raises(ValueError, match=message):
        settings(modality, **options)
