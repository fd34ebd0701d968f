"""What every renderer owes, and what the two owe each other."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from i2i.geometry.cameras import Camera
from i2i.rendering import MODALITIES, get_renderer, prepare_mesh, renderer_names

QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # Rz(+90 degrees)
COLORS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "yellow": (255, 255, 0)}


def inside(picture_or_depth: np.ndarray) -> np.ndarray:
    """The silhouette without its border, shape (N, H, W)."""
    hit = picture_or_depth > 0
    core = hit.copy()
    core[:, 1:-1, 1:-1] = (
        hit[:, 1:-1, 1:-1]
        & hit[:, 2:, 1:-1] & hit[:, :-2, 1:-1] & hit[:, 1:-1, 2:] & hit[:, 1:-1, :-2]
    )  # fmt: skip
    return core


def dominant(pixel: np.ndarray) -> str:
    """The name of the colour that a lit pixel is nearest to in direction."""
    unit = pixel / np.linalg.norm(pixel)
    return max(COLORS, key=lambda name: unit @ COLORS[name] / np.linalg.norm(COLORS[name]))


def facing_quad(visual) -> trimesh.Trimesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


@pytest.mark.parametrize("modality", MODALITIES)
def test_shape_type_and_background(renderer, wedge, rotations, modality):
    images = renderer.render(wedge, rotations, modality=modality, image_size=48)
    assert images.dtype == np.uint8
    assert images.shape == (len(rotations), 3 if modality == "rgb" else 1, 48, 48)
    assert (images[..., 0, :] == 255).all()  # the object leaves a margin
    assert (images[..., 24, 24] < 255).all()


def test_no_views_give_no_pictures(renderer, wedge):
    assert renderer.render(wedge, np.zeros((0, 3, 3))).shape == (0, 1, 128, 128)


@pytest.mark.parametrize("modality", MODALITIES)
def test_quarter_turn_of_the_picture(renderer, wedge, rotations, modality):
    """rotation(rot90(image)) = Rz(90 degrees) @ rotation(image)."""
    before = renderer.render(wedge, rotations, modality=modality)
    after = renderer.render(wedge, QUARTER_TURN @ rotations, modality=modality)
    expected = np.rot90(before, k=1, axes=(2, 3))
    assert (np.abs(after.astype(int) - expected) > 3).mean() < 1e-3
    # The other direction and the mirror image are clearly something else.
    for wrong in (np.rot90(before, k=-1, axes=(2, 3)), expected[..., ::-1]):
        assert (np.abs(after.astype(int) - wrong) > 3).mean() > 0.02


def test_mixed_winding_is_drawn_the_same(renderer, rotations):
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=40, minor_sections=20)
    mixed = torus.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    pictures = [renderer.render(prepare_mesh(m), rotations).astype(int) for m in (torus, mixed)]
    assert (np.abs(pictures[0] - pictures[1]) > 2).mean() < 1e-3
    assert pictures[1][:, 0][inside(renderer.depth(prepare_mesh(mixed), rotations))].min() > 10


def test_both_sides_of_a_sheet_are_lit_alike(renderer):
    sheet = prepare_mesh(facing_quad(None))
    flip = np.diag([1.0, -1, -1])
    front, back = renderer.render(sheet, np.stack([np.eye(3), flip]))[:, 0]
    # away from the middle, where the highlight is white
    assert 50 < front[40, 44] < 255
    assert abs(int(front[40, 44]) - int(back[40, 44])) <= 1


def test_textured_quad_shows_the_right_texels(renderer):
    texels = np.array([[COLORS["red"], COLORS["green"]], [COLORS["blue"], COLORS["yellow"]]])
    image = Image.fromarray(np.repeat(np.repeat(texels.astype(np.uint8), 9, 0), 9, 1))
    # v runs up: the first row of the picture is on top
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=image))
    quad = prepare_mesh(facing_quad(visual))
    front, turned = renderer.render(quad, np.stack([np.eye(3), QUARTER_TURN]), modality="rgb")
    places = [(36, 36), (36, 91), (91, 36), (91, 91)]  # row, column; clear of the highlight
    assert [dominant(front[:, r, c]) for r, c in places] == ["red", "green", "blue", "yellow"]
    assert [dominant(turned[:, r, c]) for r, c in places] == ["green", "yellow", "red", "blue"]


def test_texture_repeats(renderer):
    stripes = np.array([[COLORS["red"], COLORS["blue"]]], dtype=np.uint8)
    image = Image.fromarray(np.repeat(np.repeat(stripes, 32, 1), 64, 0))
    uv = np.array([[0, 0], [2, 0], [2, 1], [0, 1]], dtype=float)
    visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=image))
    picture = renderer.render(prepare_mesh(facing_quad(visual)), np.eye(3)[None], modality="rgb")
    half = 64 / (3.2 * np.tan(np.radians(22.5))) / np.sqrt(2)
    columns = (64 + half * np.array([-0.75, -0.25, 0.25, 0.75])).astype(int)
    assert [dominant(picture[0, :, 36, c]) for c in columns] == ["red", "blue", "red", "blue"]


def test_face_and_vertex_colours(renderer):
    faces = np.array([[*COLORS["red"], 255], [*COLORS["blue"], 255]], dtype=np.uint8)
    by_face = prepare_mesh(facing_quad(ColorVisuals(face_colors=faces)))
    corners = np.array([[*COLORS[n], 255] for n in ("red", "green", "blue", "yellow")], np.uint8)
    by_vertex = prepare_mesh(facing_quad(ColorVisuals(vertex_colors=corners)))
    first = renderer.render(by_face, np.eye(3)[None], modality="rgb")[0]
    second = renderer.render(by_vertex, np.eye(3)[None], modality="rgb")[0]
    assert dominant(first[:, 75, 68]) == "red"  # below the diagonal
    assert dominant(first[:, 52, 60]) == "blue"
    half = 64 / (3.2 * np.tan(np.radians(22.5))) / np.sqrt(2) * 0.85
    low, high = int(64 - half), int(64 + half)
    got = [dominant(second[:, r, c]) for r, c in ((high, low), (high, high), (low, high))]
    assert got == ["red", "green", "blue"]


def test_gray_ignores_colours(renderer, rotations):
    box = trimesh.creation.box()
    painted = box.copy()
    painted.visual = ColorVisuals(face_colors=np.full((12, 4), 30, dtype=np.uint8))
    np.testing.assert_array_equal(
        renderer.render(prepare_mesh(box), rotations),
        renderer.render(prepare_mesh(painted), rotations),
    )


# --- one renderer against the other ---------------------------------------------------------------


def compare(embree, pyrender, mesh, rotations):
    first, second = embree.depth(mesh, rotations), pyrender.depth(mesh, rotations)
    both = (first > 0) & (second > 0)
    either = (first > 0) | (second > 0)
    assert (both.sum(axis=(1, 2)) / either.sum(axis=(1, 2))).min() >= 0.98
    assert np.median(np.abs(first - second)[both]) < 1e-3
    for modality in ("gray", "rgb"):
        pictures = [
            r.render(mesh, rotations, modality=modality).astype(float) / 255
            for r in (embree, pyrender)
        ]
        difference = np.abs(pictures[0] - pictures[1]).mean(axis=1)[both].mean()
        assert difference <= 0.05, (modality, difference)


def test_renderers_agree_on_primitives(embree, pyrender, wedge, rotations):
    compare(embree, pyrender, wedge, rotations)


def test_renderers_agree_on_furniture(embree, pyrender, real_mesh, rotations):
    compare(embree, pyrender, real_mesh, rotations)


def test_renderers_agree_with_another_camera(embree, pyrender, wedge, rotations):
    camera = Camera(distance=2.5, fov_deg=60.0)
    first, second = (
        r.depth(wedge, rotations, camera=camera, image_size=65) for r in (embree, pyrender)
    )
    both = (first > 0) & (second > 0)
    assert both.sum() / ((first > 0) | (second > 0)).sum() > 0.98
    assert np.median(np.abs(first - second)[both]) < 1e-3


# --- arguments ------------------------------------------------------------------------------------


def test_unknown_names_are_refused_with_the_list(embree, wedge, rotations):
    with pytest.raises(ValueError, match="embree, pyrender"):
        get_renderer("blender2")
    assert renderer_names() == ("embree", "pyrender", "blender")
    with pytest.raises(ValueError, match="gray, depth, rgb"):
        embree.render(wedge, rotations, modality="colour")


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (np.eye(3), "must be"),
        (np.eye(4)[None], "must be"),
        (2 * np.eye(3)[None], "not a rotation"),
        (np.diag([1.0, 1, -1])[None], "not a rotation"),
        (np.full((1, 3, 3), np.nan), "not a rotation"),
    ],
)
def test_what_is_no_rotation_is_refused(embree, wedge, wrong, reason):
    with pytest.raises(ValueError, match=reason):
        embree.render(wedge, wrong)


def test_size_must_be_positive(embree, wedge, rotations):
    with pytest.raises(ValueError, match="image_size=0"):
        embree.depth(wedge, rotations, image_size=0)


# --- other processes ------------------------------------------------------------------------------


def _draw(arguments):
    mesh, rotations = arguments
    return get_renderer("embree").render(mesh, rotations, image_size=32)


def test_a_spawned_process_draws_the_same(embree, wedge, rotations):
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (picture,) = pool.map(_draw, [(wedge, rotations)])
    np.testing.assert_array_equal(picture, embree.render(wedge, rotations, image_size=32))
