"""With an edge of the mesh to the viewer, the whole network turns with the image by 180°."""

from functools import partial

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron, nearest_element
from i2i.geometry.rotations import axis_rotation, random_rotations
from i2i.models.i2i import I2IPose
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.group_conv_variants import FullGroupConv, UnconstrainedMap, VectorFilterConv
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import GroupElementProjector, IcosahedralProjector
from i2i.nn.resnet import ResNet18
from i2i.testing import paint_maps, random_field

HALF_TURN = axis_rotation("z", 180.0).float()
# Float32 through the network; the rotations' entries are at most 1.
TOLERANCE = 1e-4


def pose(
    axis, *, level=1, layer=DynamicFilterConv, stem_mode="k4", encoder=None, size=32, **options
):
    torch.manual_seed(0)
    exact = partial(
        C4ResNet18, width=2, basis="full", max_pool=False, stem_mode=stem_mode,
        layer_strides=(2, 1, 1),
    )  # fmt: skip
    projector = partial(IcosahedralProjector, mesh_level=level, mesh_axis=axis, sigma=0.35)
    group_conv = partial(layer, 16, mesh_axis=axis)
    if layer is FullGroupConv:
        projector = partial(GroupElementProjector, mesh_axis=axis, sigma=0.35)
        group_conv = partial(group_conv, support="local13")
    else:
        group_conv = partial(group_conv, mesh_level=level)
    network = I2IPose(
        encoder or exact, projector, group_conv, channels=1, num_classes=1, image_size=size,
        **options,
    )  # fmt: skip
    with torch.no_grad():
        for seed in range(5):
            network({"image": images(16, size, seed)})  # moves the running statistics
    return network.eval()


def images(count, size, seed):
    """Smooth random pictures: their maps differ more than those of white noise."""
    coarse = torch.rand(count, 1, 4, 4, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, size=(size, size), mode="bicubic").clamp(0, 1)


@torch.no_grad()
def both(network, size=32):
    image = images(32, size, seed=1)
    turned = torch.rot90(image, 2, (-2, -1))
    return network({"image": image}), network({"image": turned})


def error(upright, turned):
    """Largest entry of the difference from Rz(180°) times the upright prediction."""
    return (turned.rotation - HALF_TURN @ upright.rotation).abs().max().item()


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("layer", [DynamicFilterConv, VectorFilterConv])
@pytest.mark.parametrize(("stem_mode", "size"), [("k4", 32), ("pool", 32), ("odd", 33)])
def test_the_prediction_turns_with_the_image(layer, level, stem_mode, size):
    network = pose("twofold", layer=layer, level=level, stem_mode=stem_mode, size=size)
    upright, turned = both(network, size)
    assert error(upright, turned) < TOLERANCE
    assert len(upright.logits.argmax(dim=1).unique()) > 1  # not one element for all images
    assert (turned.rotation - upright.rotation).abs().max() > 0.1


def test_the_outputs_are_permuted_by_the_half_turn_and_residuals_stay():
    """`out(rot180 x)[g] = out(x)[g s]` with s the half turn, all 60 elements of it."""
    mesh = icosahedron(mesh_axis="twofold")
    s = int(mesh.viewing_turns[1])
    upright, turned = both(pose("twofold"))
    moved = mesh.multiplication[:, s]
    torch.testing.assert_close(turned.logits, upright.logits[:, moved], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(
        turned.extras["residual"], upright.extras["residual"][:, moved], atol=1e-3, rtol=0
    )
    assert not torch.allclose(turned.logits, upright.logits, atol=1e-2)


@pytest.mark.parametrize(
    "network",
    [
        partial(pose, "vertex"),
        partial(pose, "vertex", level=0),
        partial(pose, "twofold", stem_mode="ref"),
        partial(pose, "twofold", encoder=partial(ResNet18, width=4, layer_strides=(2, 1, 1))),
        partial(pose, "twofold", layer=UnconstrainedMap),
        # Its 13 samples do not go into each other.
        partial(pose, "twofold", layer=FullGroupConv),
        # The published label: the elements of the object's rotation are not permuted so.
        partial(pose, "twofold", target="rotation"),
    ],
    ids=["vertex", "vertex sparse", "inexact stem", "plain encoder", "no group convolution",
         "local13", "published target"],
)  # fmt: skip
def test_everything_else_does_not_turn(network):
    assert error(*both(network())) > 0.1


def test_quarter_turns_are_not_shared():
    network = pose("twofold")
    image = images(32, 32, seed=1)
    with torch.no_grad():
        upright, turned = (
            network({"image": torch.rot90(image, k, (-2, -1))}).rotation for k in (0, 1)
        )
    assert (turned - axis_rotation("z", 90.0).float() @ upright).abs().max() > 0.1


def test_labels_refer_to_the_group_of_the_mesh():
    network = pose("twofold")
    mesh = icosahedron(mesh_axis="twofold")
    torch.testing.assert_close(network.elements, mesh.rotations.float())
    rotation = random_rotations(50).float()
    label = network.group_target({"rotation": rotation})
    assert torch.equal(label.element, nearest_element(rotation.mT, mesh.rotations)[0])
    # The object turned by 180° in the picture: element g s, the same residual.
    after = network.group_target({"rotation": HALF_TURN @ rotation})
    moved = mesh.multiplication[label.element, int(mesh.viewing_turns[1])]
    assert torch.equal(after.element, moved)
    take = torch.arange(50)
    torch.testing.assert_close(
        after.residual[take, after.element], label.residual[take, label.element],
        atol=1e-5, rtol=0,
    )  # fmt: skip


def test_a_perfect_encoder_finds_the_element_of_the_view():
    """The chain of painting, sampling and correlating has no sign wrong in this frame either."""
    mesh = icosahedron(mesh_axis="twofold")
    projector = IcosahedralProjector(256, 1, map_size=8, mesh_axis="twofold").double()
    layer = DynamicFilterConv(256, 1, mesh_axis="twofold").double()
    torch.nn.init.zeros_(layer.bias)
    other = icosahedron()
    hits = torch.zeros(4)
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        field, views = random_field(generator=generator), random_rotations(400, generator)
        psi = projector.sample(paint_maps(field, views, map_size=8, coverage=0.9))
        with torch.no_grad():
            layer.sphere.copy_(field(mesh.directions)[None])
            best = layer(psi).squeeze(-1).argmax(dim=1)
        two = torch.einsum("bij,gij->bg", views, mesh.rotations).topk(2, dim=1).indices
        hits[0] += (best == two[:, 0]).sum()
        hits[1] += (best[:, None] == two).any(dim=1).sum()
        hits[2] += (best == nearest_element(views.mT, mesh.rotations)[0]).sum()
        hits[3] += (best == nearest_element(views, other.rotations)[0]).sum()
    nearest, one_of_two, wrong_inverse, wrong_frame = (hits / 2000).tolist()
    assert nearest > 0.85
    assert one_of_two > 0.97
    assert wrong_inverse < 0.5
    assert wrong_frame < 0.5
