"""Convolutions on points × anchors: the written-out sums, all 60 rotations, memory."""

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.points import normalize_points
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.nn import anchor_conv
from i2i.nn.anchor_conv import (
    AnchorGroupConv,
    AnchorNorm,
    AnchorPointConv,
    SeparableLayer,
    group_taps,
    neighbourhood,
    turned_kernel,
)
from i2i.nn.kernel_points import kernel_points

MESH = icosahedron(0)
ROTATIONS = MESH.rotations


def cloud(batch=2, size=24, *, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return normalize_points(torch.randn(batch, size, 3, generator=generator, dtype=torch.float64))


def exact(layer):
    """A layer in float64, its kernels too, which modules keep in float32."""
    layer = layer.double()
    for module in layer.modules():
        if isinstance(module, AnchorPointConv):
            anchors = ROTATIONS[: len(module.kernel)]
            size = module.weight.shape[2]
            module.kernel = turned_kernel(anchors, radius=module.radius, size=size)
    return layer


@pytest.mark.parametrize("anchors", [1, 60])
@pytest.mark.parametrize("in_channels", [1, 3])
def test_point_convolution_is_the_written_out_sum(in_channels, anchors):
    points, radius = cloud(size=9), 0.8
    conv = AnchorPointConv(in_channels, 4, radius=radius, anchors=ROTATIONS[:anchors])
    conv = exact(conv)
    index, offset = neighbourhood(points, 5, radius=radius, count=6)
    features = torch.randn(2, anchors, 9, in_channels, dtype=torch.float64)
    kernel = kernel_points(24, 0.7 * radius)
    expected = torch.zeros(2, anchors, 5, 4, dtype=torch.float64)
    for b in range(2):
        for p in range(5):
            for a in range(anchors):
                for j in index[b, p].tolist():
                    x = points[b, j] - points[b, p]
                    distance = (x - kernel @ ROTATIONS[a].T).square().sum(dim=1)
                    weight = (1 - distance / (radius**2 / 2)).clamp(min=0)  # (K,)
                    expected[b, a, p] += (conv.weight @ weight) @ features[b, a, j]
    with torch.no_grad():
        torch.testing.assert_close(conv(features, index, offset), expected, atol=1e-12, rtol=0)
        if in_channels == 1:
            ones = conv(torch.ones_like(features), index, offset)
            torch.testing.assert_close(conv(None, index, offset), ones, atol=1e-12, rtol=0)
        single = conv.float()(features.float(), index, offset.float())
    torch.testing.assert_close(single.double(), expected, atol=1e-5, rtol=1e-5)


def test_group_convolution_is_the_written_out_sum():
    """Products of matrices instead of the table."""
    conv = AnchorGroupConv(3).double()
    features = torch.randn(2, 60, 4, 3, dtype=torch.float64)
    expected = torch.zeros_like(features)
    for g in range(60):
        for k, tap in enumerate(group_taps().tolist()):
            product = ROTATIONS[g] @ ROTATIONS[tap]
            place = int((ROTATIONS - product).abs().amax(dim=(1, 2)).argmin())
            expected[:, g] += features[:, place] @ conv.weight[:, :, k].T
    with torch.no_grad():
        torch.testing.assert_close(conv(features), expected, atol=1e-12, rtol=0)


def test_taps():
    taps = group_taps()
    angles = torch.rad2deg(geodesic_angle_rad(ROTATIONS[taps], torch.eye(3).double())).round()
    assert sorted(angles.tolist()) == [0] + 6 * [72] + 2 * [120] + 3 * [180]
    assert set(MESH.inverse[taps].tolist()) == set(taps.tolist())


def turned(h, features):
    """`f'(h g) = f(g)`."""
    moved = torch.empty_like(features)
    moved[:, MESH.multiplication[h]] = features
    return moved


def errors(layer, rotations, dtype, *, elements=range(60)):
    """Relative error for each element h when the cloud is turned by `rotations[h]`."""
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, 60, 24, 3, generator=generator, dtype=torch.float64).to(dtype)
    points = cloud().to(dtype)
    found = []
    with torch.no_grad():
        still = layer(features, points, 8)
        for h in elements:
            out = layer(turned(h, features), points @ rotations[h].T.to(dtype), 8)
            found.append(((out - turned(h, still)).norm() / still.norm()).item())
    return found


@pytest.mark.parametrize("norm", ["instance", "batch"])
def test_a_layer_commutes_with_the_60_rotations(norm):
    layer = SeparableLayer(3, 4, radius=0.8, stride=2, anchors=ROTATIONS, norm=norm).eval()
    assert max(errors(layer, ROTATIONS, torch.float32)) < 1e-5  # 2e-7 measured
    assert max(errors(exact(layer), ROTATIONS, torch.float64)) < 1e-12  # 6e-16 measured


def test_what_a_layer_does_not_commute_with():
    """Other rotations, and the group's multiplication on the wrong side."""
    layer = exact(SeparableLayer(3, 4, radius=0.8, stride=2, anchors=ROTATIONS))
    tilt = random_rotations(1, torch.Generator().manual_seed(3))[0]
    elements = range(1, 60, 7)
    assert min(errors(layer, ROTATIONS @ tilt, torch.float64, elements=elements)) > 0.02
    layer.group_conv.table = MESH.multiplication[group_taps()].T.contiguous()
    assert min(errors(layer, ROTATIONS, torch.float64, elements=elements)) > 0.02


def test_first_layer_commutes_as_well():
    layer = exact(SeparableLayer(1, 4, radius=0.8, stride=2, anchors=ROTATIONS)).eval()
    points = cloud()
    with torch.no_grad():
        still = layer(None, points, 8)
        for h in range(60):
            out = layer(None, points @ ROTATIONS[h].T, 8)
            torch.testing.assert_close(out, turned(h, still), atol=1e-12, rtol=0)


@pytest.mark.parametrize("chunk", [1, 40_000, 1 << 30])
def test_chunks_and_checkpoints_change_nothing(monkeypatch, chunk):
    layer = exact(SeparableLayer(3, 4, radius=0.8, stride=2, anchors=ROTATIONS))
    points, found = cloud(), []
    features = torch.randn(2, 60, 24, 3, dtype=torch.float64, requires_grad=True)
    for size, checkpointing in ((1 << 22, False), (chunk, False), (chunk, True), (chunk, None)):
        monkeypatch.setattr(anchor_conv, "_CHUNK", size)
        for module in (layer.point_conv, layer.group_conv):
            module.checkpointing = checkpointing
        features.grad = None
        layer.zero_grad()
        out = layer(features, points, 8)
        out.square().sum().backward()
        found.append([out.detach(), features.grad, *(p.grad for p in layer.parameters())])
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], atol=1e-10, rtol=1e-10)


def test_checkpoints_keep_less(monkeypatch):
    """What autograd holds on to, counted; large layers do it unasked."""
    points, kept = cloud(size=64).float(), {}
    features = torch.randn(2, 60, 64, 3, requires_grad=True)
    for checkpointing, limit in ((False, 1 << 26), (True, 1 << 26), (None, 1 << 26), (None, 1)):
        monkeypatch.setattr(anchor_conv, "_KEPT", limit)
        layer = SeparableLayer(
            3, 4, radius=0.8, stride=2, anchors=ROTATIONS, checkpointing=checkpointing
        )
        held = {}
        with torch.autograd.graph.saved_tensors_hooks(
            lambda x, held=held: held.update({x.untyped_storage().data_ptr(): x.nbytes}) or x,
            lambda x: x,
        ):
            out = layer(features, points, 16)
        kept[checkpointing, limit] = sum(held.values())
        del out
    assert kept[True, 1 << 26] < 0.4 * kept[False, 1 << 26]
    assert kept[None, 1 << 26] == kept[False, 1 << 26]
    assert kept[None, 1] == kept[True, 1 << 26]


def test_norms_are_those_of_the_library():
    features = torch.randn(3, 60, 5, 4) * 3 + 2
    last = features.permute(0, 3, 1, 2)  # (B, C, A, P)
    expected = torch.nn.InstanceNorm2d(4)(last).permute(0, 2, 3, 1)
    torch.testing.assert_close(AnchorNorm(4, "instance")(features), expected, atol=1e-5, rtol=1e-5)
    expected = torch.nn.BatchNorm2d(4)(last).permute(0, 2, 3, 1)
    torch.testing.assert_close(AnchorNorm(4, "batch")(features), expected, atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="instance, batch"):
        AnchorNorm(4, "layer")


def test_neighbours_are_clipped_to_the_cloud():
    points = cloud(size=6)
    index, offset = neighbourhood(points, 3, radius=10.0, count=64)
    assert index.shape == (2, 3, 6)
    torch.testing.assert_close(offset[1, 2], points[1, index[1, 2]] - points[1, 2])


def test_half_precision_keeps_the_geometry_in_float32(monkeypatch):
    seen = []
    measure = anchor_conv.influence
    monkeypatch.setattr(anchor_conv, "influence", lambda *a: seen.append(measure(*a)) or seen[-1])
    layer = SeparableLayer(3, 4, radius=0.8, stride=2, anchors=ROTATIONS)
    features, points = torch.randn(2, 60, 24, 3), cloud().float()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = layer(features, points, 8)
    out.float().sum().backward()
    assert torch.isfinite(out).all()
    assert {weights.dtype for weights in seen} == {torch.float32}
    assert all(torch.isfinite(p.grad).all() for p in layer.parameters())
    with torch.no_grad():
        difference = (out.float() - layer(features, points, 8)).norm() / out.float().norm()
    assert difference < 0.03


def test_a_deep_layer_needs_features():
    conv = AnchorPointConv(2, 4, radius=0.5, anchors=ROTATIONS)
    with pytest.raises(ValueError, match="2 channels"):
        conv(None, *neighbourhood(cloud(), 4, radius=0.5, count=3))
