from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from i2i.rendering import prepare_mesh
from i2i.rendering.shading import srgb_from_linear

QUAD = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]])
QUAD_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)


def quad(visual) -> trimesh.Trimesh:
    return trimesh.Trimesh(QUAD, QUAD_FACES, visual=visual, process=False)


def picture(height: int = 4, width: int = 6) -> Image.Image:
    return Image.fromarray(
        np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    )


def test_simple_material_keeps_colour_texture_and_coordinates():
    material = SimpleMaterial(image=picture(), diffuse=[255, 128, 0, 255])
    mesh = prepare_mesh(quad(TextureVisuals(uv=QUAD_UV, material=material)))
    assert mesh.materials[0].base_color == pytest.approx((1, 128 / 255, 0))
    np.testing.assert_array_equal(mesh.materials[0].texture, np.asarray(picture()))
    # Coordinates follow their corners through the renumbering of vertices.
    place = mesh.vertices[mesh.faces][..., :2]
    np.testing.assert_allclose(
        mesh.corner_uv, (place - place.min((0, 1))) / np.ptp(place, axis=(0, 1))
    )


def test_pbr_factor_is_linear_light():
    material = PBRMaterial(baseColorFactor=[128, 255, 0, 255])
    mesh = prepare_mesh(quad(TextureVisuals(uv=QUAD_UV, material=material)))
    assert mesh.materials[0].base_color == pytest.approx(
        (float(srgb_from_linear(128 / 255)), 1, 0), abs=1e-6
    )
    assert mesh.materials[0].texture is None


def test_black_colour_beside_a_texture_means_the_texture():
    material = SimpleMaterial(image=picture(), diffuse=[0, 0, 0, 255])
    mesh = prepare_mesh(quad(TextureVisuals(uv=QUAD_UV, material=material)))
    assert mesh.materials[0].base_color == (1, 1, 1)


def test_texture_without_coordinates_is_left_out():
    material = SimpleMaterial(image=picture(), diffuse=[10, 20, 30, 255])
    mesh = prepare_mesh(quad(TextureVisuals(uv=None, material=material)))
    assert mesh.materials[0].texture is None
    assert mesh.corner_uv is None


def test_large_textures_are_shrunk():
    material = SimpleMaterial(image=picture(30, 3000))
    mesh = prepare_mesh(quad(TextureVisuals(uv=QUAD_UV, material=material)))
    assert mesh.materials[0].texture.shape == (10, 1024, 3)


def test_face_colours():
    colors = np.array([[255, 0, 0, 255], [0, 0, 255, 255]], dtype=np.uint8)
    loaded = quad(ColorVisuals(face_colors=colors))
    mesh = prepare_mesh(loaded)
    np.testing.assert_array_equal(mesh.corner_color, np.repeat(colors[:, None, :3], 3, axis=1))


def test_vertex_colours():
    colors = np.arange(16, dtype=np.uint8).reshape(4, 4) * 10
    mesh = prepare_mesh(quad(ColorVisuals(vertex_colors=colors)))
    np.testing.assert_array_equal(mesh.corner_color, colors[QUAD_FACES][..., :3])


def test_plain_mesh_is_white():
    mesh = prepare_mesh(trimesh.creation.box())
    assert mesh.corner_color is None
    assert mesh.materials[0].base_color == (1, 1, 1)


def test_parts_of_a_scene_keep_their_own_looks():
    red = quad(TextureVisuals(uv=QUAD_UV, material=SimpleMaterial(diffuse=[255, 0, 0, 255])))
    pattern = quad(TextureVisuals(uv=QUAD_UV, material=SimpleMaterial(image=picture())))
    pattern.apply_translation((0, 0, 1))
    painted = quad(ColorVisuals(face_colors=np.full((2, 4), 77, dtype=np.uint8)))
    painted.apply_translation((0, 0, 2))
    mesh = prepare_mesh(trimesh.Scene({"a": red, "b": pattern, "c": painted}))
    height = np.argsort(np.argsort(mesh.vertices[mesh.faces][:, 0, 2].round(6)))
    order = np.argsort(height)
    names = [mesh.materials[mesh.face_material[face]] for face in order]
    assert names[0].base_color[1] == 0
    assert names[2].texture is not None
    assert (mesh.corner_color[order[:4]] == 255).all()
    assert (mesh.corner_color[order[4:]] == 77).all()
    assert (mesh.corner_uv[order[:2]] == 0).all() or names[0].texture is None
