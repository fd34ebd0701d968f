import numpy as np
import pytest
import trimesh
from PIL import Image

from i2i.data.export import (
    export_modelnet_layout,
    export_shapenet_layout,
    synset_for,
    z_up_rotation,
)
from i2i.data.sources.base import UP_AXES, MeshItem, MeshSource
from i2i.data.sources.modelnet40 import ModelNet40
from i2i.data.sources.shapenet55 import ShapeNet55
from i2i.data.sources.sweethome import DEBIAN_ROOT, SweetHome
from i2i.geometry.cameras import Camera
from i2i.rendering.base import get_renderer
from i2i.rendering.mesh import prepare_mesh


class Painted(MeshSource):
    """A coloured arm and a textured plate as one scene, in any frame."""

    name = "painted"
    classes = ("bed", "toilet")
    symmetry = {"bed": "none", "toilet": "none"}  # noqa: RUF012

    def __init__(self, up_axis):
        self.up_axis = up_axis

    def items(self, classes):
        return [MeshItem(name, f"{name}-1", "train", name, name) for name in classes]

    def load(self, item):
        arm = trimesh.creation.box((0.2, 1.0, 0.3))
        arm.visual.face_colors = np.where(
            np.arange(12)[:, None] < 6, (255, 0, 0, 255), (0, 80, 0, 255)
        )
        vertices = np.array([[0, 0, 0.5], [1, 0, 0.5], [1, 0.5, 0.7], [0, 0.5, 0.7]])
        plate = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
        pixels = np.zeros((8, 8, 3), np.uint8)
        pixels[:4, :, 0], pixels[4:, :, 2] = 250, 150
        plate.visual = trimesh.visual.TextureVisuals(
            uv=[[0, 0], [1, 0], [1, 1], [0, 1]],
            material=trimesh.visual.material.SimpleMaterial(image=Image.fromarray(pixels)),
        )
        back = np.eye(4)
        back[:3, :3] = z_up_rotation(self.up_axis).T
        scene = trimesh.Scene()
        scene.add_geometry(arm, transform=trimesh.transformations.translation_matrix([0.3, 0, 0]))
        scene.add_geometry(plate)
        scene.apply_transform(back)
        return scene


def render(source, item, modality):
    rotations = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.7, 0.4]))[
        None, :3, :3
    ]
    mesh = prepare_mesh(source.load(item), up_axis=source.up_axis)
    renderer = get_renderer("embree")
    return renderer.render(mesh, rotations, camera=Camera(), image_size=48, modality=modality)


@pytest.mark.parametrize("up_axis", UP_AXES)
def test_the_turn_is_a_rotation_that_takes_the_axis_up(up_axis):
    rotation = z_up_rotation(up_axis)
    axis = np.zeros(3)
    axis["xyz".index(up_axis[-1])] = -1 if up_axis[0] == "-" else 1
    np.testing.assert_allclose(rotation @ axis, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1)
    tetrahedron = trimesh.Trimesh(np.eye(4)[:, :3], [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    used = prepare_mesh(tetrahedron, up_axis=up_axis).object_from_mesh[:3, :3]
    np.testing.assert_allclose(used / np.cbrt(np.linalg.det(used)), rotation, atol=1e-12)


@pytest.mark.parametrize("up_axis", ["z", "y"])
def test_all_layouts_give_the_same_pictures(tmp_path, up_axis):
    source = Painted(up_axis)
    items = source.items(["bed", "toilet"])
    export_modelnet_layout(source, items, tmp_path / "aligned")
    export_shapenet_layout(source, items, tmp_path / "shapenet")
    shapenet = ShapeNet55(tmp_path / "shapenet")
    assert shapenet.up_axis == "y"
    assert shapenet.synset_of("toilet") == synset_for("toilet")
    for item in items:
        (copy,) = shapenet.items([item.class_name])
        assert copy.instance_id == item.instance_id
        # Face colours and plain materials are rounded in different places.
        for modality, tolerance in (("depth", 1), ("gray", 1), ("rgb", 4)):
            original, again = render(source, item, modality), render(shapenet, copy, modality)
            assert (original != 255).any()
            difference = np.abs(original.astype(int) - again.astype(int))
            assert (difference > tolerance).mean() < 0.002  # rays that graze an edge may differ
    modelnet = ModelNet40(tmp_path / "aligned")
    with pytest.raises(ValueError, match="toilet"):
        shapenet.items(["nothing"])
    (copy,) = modelnet.items(["bed"])
    assert copy.split == "train"
    original, again = render(source, items[0], "depth"), render(modelnet, copy, "depth")
    assert (np.abs(original.astype(int) - again.astype(int)) > 1).mean() < 0.002


def test_a_wrong_frame_would_be_seen(tmp_path):
    source = Painted("z")
    item = source.items(["bed"])[0]
    mistaken = Painted("z")
    mistaken.up_axis = "y"
    mistaken.load = source.load
    assert (render(source, item, "depth") != render(mistaken, item, "depth")).mean() > 0.05


def test_off_keeps_every_bit(tmp_path):
    source = Painted("z")
    items = source.items(["bed"])
    (path,) = export_modelnet_layout(source, items, tmp_path)
    text = path.read_text().splitlines()
    count = int(text[1].split()[0])
    written = np.array([[float(word) for word in line.split()] for line in text[2 : 2 + count]])
    expected = np.concatenate([part.vertices for part in source.load(items[0]).dump()])
    np.testing.assert_array_equal(written, expected)


@pytest.mark.skipif(
    not list(DEBIAN_ROOT.glob("*.sh3f")),
    reason="needs Debian's package sweethome3d-furniture",
)
def test_real_chairs_look_the_same_through_every_layout(tmp_path):
    source = SweetHome()
    items = source.items(["chair"])[::18]
    export_modelnet_layout(source, items, tmp_path / "aligned")
    export_shapenet_layout(source, items, tmp_path / "shapenet")
    copies = {
        "modelnet": (ModelNet40(tmp_path / "aligned"), ("gray", "depth")),
        "shapenet": (ShapeNet55(tmp_path / "shapenet"), ("gray", "depth", "rgb")),
    }
    for copy, modalities in copies.values():
        there = {item.instance_id: item for item in copy.items(["chair"])}
        assert len(there) == len(items)
        for item in items:
            twin = there[item.instance_id]
            for modality in modalities:
                first, second = render(source, item, modality), render(copy, twin, modality)
                assert (first != 255).mean() > 0.02
                differs = np.abs(first.astype(int) - second.astype(int)) > 4
                assert differs.mean() < 0.01, (item.instance_id, modality, differs.mean())
