"""Kernel-point convolutions against their definition, and what their network does not notice."""

import pytest
import torch

from i2i.geometry.points import grid_subsample, normalize_points
from i2i.nn.kernel_point_conv import (
    BottleneckBlock,
    KernelPointConv,
    KernelPointTrunk,
    find_neighbours,
)


def stack(sizes, *, scale=1.0):
    generator = torch.Generator().manual_seed(0)
    points = scale * torch.randn(sum(sizes), 3, generator=generator, dtype=torch.float64)
    return points, torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))


def test_a_convolution_against_loops():
    torch.manual_seed(0)
    points, batch = stack([20, 30])
    places, place_batch = points[::3] + 0.01, batch[::3]
    features = torch.randn(50, 3, dtype=torch.float64)
    conv, cell = KernelPointConv(3, 4, seed=1).double(), 0.4
    near = find_neighbours(places, place_batch, points, batch, cell=cell, limit=50)
    with torch.no_grad():
        out = conv(features, near)
        for m in range(len(places)):
            expected = torch.zeros(4, dtype=torch.float64)
            for j in range(50):
                x = (points[j] - places[m]) / cell
                if batch[j] != place_batch[m] or x.norm() >= 2.5:
                    continue
                for k in range(15):
                    weight = max(0.0, 1 - float((x - conv.kernel[k]).norm()) / 1.2)
                    expected += weight * features[j] @ conv.weight[k]
            torch.testing.assert_close(out[m], expected, atol=1e-6, rtol=0)


def test_influence_in_single_precision():
    conv = KernelPointConv(1, 1, seed=0)
    offset = 2.5 * torch.randn(200, 4, 3)
    exact = torch.relu(1 - torch.cdist(offset.double(), conv.kernel.double()[None]) / 1.2)
    torch.testing.assert_close(conv.influence(offset).double(), exact, atol=2e-5, rtol=0)


def test_missing_neighbours_count_for_nothing():
    """A cloud has the same features alone and beside one with fuller neighbourhoods."""
    torch.manual_seed(0)
    points, batch = stack([15, 200])
    near = find_neighbours(points, batch, points, batch, cell=0.3, limit=60)
    alone = find_neighbours(points[:15], batch[:15], points[:15], batch[:15], cell=0.3, limit=60)
    assert near.index.shape[1] > alone.index.shape[1]
    assert (near.index < len(points)).all()
    features = torch.randn(215, 8, dtype=torch.float64) - 3  # so that 0 would be the largest
    for strided in (False, True):
        block = BottleneckBlock(8, 8, strided=strided, seed=0).double().eval()
        with torch.no_grad():
            torch.testing.assert_close(block(features, near)[:15], block(features[:15], alone))


def test_the_short_cut_of_a_stride_is_the_largest_of_the_neighbours():
    torch.manual_seed(0)
    points, batch = stack([40])
    places, place_batch = grid_subsample(points, batch, 0.8)
    near = find_neighbours(places, place_batch, points, batch, cell=0.4, limit=40)
    block = BottleneckBlock(4, 4, strided=True, seed=0).double().eval()
    torch.nn.init.zeros_(block.widen[1].weight)  # nothing but the short cut
    features = torch.randn(40, 4, dtype=torch.float64)
    with torch.no_grad():
        out = block(features, near)
    inside = torch.cdist(places, points) < 1.0
    expected = torch.stack([features[row].amax(dim=0) for row in inside])
    torch.testing.assert_close(out, torch.nn.functional.leaky_relu(expected, 0.1))


def test_kernel_points_depend_on_the_seed_and_are_kept():
    one, same, other = (KernelPointConv(1, 2, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(one.kernel, same.kernel)
    assert not torch.equal(one.kernel, other.kernel)
    radius = one.kernel.norm(dim=1) / 2.5
    assert radius[0] < 0.05
    assert abs(radius[1:].mean() - 0.66) < 0.02
    assert radius[1:].std() < 0.03
    assert torch.cdist(one.kernel, one.kernel)[~torch.eye(15, dtype=torch.bool)].min() > 0.8
    other.load_state_dict(one.state_dict())
    assert torch.equal(one.kernel, other.kernel)


def test_kernels_of_a_network_differ_from_layer_to_layer():
    kernels = [
        module.kernel for module in KernelPointTrunk(width=4, cell=0.2).modules()
        if isinstance(module, KernelPointConv)
    ]  # fmt: skip
    assert len(kernels) == 14
    assert len({tuple(kernel.flatten().tolist()) for kernel in kernels}) == 14


@pytest.mark.parametrize("neighbours", [48, 3])
def test_a_cloud_has_the_same_feature_alone_and_in_company(neighbours):
    torch.manual_seed(0)
    trunk = KernelPointTrunk(width=4, cell=0.2, neighbours=neighbours).eval()
    points = normalize_points(torch.randn(3, 200, 3))
    points[1] *= 0.3  # fewer cells
    with torch.no_grad():
        together = trunk(points)
        alone = torch.cat([trunk(cloud[None]) for cloud in points])
    torch.testing.assert_close(together, alone)
    assert together.shape == (3, trunk.out_channels)


def test_trunk_refuses():
    for options in ({"width": 3}, {"cell": 0.0}, {"levels": 0}):
        with pytest.raises(ValueError, match="must be even"):
            KernelPointTrunk(**{"width": 4, "cell": 0.1} | options)
