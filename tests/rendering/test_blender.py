"""Cycles against closed forms, against the ray caster, and against itself."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from i2i.configuration import compose, plain
from i2i.data.store import StoreSettings
from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering import RenderMesh, canonical_name, get_renderer, prepare_mesh
from i2i.rendering import blender as module
from i2i.rendering.blender import BlenderRenderer

QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # Rz(+90 degrees)
COLORS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "yellow": (255, 255, 0)}
DIRECT = "blender:samples=16,bounces=0"  # what the ray caster draws: direct light alone
SIZE = 64


_MADE: list[BlenderRenderer] = []


def new_renderer(name: str):
    """A renderer that really draws here, or the reason to skip; ended with its test."""
    try:
        renderer = get_renderer(name)
        renderer.depth(prepare_mesh(trimesh.creation.box()), np.eye(3)[None], image_size=4)
        _MADE.append(renderer)
        return renderer
    except RendererUnavailableError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def blender():
    return new_renderer("blender:samples=16")


@pytest.fixture(scope="module")
def direct():
    return new_renderer(DIRECT)


@pytest.fixture(scope="module", autouse=True)
def _end_them_all():
    yield
    for renderer in _MADE:
        renderer.close()


def plain_mesh(loaded: trimesh.Trimesh) -> RenderMesh:
    """A mesh as it is, without normalisation."""
    faces = np.asarray(loaded.faces, dtype=np.int64)
    return RenderMesh(
        vertices=np.asarray(loaded.vertices, dtype=np.float64),
        faces=faces,
        face_material=np.zeros(len(faces), dtype=np.int64),
    )


def facing_quad(visual=None) -> trimesh.Trimesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def textured_quad(texels: list[list[str]]) -> trimesh.Trimesh:
    picture = np.array([[COLORS[name] for name in row] for row in texels], dtype=np.uint8)
    image = Image.fromarray(np.repeat(np.repeat(picture, 9, 0), 9, 1))
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    return facing_quad(TextureVisuals(uv=uv, material=SimpleMaterial(image=image)))


def dominant(pixel: np.ndarray) -> str:
    """The name of the colour that a lit pixel is nearest to in direction."""
    unit = pixel / np.linalg.norm(pixel)
    return max(COLORS, key=lambda name: unit @ COLORS[name] / np.linalg.norm(COLORS[name]))


# --- camera ---------------------------------------------------------------------------------------


def agree(blender, embree, mesh, rotations):
    first, second = embree.depth(mesh, rotations), blender.depth(mesh, rotations)
    both, either = (first > 0) & (second > 0), (first > 0) | (second > 0)
    assert (both.sum(axis=(1, 2)) / either.sum(axis=(1, 2))).min() >= 0.98
    assert np.median(np.abs(first - second)[both]) < 1e-3
    # One pixel to the side is told apart: the same rays, not about the same.
    aside = np.roll(second, 1, axis=2)
    assert ((first > 0) & (aside > 0)).sum() / ((first > 0) | (aside > 0)).sum() < 0.98


def test_silhouettes_and_depth_of_primitives(blender, embree, wedge, rotations):
    agree(blender, embree, wedge, rotations)


def test_silhouettes_and_depth_of_furniture(blender, embree, real_mesh, rotations):
    agree(blender, embree, real_mesh, rotations)


@pytest.mark.parametrize("camera", [Camera(), Camera(distance=5.0, fov_deg=30.0)])
def test_depth_of_a_sphere_in_closed_form(blender, rotations, camera):
    sphere = plain_mesh(trimesh.creation.icosphere(subdivisions=5))
    depth = blender.depth(sphere, rotations[:2], camera=camera, image_size=96)
    along = -camera.distance * camera.rays(96)[..., 2]
    inside = 1 - (camera.distance**2 - along**2)
    expected = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)
    assert depth.dtype == np.float32
    assert ((depth > 0) != (expected > 0)).mean() < 2e-3
    both = (depth > 0) & (expected > 0)
    assert np.median(np.abs(depth - expected)[both]) < 5e-4


def test_depth_is_ray_length_not_z(blender):
    """A plate across the axis: the same z everywhere, longer rays towards its corners."""
    plate = prepare_mesh(trimesh.creation.box((2, 2, 0.001)))
    depth = blender.depth(plate, np.eye(3)[None])[0]
    hit = depth > 0
    assert np.ptp((-depth * Camera().rays(128)[..., 2])[hit]) < 1e-3
    assert np.ptp(depth[hit]) > 0.05


@pytest.mark.parametrize(("modality", "noise"), [("depth", 0.02), ("gray", 0.6), ("rgb", 0.6)])
def test_quarter_turn_of_the_picture(direct, wedge, rotations, modality, noise):
    """rotation(rot90(image)) = Rz(90 degrees) @ rotation(image), but for the sampling."""
    before = direct.render(wedge, rotations, modality=modality, image_size=SIZE)
    after = direct.render(wedge, QUARTER_TURN @ rotations, modality=modality, image_size=SIZE)
    expected = np.rot90(before, k=1, axes=(2, 3))
    assert np.abs(after.astype(int) - expected).mean() < noise
    for wrong in (np.rot90(before, k=-1, axes=(2, 3)), expected[..., ::-1]):
        assert np.abs(after.astype(int) - wrong).mean() > 10 * noise


# --- light and colour -----------------------------------------------------------------------------


@pytest.mark.parametrize("modality", ["gray", "rgb"])
def test_direct_light_is_that_of_the_ray_caster(direct, embree, wedge, rotations, modality):
    pictures = [
        r.render(wedge, rotations, modality=modality, image_size=SIZE) / 255
        for r in (embree, direct)
    ]
    hit = embree.depth(wedge, rotations, image_size=SIZE) > 0
    difference = (pictures[1] - pictures[0]).mean(axis=1)[hit]
    assert np.abs(difference).mean() < 0.03
    assert abs(difference.mean()) < 0.015
    assert (pictures[1][..., 0, :] == 1).all()  # the object leaves a margin


def test_textured_furniture_has_the_ray_casters_colours(direct, embree, real_mesh, rotations):
    if all(material.texture is None for material in real_mesh.materials):
        pytest.skip("no texture")
    turn = rotations[:2]
    pictures = [r.render(real_mesh, turn, modality="rgb") / 255 for r in (embree, direct)]
    hit = embree.depth(real_mesh, turn) > 0
    assert np.abs(pictures[1] - pictures[0]).mean(axis=1)[hit].mean() < 0.05


def test_a_red_cube_looks_red(blender, rotations):
    cube = trimesh.creation.box()
    cube.visual = TextureVisuals(material=SimpleMaterial(diffuse=[255, 0, 0, 255]))
    mesh = prepare_mesh(cube)
    picture = blender.render(mesh, rotations, modality="rgb", image_size=SIZE).astype(int)
    hit = blender.depth(mesh, rotations, image_size=SIZE) > 0
    red, green, blue = (np.median(picture[:, channel][hit]) for channel in range(3))
    assert red > 100
    assert red > 2 * max(green, blue)


def test_texture_lies_as_in_the_ray_caster(direct, embree):
    texels = [["red", "green"], ["blue", "yellow"]]
    quad = prepare_mesh(textured_quad(texels))
    turns = np.stack([np.eye(3), QUARTER_TURN])
    front, turned = direct.render(quad, turns, modality="rgb")
    places = [(36, 36), (36, 91), (91, 36), (91, 91)]  # row, column; clear of the highlight
    assert [dominant(front[:, r, c]) for r, c in places] == ["red", "green", "blue", "yellow"]
    assert [dominant(turned[:, r, c]) for r, c in places] == ["green", "yellow", "red", "blue"]
    cast = embree.render(quad, turns, modality="rgb") / 255
    assert np.abs(front / 255 - cast[0]).mean() < 0.01
    upside_down = prepare_mesh(textured_quad(texels[::-1]))
    wrong = direct.render(upside_down, turns[:1], modality="rgb")[0]
    assert np.abs(wrong / 255 - cast[0]).mean() > 0.02
    bare = direct.render(prepare_mesh(facing_quad()), turns[:1], modality="rgb")[0]
    assert np.ptp(bare.astype(int), axis=0).max() <= 1  # without the texture it is gray


def test_texture_repeats(direct):
    texture = textured_quad([["red", "blue"]])
    texture.visual.uv = np.array([[0, 0], [2, 0], [2, 1], [0, 1]], dtype=float)
    picture = direct.render(prepare_mesh(texture), np.eye(3)[None], modality="rgb")
    half = 64 / (3.2 * np.tan(np.radians(22.5))) / np.sqrt(2)
    columns = (64 + half * np.array([-0.75, -0.25, 0.25, 0.75])).astype(int)
    assert [dominant(picture[0, :, 36, c]) for c in columns] == ["red", "blue", "red", "blue"]


def test_face_and_vertex_colours(direct):
    faces = np.array([[*COLORS["red"], 255], [*COLORS["blue"], 255]], dtype=np.uint8)
    corners = np.array([[*COLORS[n], 255] for n in ("red", "green", "blue", "yellow")], np.uint8)
    first, second = (
        direct.render(prepare_mesh(facing_quad(visual)), np.eye(3)[None], modality="rgb")[0]
        for visual in (ColorVisuals(face_colors=faces), ColorVisuals(vertex_colors=corners))
    )
    # below and above the diagonal, clear of the highlight in the middle
    assert [dominant(first[:, r, c]) for r, c in ((85, 80), (42, 48))] == ["red", "blue"]
    half = 64 / (3.2 * np.tan(np.radians(22.5))) / np.sqrt(2) * 0.85
    low, high = int(64 - half), int(64 + half)
    got = [dominant(second[:, r, c]) for r, c in ((high, low), (high, high), (low, high))]
    assert got == ["red", "green", "blue"]


def test_gray_ignores_colours(direct, rotations):
    box = trimesh.creation.box()
    painted = box.copy()
    painted.visual = ColorVisuals(face_colors=np.full((12, 4), 30, dtype=np.uint8))
    first, second = (
        direct.render(prepare_mesh(m), rotations[:1], image_size=SIZE) for m in (box, painted)
    )
    np.testing.assert_array_equal(first, second)


def test_both_sides_of_a_sheet_are_lit_alike(direct):
    flip = np.diag([1.0, -1, -1])
    front, back = direct.render(prepare_mesh(facing_quad()), np.stack([np.eye(3), flip]))[:, 0]
    assert 50 < front[40, 44] < 255  # away from the middle, where the highlight is white
    assert abs(int(front[40, 44]) - int(back[40, 44])) <= 2


def test_mixed_winding_is_drawn_the_same(direct, rotations):
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=40, minor_sections=20)
    mixed = torus.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    pictures = [
        direct.render(prepare_mesh(m), rotations[:2], image_size=SIZE).astype(int)
        for m in (torus, mixed)
    ]
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.1


@pytest.mark.parametrize("name", ["blender:samples=16", DIRECT])
def test_a_surface_that_is_there_twice_looks_like_one(name):
    renderer = new_renderer(name)
    once = facing_quad()
    other = trimesh.Trimesh(once.vertices, [[0, 1, 3], [1, 2, 3]], process=False)
    twice = trimesh.util.concatenate([once, other])
    tilt = trimesh.transformations.rotation_matrix(0.4, [1, 2, 0])[:3, :3][None]
    first, second = (
        renderer.render(prepare_mesh(m), tilt, image_size=SIZE).astype(int) for m in (once, twice)
    )
    assert np.abs(first - second).max() <= 2


def test_bounces_light_a_corner_and_nothing_else(blender, direct):
    """Light goes from wall to wall in a corner that is open to the camera; not on a ball."""
    walls = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    corner = trimesh.Trimesh(walls, [[0, 1, 2], [0, 2, 3], [0, 3, 1]], process=False)
    towards = trimesh.geometry.align_vectors([1, 1, 1], [0, 0, 1])[:3, :3][None]
    ball = trimesh.creation.icosphere(subdivisions=3)
    gains = []
    for loaded in (corner, ball):
        mesh = prepare_mesh(loaded)
        hit = blender.depth(mesh, towards, image_size=SIZE)[:, None] > 0
        pictures = [r.render(mesh, towards, image_size=SIZE) / 255 for r in (direct, blender)]
        gains.append((pictures[1] - pictures[0])[hit].mean())
    assert gains[0] > 0.03
    assert abs(gains[1]) < 0.003


def test_more_samples_less_noise(wedge, rotations):
    few, more, many = (
        new_renderer(f"blender:samples={samples}")
        .render(wedge, rotations[:1], image_size=SIZE)
        .astype(float)
        for samples in (2, 16, 128)
    )
    assert np.abs(more - many).mean() < 0.6 * np.abs(few - many).mean()


def test_denoising_changes_the_picture_a_little(wedge, rotations):
    raw, filtered = (
        new_renderer(f"blender:samples=16,denoise={word}")
        .render(wedge, rotations[:1], image_size=SIZE)
        .astype(int)
        for word in ("false", "true")
    )
    assert 0 < np.abs(raw - filtered).mean() < 3


# --- the same bytes -------------------------------------------------------------------------------


def test_order_and_other_scenes_do_not_matter(blender, wedge, rotations):
    whole = blender.render(wedge, rotations, modality="rgb", image_size=SIZE)
    for index in (2, 0):
        again = blender.render(wedge, rotations[index : index + 1], modality="rgb", image_size=SIZE)
        np.testing.assert_array_equal(again[0], whole[index])
    blender.depth(prepare_mesh(trimesh.creation.box()), rotations[:1], image_size=32)
    again = blender.render(wedge, rotations[:1], modality="rgb", image_size=SIZE)
    np.testing.assert_array_equal(again[0], whole[0])


def test_a_mesh_is_set_up_once_for_all_views(blender, wedge, rotations, monkeypatch):
    made = []
    real = blender._process.set_up
    monkeypatch.setattr(
        blender._process, "set_up", lambda *a, **k: (made.append(a[1]), real(*a, **k))
    )
    for _ in range(2):
        blender.render(wedge, rotations[:2], image_size=20)
    blender.depth(wedge, rotations[:2], image_size=20)
    assert made == ["gray", "depth"]


def _draw(arguments):
    mesh, rotations = arguments
    return get_renderer("blender:samples=8").render(mesh, rotations, image_size=48, modality="rgb")


def test_processes_and_threads_do_not_matter(monkeypatch, wedge, rotations):
    new_renderer("blender")  # skips where it is missing
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (one_thread,) = pool.map(_draw, [(wedge, rotations)])
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    np.testing.assert_array_equal(_draw((wedge, rotations)), one_thread)
    monkeypatch.delenv("OMP_NUM_THREADS")
    np.testing.assert_array_equal(_draw((wedge, rotations)), one_thread)


def test_nothing_is_printed(blender, wedge, rotations, capfd):
    blender.render(wedge, rotations[:1], image_size=48)
    print("after")
    assert capfd.readouterr().out == "after\n"


def test_nothing_is_left_behind(wedge, rotations, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    renderer = new_renderer("blender:samples=1")
    process = renderer._process._process
    renderer.render(wedge, rotations[:1], image_size=32)
    assert len(list(tmp_path.glob("i2i-blender-*"))) == 1
    assert "bpy" not in sys.modules  # Blender is not in this process
    assert process.poll() is None
    renderer.close()
    assert process.poll() == 0
    assert not list(tmp_path.iterdir())


def test_a_blender_that_died_is_told_and_started_again(wedge, rotations, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # what a killed process cannot remove
    renderer = new_renderer("blender:samples=1")
    first = renderer.render(wedge, rotations[:1], image_size=32)
    renderer._process._process.kill()
    with pytest.raises(RendererUnavailableError, match=r"process ended .*renderer=embree"):
        renderer.render(wedge, rotations[:1], image_size=32)
    np.testing.assert_array_equal(renderer.render(wedge, rotations[:1], image_size=32), first)


ENDS = """
import sys
import numpy as np, trimesh
from i2i.rendering import get_renderer, prepare_mesh
kept = get_renderer("blender:samples=1")
mesh = prepare_mesh(trimesh.creation.box())
sys.kept = [kept, mesh, sys]  # a reference that lasts to the end
print(kept.render(mesh, np.eye(3)[None], image_size=16).shape)
sys.exit(3)
"""


def test_a_program_that_drew_ends_with_its_own_exit_code():
    new_renderer("blender:samples=1")
    done = subprocess.run(
        [sys.executable, "-c", ENDS],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (3, "(1, 1, 16, 16)\n", "")


DIES = """
import os, signal
import numpy as np, trimesh
from i2i.rendering import get_renderer, prepare_mesh
renderer = get_renderer("blender:samples=1")
renderer.render(prepare_mesh(trimesh.creation.box()), np.eye(3)[None], image_size=16)
print(renderer._process._process.pid, flush=True)
os.killpg(0, signal.SIGTERM)
"""


def test_blender_ends_with_a_program_that_is_killed(tmp_path):
    """By a signal to the whole group, as a scheduler or `timeout` sends it."""
    new_renderer("blender:samples=1")
    done = subprocess.run(
        [sys.executable, "-c", DIES],
        capture_output=True,  # returns when Blender has closed its error output, too
        text=True,
        timeout=120,
        check=False,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)},
    )
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")
    assert done.stdout.strip().isdigit()
    assert not list(tmp_path.iterdir())


# --- options and refusals -------------------------------------------------------------------------


def test_no_views_give_no_pictures(wedge):
    assert BlenderRenderer().render(wedge, np.zeros((0, 3, 3))).shape == (0, 1, 128, 128)


def test_missing_package_is_refused_with_what_to_type(monkeypatch):
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RendererUnavailableError, match=r"i2i\[blender\].*3\.11.*renderer=embree"):
        get_renderer("blender")


def test_missing_library_is_refused_with_what_to_type(monkeypatch, wedge, rotations, tmp_path):
    broken = "raise ImportError('libXi.so.6: cannot open shared object file')"
    (tmp_path / "bpy.py").write_text(broken)
    monkeypatch.syspath_prepend(tmp_path)
    renderer = BlenderRenderer()
    with pytest.raises(RendererUnavailableError, match=r"libXi.*apt-get.*libxi6.*renderer=embree"):
        renderer.render(wedge, rotations)
    renderer.close()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("blender:sample=3", "no option 'sample'; it has samples, bounces, denoise"),
        ("blender:samples=many", "samples=many .* whole number"),
        ("blender:samples", "samples= .* whole number"),
        ("blender:denoise=1", "true or false"),
        ("embree:samples=3", "no options"),
    ],
)
def test_wrong_options_are_refused(name, reason):
    with pytest.raises(ValueError, match=reason):
        canonical_name(name)


@pytest.mark.parametrize(("option", "value"), [("samples", 0), ("bounces", -1)])
def test_options_out_of_range_are_refused(option, value):
    with pytest.raises(ValueError, match=f"renderer.{option}={value} is not allowed"):
        BlenderRenderer(**{option: value})


def test_pictures_that_blender_would_enlarge_are_refused(wedge, rotations):
    with pytest.raises(ValueError, match=r"image_size=3 .* at least 4"):
        BlenderRenderer().depth(wedge, rotations, image_size=3)


def test_options_come_from_the_configuration_and_name_the_store():
    """Each option changes the store's folder; the folders of the other renderers are as before."""

    def folder(*words: str) -> str:
        config = plain(compose(["renderer=blender", *words]))
        name = canonical_name(config["data"]["renderer"])
        return settings(name).key

    def settings(renderer: str) -> StoreSettings:
        return StoreSettings("synthetic", "z", renderer, None, 3.2, 45.0, "gray", 64, 0)

    names = ("blender", "blender:samples=7", "blender:bounces=0", "blender:denoise=true")
    keys = [settings(canonical_name(name)).key for name in names]
    assert len(set(keys)) == 4
    assert folder() == keys[0]
    assert folder("renderer.samples=7") == keys[1]
    assert all(key.startswith("gray_64px_blender_") for key in keys)
    assert plain(compose([]))["data"]["renderer"] == canonical_name("embree") == "embree"
    assert settings("embree").key == "gray_64px_embree_bdb5e0f4"


def test_version_names_what_makes_the_pixels(blender):
    assert "bpy 4." in blender.version
    versions = {
        BlenderRenderer(**options).version
        for options in ({}, {"samples": 3}, {"bounces": 0}, {"denoise": True})
    }
    assert len(versions) == 4
