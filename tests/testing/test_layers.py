"""Layers say what they commute with; the actions are those of the groups that they stand for."""

import math

import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import nn

from i2i.geometry.icosahedron import icosahedron
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.group_conv_variants import FullGroupConv, UnconstrainedMap, VectorFilterConv
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import IcosahedralProjector
from i2i.testing.layers import (
    axis_turns,
    find_claims,
    icosahedral_turns,
    mesh_of,
    quarter_turns,
    turn_raster,
)


def triples(module):
    return [(c.path, c.input, c.output) for c in find_claims(module)]


def encoder(**options):
    settings = {"width": 1, "image_size": 16, "stem_mode": "k4", "layer_strides": (2, 1)}
    return C4ResNet18(1, **{**settings, "max_pool": False, **options})


def test_an_encoder_claims_its_fields_and_its_map():
    expected = [("stem", "map", "regular")]
    expected += [(f"blocks.{i}", "regular", "regular") for i in range(4)]
    assert triples(encoder()) == [*expected, ("", "map", "map")]
    assert ("max_pool", "regular", "regular") in triples(encoder(max_pool=True))


@pytest.mark.parametrize(
    ("layer", "kinds"),
    [
        (DynamicFilterConv(2, 3), ["sphere", "signal"]),
        (VectorFilterConv(2, 3), ["sphere", "signal"]),
        (FullGroupConv(2, 3), ["sphere"]),
        (UnconstrainedMap(2, 3, in_channels=4), []),
        (nn.Linear(2, 3), []),
    ],
)
def test_what_a_layer_on_the_group_claims(layer, kinds):
    assert triples(layer) == [("", kind, "group") for kind in kinds]


def test_claims_of_parts_carry_their_path():
    network = nn.ModuleDict({"a": nn.Sequential(IcosahedralProjector(2, 3, map_size=4))})
    assert triples(network) == [("a.0", "map", "signal")]


class Own(nn.Module):
    def __init__(self, said):
        super().__init__()
        self.conv, self.said = nn.Conv2d(1, 4, 1), said

    def claims(self):
        return self.said


def test_a_module_speaks_for_itself():
    network = nn.Sequential(Own([("conv", "map", "regular"), ("", "map", "invariant")]))
    assert triples(network) == [("0.conv", "map", "regular"), ("0", "map", "invariant")]


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (("conv", "map", "sideways"), "sideways"),
        (("conv", "regular", "group"), "of one group"),
        (("nothing", "map", "map"), "no such module"),
        (("conv", "map", "signal"), "attribute `mesh`"),
    ],
)
def test_a_claim_that_makes_no_sense_is_refused(said, message):
    with pytest.raises(ValueError, match=message):
        find_claims(Own([said]))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_mesh_follows_from_the_number_of_vertices(level):
    conv = DynamicFilterConv(2, 1, mesh_level=level)
    assert mesh_of(conv) is icosahedron(level)
    own = nn.Identity()
    own.mesh = icosahedron(level)
    assert mesh_of(own) is icosahedron(level)


@pytest.mark.parametrize(
    "symmetry", [quarter_turns(), axis_turns(icosahedron(1)), icosahedral_turns(icosahedron(0))]
)
def test_the_control_is_another_element(symmetry):
    pairs = zip(symmetry.elements, symmetry.wrong, strict=True)
    assert all(element != wrong for element, wrong in pairs)
    assert len(symmetry.labels) == len(symmetry.elements)


@pytest.mark.parametrize("frame", ["conjugated", "standard"])
def test_turns_about_the_axis_are_the_five(frame):
    symmetry = axis_turns(icosahedron(1, frame))
    assert symmetry.name == "C5"
    assert symmetry.elements == (1, 2, 3, 4)
    assert symmetry.labels == ("72°", "144°", "216°", "288°")


def test_a_mesh_with_an_edge_to_the_viewer_shares_the_half_turn_with_the_pixels():
    projector = IcosahedralProjector(2, 3, map_size=4, mesh_axis="twofold")
    (claim,) = find_claims(projector)
    assert claim.symmetry.name == "C2"
    assert claim.symmetry.labels == ("180°",)
    image, half_turn = torch.rand(1, 2, 4, 4), claim.symmetry.elements[0]
    turned = projector(claim.symmetry.actions["map"](half_turn, image))
    expected = claim.symmetry.actions["signal"](half_turn, projector(image))
    torch.testing.assert_close(turned, expected)
    assert not torch.allclose(turned, projector(image), atol=1e-2)


@pytest.mark.parametrize("every", [False, True])
def test_a_signal_is_turned_as_the_directions_are(every):
    """ψ'(v) = ψ(R⁻¹ v), looked up by coordinates."""
    mesh = icosahedron(1)
    points = mesh.vertices if every else mesh.vertices[mesh.visible]
    signal = torch.randn(1, len(points), 2)
    symmetry = axis_turns(mesh)
    for element in symmetry.elements:
        source = points @ mesh.rotations[element]  # R⁻¹ v for each row v
        nearest = torch.cdist(source, points).argmin(dim=1)
        turned = symmetry.actions["signal"](element, signal)
        assert torch.equal(turned, signal[:, nearest])


def test_rasters_turn_counter_clockwise_by_any_angle():
    blob = torch.zeros(1, 1, 33, 33)
    blob[0, 0, 14:19, 24:29] = 1.0  # to the right of the centre
    angle = math.radians(72.0)
    turned = turn_raster(blob, 72.0)[0, 0]
    row, column = 16 - 10 * math.sin(angle), 16 + 10 * math.cos(angle)
    weights = turned / turned.sum()
    offset = torch.arange(33.0)
    assert (weights.sum(1) * offset).sum().item() == pytest.approx(row, abs=0.05)
    assert (weights.sum(0) * offset).sum().item() == pytest.approx(column, abs=0.05)
    assert torch.equal(turn_raster(blob, 270.0), torch.rot90(blob, 3, (-2, -1)))


def test_resampling_agrees_with_scipy_inside():
    size, angle = 21, math.radians(144.0)
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    image = torch.sin(2 * x + 0.5) * torch.cos(1.5 * y)
    turned = turn_raster(image[None, None].double(), 144.0)[0, 0]
    c = (size - 1) / 2
    rows, columns = torch.meshgrid(torch.arange(size) - c, torch.arange(size) - c, indexing="ij")
    source = torch.stack(
        [
            math.sin(angle) * columns + math.cos(angle) * rows + c,
            math.cos(angle) * columns - math.sin(angle) * rows + c,
        ]
    )
    expected = map_coordinates(image.double().numpy(), source.numpy(), order=3)
    inside = rows**2 + columns**2 < (c - 2) ** 2
    torch.testing.assert_close(
        turned[inside], torch.from_numpy(expected)[inside], atol=0.02, rtol=0
    )
