"""Photographs: crops of hand-made pictures with known geometry, intrinsics against a pinhole."""

import io
from itertools import combinations

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from i2i.data.photographs import TYPICAL_OUTLINE, enclosing_circle, prepare_photograph
from i2i.errors import ImageError
from i2i.geometry.cameras import Camera

BALL = 0.794  # the unit sphere's silhouette, of the half-width (tested below)
FILL = BALL * TYPICAL_OUTLINE


def disc(width, height, *, center, radius):
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return (x - center[0]) ** 2 + (y - center[1]) ** 2 <= radius**2


def rgba_disc(width, height, *, center, radius, color=(40, 80, 120), behind=(255, 0, 255)):
    inside = disc(width, height, center=center, radius=radius)
    pixels = np.empty((height, width, 4), dtype=np.uint8)
    pixels[..., :3] = np.where(inside[..., None], color, behind)
    pixels[..., 3] = np.where(inside, 255, 0)
    return Image.fromarray(pixels)


def dark_extent(image):
    """Columns and rows of the (S, S) image that are not background, as (x0, y0, x1, y1)."""
    rows, columns = np.nonzero(np.asarray(image) < 0.9)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_training_render_passes_through_unchanged():
    pixels = np.full((64, 64), 255, dtype=np.uint8)
    pixels[10:50, 20:40] = np.random.default_rng(0).integers(0, 200, (40, 20))
    prepared = prepare_photograph(Image.fromarray(pixels), channels=1, image_size=64)
    assert prepared.tensor.shape == (1, 1, 64, 64)
    assert prepared.tensor.dtype == torch.float32
    np.testing.assert_allclose(prepared.tensor[0, 0].numpy(), pixels / 255.0, atol=1e-6)
    assert prepared.warnings == ()
    assert prepared.crop_box == (0.0, 0.0, 64.0, 64.0)
    np.testing.assert_array_equal(prepared.camera_from_crop, np.eye(3))


def test_silhouette_fraction_is_the_tangent_cone_of_the_sphere():
    # The outermost ray that meets the unit sphere, found by brute force.
    slopes = np.linspace(0, np.tan(np.radians(22.5)), 200_001)
    distance_to_center = 3.2 * slopes / np.sqrt(1 + slopes**2)
    outermost = slopes[distance_to_center <= 1.0].max() / np.tan(np.radians(22.5))
    assert outermost == pytest.approx(BALL, abs=5e-4)
    assert Camera().ball_radius() == pytest.approx(outermost, abs=1e-4)


def test_alpha_cuts_out_and_scales_as_in_training():
    picture = rgba_disc(300, 200, center=(210.0, 80.0), radius=50.0)
    prepared = prepare_photograph(picture, channels=3, image_size=128)
    x0, y0, x1, y1 = prepared.crop_box
    assert ((x0 + x1) / 2, (y0 + y1) / 2) == pytest.approx((210.0, 80.0), abs=0.5)
    assert x1 - x0 == pytest.approx(100.0 / FILL, abs=2.0)  # the pixels' corners stick out
    extent = dark_extent(prepared.tensor[0, 0])
    assert (extent[2] - extent[0]) / 128 == pytest.approx(FILL, abs=0.02)
    center_color = prepared.tensor[0, :, 64, 64].numpy() * 255
    np.testing.assert_allclose(center_color, (40, 80, 120), atol=0.5)
    assert prepared.tensor[0, :, 2, 2].tolist() == [1.0, 1.0, 1.0]  # the magenta is gone
    assert prepared.warnings == ()


def test_transparent_color_does_not_bleed_into_the_edge():
    picture = rgba_disc(400, 400, center=(200, 200), radius=120, color=(0, 0, 0))
    image = prepare_photograph(picture, channels=3, image_size=64).tensor[0]
    # Black on white only: red, green and blue stay equal although magenta lies under the alpha.
    torch.testing.assert_close(image[0], image[1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", ["array", "path", "pil", "zero_one"])
def test_mask_equals_alpha(tmp_path, kind):
    picture = rgba_disc(160, 120, center=(70.0, 50.0), radius=30.0)
    inside = np.asarray(picture)[..., 3]
    mask = {"array": inside > 0, "pil": Image.fromarray(inside), "zero_one": inside // 255}.get(
        kind
    )
    if kind == "path":
        mask = tmp_path / "mask.png"
        Image.fromarray(inside).save(mask)
    by_alpha = prepare_photograph(picture, channels=3, image_size=64)
    by_mask = prepare_photograph(picture.convert("RGB"), channels=3, image_size=64, mask=mask)
    torch.testing.assert_close(by_mask.tensor, by_alpha.tensor)
    assert by_mask.crop_box == by_alpha.crop_box


def test_box_becomes_the_training_extent_and_hides_the_rest():
    pixels = np.full((200, 300, 3), 255, dtype=np.uint8)
    pixels[60:140, 100:140] = 30  # the object: 40 × 80 px
    pixels[60:140, 200:240] = 60  # another thing
    prepared = prepare_photograph(pixels, channels=1, image_size=128, box=(100, 60, 140, 140))
    assert prepared.crop_box == pytest.approx(
        (120 - 40 / FILL, 100 - 40 / FILL, 120 + 40 / FILL, 100 + 40 / FILL), rel=1e-3
    )
    x0, y0, x1, y1 = dark_extent(prepared.tensor[0, 0])
    assert (y1 - y0) / 128 == pytest.approx(FILL, abs=0.02)
    assert (x1 - x0) / 128 == pytest.approx(FILL / 2, abs=0.02)
    assert prepared.tensor.min().item() == pytest.approx(30 / 255, abs=1e-3)


def test_crop_of_a_rendered_object_is_about_the_training_image_itself():
    """Cut a render out by its own outline: on average the crop is the whole image again."""
    vertices = np.array([[x, y, z] for x in (-0.45, 0.45) for y in (-0.45, 0.45) for z in (-1, 1)])
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    sides = []
    for turn in Rotation.random(60, random_state=0).as_matrix():
        corners = Camera().project(vertices @ turn.T, 128)  # a box's outline is that of its corners
        outline = Image.new("L", (128, 128))
        hull = corners[ConvexHull(corners).vertices]
        ImageDraw.Draw(outline).polygon([tuple(corner) for corner in hull], fill=255)
        crop = prepare_photograph(
            np.zeros((128, 128), np.uint8), channels=1, image_size=8, mask=outline
        ).crop_box
        sides.append(crop[2] - crop[0])
    assert np.median(sides) / 128 == pytest.approx(1.0, abs=0.15)


def test_margin_shrinks_the_object():
    picture = rgba_disc(200, 200, center=(100, 100), radius=40)
    plain = prepare_photograph(picture, channels=1, image_size=128)
    wide = prepare_photograph(picture, channels=1, image_size=128, margin=1.5)
    side = plain.crop_box[2] - plain.crop_box[0]
    assert wide.crop_box[2] - wide.crop_box[0] == pytest.approx(1.5 * side)


def test_whole_picture_is_squared_and_padded():
    pixels = np.full((50, 100), 255, dtype=np.uint8)
    pixels[20:30, 45:55] = 0
    prepared = prepare_photograph(pixels, channels=1, image_size=100)
    assert prepared.crop_box == (0.0, -25.0, 100.0, 75.0)
    assert dark_extent(prepared.tensor[0, 0]) == (45, 45, 55, 55)
    assert prepared.tensor[0, 0, 0, 0].item() == 1.0


def test_gray_model_gets_the_mean_of_the_colors():
    pixels = np.full((32, 32, 3), 255, dtype=np.uint8)
    pixels[8:24, 8:24] = (30, 60, 120)
    image = prepare_photograph(pixels, channels=1, image_size=32).tensor
    assert image[0, 0, 16, 16].item() * 255 == pytest.approx(70.0, abs=1e-3)


def test_gray_picture_fills_three_channels():
    pixels = np.full((32, 32), 255, dtype=np.uint8)
    pixels[8:24, 8:24] = 51
    image = prepare_photograph(pixels, channels=3, image_size=32).tensor
    assert image[0, :, 16, 16].tolist() == pytest.approx([0.2, 0.2, 0.2])


def test_sixteen_bit_and_palette_pictures_keep_their_range():
    deep = Image.fromarray(np.full((16, 16), 32768, dtype=np.uint16))
    value = prepare_photograph(deep, channels=1, image_size=16).tensor.mean().item()
    assert value == pytest.approx(32768 / 65535, abs=1e-4)
    palette = rgba_disc(64, 64, center=(32, 32), radius=20).convert("P")
    assert palette.mode == "P"
    reference = prepare_photograph(palette.convert("RGB"), channels=3, image_size=32)
    torch.testing.assert_close(
        prepare_photograph(palette, channels=3, image_size=32).tensor, reference.tensor
    )


def test_enclosing_circle_against_all_pairs_and_triples():
    rng = np.random.default_rng(3)
    for _ in range(20):
        points = rng.normal(size=(9, 2))
        x, y, radius = enclosing_circle(points)
        assert (np.linalg.norm(points - (x, y), axis=1) <= radius * (1 + 1e-9)).all()
        best = np.inf
        for size in (2, 3):
            for chosen in combinations(points, size):
                corners = np.array(chosen)
                if size == 2:
                    center = corners.mean(axis=0)
                else:  # perpendicular bisectors
                    a = 2 * (corners[1:] - corners[0])
                    b = (corners[1:] ** 2).sum(axis=1) - (corners[0] ** 2).sum()
                    center = np.linalg.solve(a, b)
                reach = np.linalg.norm(points - center, axis=1).max()
                if reach <= np.linalg.norm(corners[0] - center) * (1 + 1e-9):
                    best = min(best, reach)
        assert radius == pytest.approx(best, rel=1e-9)


def test_enclosing_circle_of_a_square_is_its_diagonal():
    corners = np.array([[0, 0], [2, 0], [0, 2], [2, 2], [1, 0]])
    assert enclosing_circle(corners) == pytest.approx((1.0, 1.0, np.sqrt(2)))


# --- warnings --------------------------------------------------------------------------------


def test_cluttered_border_is_warned_about():
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    prepared = prepare_photograph(pixels, channels=1, image_size=64)
    assert len(prepared.warnings) == 1
    assert "not a uniform background" in prepared.warnings[0]
    assert "mask=" in prepared.warnings[0]


def test_uniform_black_border_is_named():
    prepared = prepare_photograph(np.zeros((64, 64), np.uint8), channels=1, image_size=64)
    assert "uniform" in prepared.warnings[0]
    assert "0.00" in prepared.warnings[0]


def test_clutter_behind_a_mask_is_no_reason_to_warn():
    pixels = np.random.default_rng(0).integers(0, 255, (128, 128, 3), dtype=np.uint8)
    mask = disc(128, 128, center=(64, 64), radius=40)
    prepared = prepare_photograph(pixels, channels=1, image_size=64, mask=mask)
    assert prepared.warnings == ()


def test_clutter_inside_a_box_is_warned_about():
    pixels = np.random.default_rng(0).integers(0, 255, (128, 128, 3), dtype=np.uint8)
    prepared = prepare_photograph(pixels, channels=1, image_size=64, box=(20, 20, 100, 100))
    assert "not a uniform background" in prepared.warnings[0]


def test_cut_off_object_and_small_object_are_warned_about():
    picture = rgba_disc(100, 100, center=(5, 50), radius=20)
    warnings = prepare_photograph(picture, channels=1, image_size=128).warnings
    assert any("touches the edge" in text for text in warnings)
    assert any("enlarged" in text for text in warnings)


def test_exif_orientation_is_applied():
    pixels = np.full((40, 60), 255, dtype=np.uint8)
    pixels[0:10, 0:10] = 0  # top left as stored
    exif = Image.Exif()
    exif[0x0112] = 6  # the viewer turns the picture by 90° clockwise
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", exif=exif)
    prepared = prepare_photograph(Image.open(buffer), channels=1, image_size=60)
    assert prepared.crop_box == (-10.0, 0.0, 50.0, 60.0)
    assert dark_extent(prepared.tensor[0, 0]) == (
        40,
        0,
        50,
        10,
    )  # top right, after 10 px of padding
    assert any("EXIF" in text for text in prepared.warnings)


# --- intrinsics ------------------------------------------------------------------------------


def test_intrinsics_turn_the_optical_axis_into_the_ray_of_the_crop_center():
    picture = rgba_disc(640, 480, center=(520.0, 120.0), radius=40.0)
    fx, fy, cx, cy = 500.0, 510.0, 322.0, 238.0
    prepared = prepare_photograph(picture, channels=1, image_size=64, intrinsics=(fx, fy, cx, cy))
    turn = prepared.camera_from_crop
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    # The crop's optical axis is −z; a pinhole must see that direction at the crop's centre.
    x, y, z = turn @ np.array([0.0, 0.0, -1.0])
    pixel = (cx + fx * x / -z, cy - fy * y / -z)  # y is up, rows go down
    x0, y0, x1, y1 = prepared.crop_box
    assert pixel == pytest.approx(((x0 + x1) / 2, (y0 + y1) / 2), abs=1e-6)
    # About an axis in the image plane: the shortest turn, without roll about the viewing ray.
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    assert abs(axis[2]) < 1e-9
    assert axis @ np.array([x, y, z]) == pytest.approx(0.0, abs=1e-9)


def test_intrinsics_of_a_centred_object_change_nothing():
    picture = rgba_disc(200, 200, center=(100.0, 100.0), radius=30.0)
    turn = prepare_photograph(
        picture, channels=1, image_size=64, intrinsics=(300, 300, 100, 100)
    ).camera_from_crop
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-9)


# --- bad input -------------------------------------------------------------------------------


def prepare(picture, **settings):
    return prepare_photograph(picture, channels=1, image_size=32, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mask": np.ones((10, 10), bool)}, "same size"),
        ({"mask": np.zeros((40, 60), bool)}, "mask is empty"),
        ({"box": (10, 10, 10, 30)}, "covers nothing"),
        ({"box": (100, 10, 120, 30)}, "covers nothing"),
        ({"box": (10, 10, 30)}, "3 numbers"),
        ({"intrinsics": (0.0, 500.0, 3.0, 3.0)}, "focal lengths positive"),
        ({"margin": 0.0}, "must be positive"),
    ],
)
def test_settings_that_do_not_fit(settings, message):
    with pytest.raises(ImageError, match=message):
        prepare(np.full((40, 60), 255, np.uint8), **settings)


def test_fully_transparent_picture():
    with pytest.raises(ImageError, match="Nothing of the picture is left"):
        prepare(np.zeros((40, 40, 4), np.uint8))
