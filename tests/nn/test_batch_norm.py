import copy

import pytest
import torch
from joint_processes import (
    PixelMajor,
    in_processes,
    layer_in_process,
    layer_step,
    network_in_process,
    network_step,
)
from torch import nn

from i2i.configuration import compose
from i2i.data.noise import noise_batch
from i2i.nn.batch_norm import JointBatchNorm1d, JointBatchNorm2d, update_running
from i2i.nn.c4_dispatch import convolution_mode
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.point_sets import RowNorm
from i2i.runs.building import build_network, info_of

LAYERS = {
    "rows": (JointBatchNorm1d(3), (8, 3)),
    "rows and lengths": (JointBatchNorm1d(3), (8, 3, 5)),
    "maps": (JointBatchNorm2d(3, momentum=None), (6, 3, 4, 5)),
    "without weights": (JointBatchNorm2d(3, affine=False), (6, 3, 4, 5)),
    "without memory": (JointBatchNorm2d(3, track_running_stats=False), (6, 3, 4, 5)),
    "one row each": (RowNorm(3), (2, 3)),
    "C4 fields": (C4BatchNorm(3), (6, 12, 4, 4)),
    "pixel-major": (PixelMajor(3), (6, 16, 4, 3)),
    "with a shortcut": (PixelMajor(3, with_shortcut=True), (6, 16, 4, 3)),
    "in two forms": (PixelMajor(3, with_shortcut=True, mixed=True), (6, 16, 4, 3)),
    "torch's own": (nn.BatchNorm2d(3), (6, 3, 4, 5)),
}
# Far from zero: E[x²] − mean² would lose its digits here.
OFFSET = 1e6


def layer_cases(dtype, offset):
    torch.manual_seed(0)
    cases = {}
    for name, (layer, shape) in LAYERS.items():
        # Under autocast the parameters stay in float32.
        module = copy.deepcopy(layer).to(torch.float32 if dtype == torch.bfloat16 else dtype)
        for parameter in module.parameters():
            nn.init.uniform_(parameter, 0.5, 2.0)
        # Another mean and spread in each part, so that local statistics would be wrong.
        x = torch.randn(shape).to(dtype) * 2 + offset
        x[: len(x) // 2] += 3
        cases[name] = (module, x, torch.randn(shape).to(dtype))
    return cases


def joined(parts, *, parameters):
    """What two processes have, as one with the joint batch would: DDP averages the parameters."""
    whole = {}
    for key, first in parts[0].items():
        values = [first, parts[1][key]]
        if key in ("out", "of x"):
            whole[key] = torch.cat(values)
        elif key.startswith("of ") or key == "loss":
            whole[key] = parameters(values)
        else:
            torch.testing.assert_close(values[0], values[1], rtol=0, atol=0)
            whole[key] = first
    return whole


@pytest.fixture(scope="module")
def layers(tmp_path_factory):
    cases = layer_cases(torch.float64, OFFSET)
    return cases, in_processes(layer_in_process, tmp_path_factory.mktemp("layers"), cases)


JOINT = [name for name in LAYERS if name != "torch's own"]


@pytest.mark.parametrize("name", JOINT)
def test_two_processes_are_one_with_the_joint_batch(layers, name):
    cases, parts = layers
    theirs = joined([part[name] for part in parts], parameters=sum)  # of sums, not of means
    torch.testing.assert_close(theirs, layer_step(*cases[name]), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 2e-5), (torch.bfloat16, 5e-2)])
def test_lower_precisions_keep_their_dtype_and_its_accuracy(tmp_path, dtype, atol):
    cases = layer_cases(dtype, offset=1.0)
    parts = in_processes(layer_in_process, tmp_path, cases)
    for name in JOINT:
        theirs = joined([part[name] for part in parts], parameters=sum)
        assert theirs["out"].dtype == theirs["of x"].dtype == dtype, name
        module, x, upstream = cases[name]
        exact = layer_step(module.double(), x.double(), upstream.double())
        wide = {key: value.double() for key, value in theirs.items()}
        torch.testing.assert_close(wide, exact, rtol=2e-2 if atol > 1e-3 else 1e-4, atol=atol)


def test_local_statistics_would_differ(layers):
    cases, parts = layers
    name = "torch's own"
    out = torch.cat([part[name]["out"] for part in parts])
    assert (out - layer_step(*cases[name])["out"]).abs().max() > 0.1


@pytest.mark.parametrize("momentum", [0.1, None])
def test_running_statistics_are_torchs(momentum):
    ours, torchs = JointBatchNorm2d(3, momentum=momentum), nn.BatchNorm2d(3, momentum=momentum)
    for _ in range(3):
        x = torch.randn(4, 3, 5, 5) + 2
        torchs(x)
        var, mean = torch.var_mean(x, (0, 2, 3), correction=0)
        update_running(ours, mean, var, count=torch.tensor(100.0))
    torch.testing.assert_close(ours.state_dict(), torchs.state_dict())


def test_one_process_is_torchs_own_to_the_bit():
    x = torch.randn(4, 3, 5, 5)
    assert torch.equal(JointBatchNorm2d(3)(x), nn.BatchNorm2d(3)(x))


NETWORKS = [
    ("i2i", "pose"), ("cnn_gs", "pose"), ("i2i", "classification"),
    ("pointnet2", "classification"), ("emvn_12", "classification"), ("kpconv", "pose"),
]  # fmt: skip


def network_cases():
    cases = {}
    for model, task in NETWORKS:
        words = [f"model={model}", f"task={task}", "scale=tiny", "data=synthetic"]
        words.append("scale.reg_on=gt_always")
        if model == "pointnet2":
            own = "model.networks.classification"
            words += [f"{own}.dropout=0", f"{own}.random_start=false"]
        config = compose(words)
        info = info_of(config, ("chair",) if task == "pose" else ("chair", "table", "car"))
        torch.manual_seed(0)
        network = build_network(config, info).double()
        batch = {
            name: value.double() if value.is_floating_point() else value
            for name, value in noise_batch(info, 8).items()
        }
        cases[f"{model} {task}"] = (network, batch)
    return cases


@pytest.fixture(scope="module", params=["dense", "spectral"])
def networks(request, tmp_path_factory):
    cases = network_cases()
    folder = tmp_path_factory.mktemp("networks")
    parts = in_processes(network_in_process, folder, cases, request.param)
    with convolution_mode(request.param):
        return {
            name: (network_step(*case), [part[name] for part in parts])
            for name, case in cases.items()
        }


@pytest.mark.parametrize("name", [" ".join(pair) for pair in NETWORKS])
def test_networks_have_the_loss_and_the_gradient_of_the_joint_batch(networks, name):
    alone, parts = networks[name]
    theirs = joined(parts, parameters=lambda values: sum(values) / len(values))
    torch.testing.assert_close(theirs, alone, rtol=1e-7, atol=1e-9)
