from __future__ import annotations

import numpy as np
import pytest
import trimesh

from i2i.rendering.shading import (
    GRAY_LIGHT,
    corner_normals,
    display_value,
    encode_depth,
    face_normals,
    linear_from_srgb,
    reflected_light,
    srgb_from_linear,
)


def test_srgb_round_trip_and_known_value():
    values = np.linspace(0, 1, 257)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)
    assert linear_from_srgb(0.5) == pytest.approx(0.21404114)  # IEC 61966-2-1


def glsl_reflection(cosine: float, distance: float, color: float, intensity: float) -> float:
    """The metallic-roughness reflection in scalar form, with explicit vectors and half vector."""
    metallic, roughness = 0.1, 0.2
    normal = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    view = light = np.array([0.0, 0, 1])
    half = (view + light) / np.linalg.norm(view + light)
    n_l = np.clip(normal @ light, 0.001, 1)
    n_v = np.clip(abs(normal @ view), 0.001, 1)
    n_h = np.clip(normal @ half, 0, 1)
    v_h = np.clip(view @ half, 0, 1)
    f0 = 0.04 * (1 - metallic) + color * metallic
    diffuse_color = color * (1 - 0.04) * (1 - metallic)
    fresnel = f0 + (1 - f0) * (1 - v_h) ** 5
    k = (roughness + 1) ** 2 / 8
    geometry = n_v / (n_v * (1 - k) + k) * n_l / (n_l * (1 - k) + k)
    a2 = roughness**4
    distribution = a2 / (np.pi * (n_h**2 * (a2 - 1) + 1) ** 2)
    specular = fresnel * geometry * distribution / (4 * n_l * n_v + 0.001)
    return n_l * intensity / distance**2 * ((1 - fresnel) * diffuse_color / np.pi + specular)


@pytest.mark.parametrize("cosine", [1.0, 0.9, 0.4, 0.05, -0.3])
@pytest.mark.parametrize("albedo", [1.0, 0.2])
def test_reflection_is_the_metallic_roughness_model(cosine, albedo):
    expected = glsl_reflection(cosine, 2.7, albedo, GRAY_LIGHT)
    arguments = np.array([cosine], np.float32), np.array([2.7], np.float32)
    gray = reflected_light(*arguments, albedo=albedo, intensity=GRAY_LIGHT)
    assert gray[0] == pytest.approx(expected, rel=1e-4)
    colors = np.array([[albedo], [1.0], [0.0]], np.float32)
    rgb = reflected_light(*arguments, albedo=colors, intensity=GRAY_LIGHT)
    assert rgb[0, 0] == pytest.approx(expected, rel=1e-4)


def test_display_value_clips_and_applies_gamma():
    shown = display_value(np.array([-1, 0, 0.5, 1, 7], np.float32))
    np.testing.assert_allclose(shown, [0, 0, 255 * 0.5 ** (1 / 2.2), 255, 255], rtol=1e-6)


def test_depth_bytes():
    depth = np.array([2.2, 4.2, 3.0, 0.0, 1.0, 9.0, 2.7], np.float32)
    expected = [255, 0, round(1.2 / 2 * 255), 255, 255, 0, round(1.5 / 2 * 255)]
    np.testing.assert_array_equal(encode_depth(depth, distance=3.2), expected)
    assert encode_depth(np.array([4.0], np.float32), distance=5.0)[0] == 255


def test_corner_normals_of_a_sphere_are_radial():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = corner_normals(sphere.vertices, sphere.faces)
    np.testing.assert_allclose(normals, sphere.vertices[sphere.faces], atol=5e-3)


def test_corner_normals_of_a_box_stay_flat():
    box = trimesh.creation.box()
    normals = corner_normals(box.vertices, box.faces)
    expected = np.repeat(box.face_normals[:, None], 3, axis=1)
    np.testing.assert_allclose(normals, expected, atol=1e-12)


def test_corner_normals_follow_their_own_face_in_mixed_winding():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    flip = np.arange(len(sphere.faces)) % 3 == 0
    faces = np.where(flip[:, None], sphere.faces[:, ::-1], sphere.faces)
    whole = corner_normals(sphere.vertices, sphere.faces)
    mixed = corner_normals(sphere.vertices, faces)
    expected = np.where(flip[:, None, None], -whole[:, ::-1], whole)
    np.testing.assert_allclose(mixed, expected, atol=1e-12)


def test_corner_normals_brute_force():
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(9, 3))
    faces = np.array([rng.choice(9, 3, replace=False) for _ in range(14)])
    own = face_normals(vertices, faces)
    got = corner_normals(vertices, faces, crease_angle_deg=70)
    for face, corners in enumerate(faces):
        for corner, vertex in enumerate(corners):
            total = np.zeros(3)
            for other, others in enumerate(faces):
                cosine = own[face] @ own[other]
                if vertex in others and abs(cosine) >= np.cos(np.radians(70)):
                    at = list(others).index(vertex)
                    sides = vertices[np.delete(others, at)] - vertices[vertex]
                    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
                    total += np.arccos(sides[0] @ sides[1]) * np.sign(cosine) * own[other]
            np.testing.assert_allclose(got[face, corner], total / np.linalg.norm(total), atol=1e-9)
