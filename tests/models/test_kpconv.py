"""Rigid KPConv: counts, learning, and what it does and does not notice."""

import copy

import pytest
import torch

from i2i.configuration import compose
from i2i.geometry.points import normalize_points
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.models.kpconv import KernelPointClassifier, KernelPointPose

TOYS = {"classification": KernelPointClassifier, "pose": KernelPointPose}
every = pytest.mark.parametrize("task", list(TOYS))


def make(task, *, classes=None, **options):
    torch.manual_seed(0)
    classes = classes or (1 if task == "pose" else 4)
    return TOYS[task](
        num_points=128, num_classes=classes, **{"width": 4, "cell": 0.2} | options
    )  # fmt: skip


def make_batch(n=6, *, points=128, classes=4, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    cloud = torch.randn(n, points, 3, generator=generator, dtype=dtype)
    return {
        "points": normalize_points(cloud),
        "rotation": random_rotations(n, generator).to(dtype),
        "class_id": torch.arange(n) % classes,
    }


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def total(network, batch):
    return sum(network.loss(network(batch), batch).values())


def output(prediction):
    return prediction.logits if hasattr(prediction, "descriptor") else prediction.rotation


def train(network, batch, steps):
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    for _ in range(steps):
        optimiser.zero_grad()
        total(network, batch).backward()
        optimiser.step()


def test_parameters_of_the_published_network():
    network = KernelPointClassifier(num_points=8192, num_classes=40)
    assert count(network) == 6_143_688
    assert count(network.trunk) == 5_053_088
    pose = KernelPointPose(num_points=1024, num_classes=1)
    assert count(pose) == 5_053_088 + 1024 * 1025 + 1025 * 6
    assert count(KernelPointPose(num_points=1024, num_classes=8)) == count(pose) + 8 * 1024


def test_configured_networks():
    for scale, width in (("paper", 32), ("small", 8), ("tiny", 4)):
        for model, task, points in (
            ("kpconv", "classification", "kpconv_points"),
            ("kpconv_rigid", "pose", "num_points"),
        ):
            config = compose([f"model={model}", f"task={task}", f"scale={scale}"])
            assert config.model.networks[task].width == width
            assert config.model.networks[task].cell == config.scale.kpconv_cell
            assert config.model.num_points[task] == config.scale[points]


@every
def test_batch_of_one_and_determinism(task):
    network, batch = make(task), make_batch(4)
    alone = {key: value[:1] for key, value in batch.items()}
    network.train()(batch)
    loss = total(network, alone)
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
        more = network(make_batch(2, points=50))
    assert torch.equal(output(first), output(second))
    torch.testing.assert_close(output(one), output(first)[:1], atol=1e-4, rtol=1e-4)
    assert len(output(more)) == 2


@every
def test_clouds_of_a_single_place(task):
    network = make(task)
    batch = make_batch(2) | {"points": torch.zeros(2, 128, 3)}
    assert torch.isfinite(total(network, batch))


@every
def test_mixed_precision_gives_float32(task):
    network, batch = make(task), make_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        losses = network.loss(prediction, batch)
    assert {value.dtype for value in losses.values()} == {torch.float32}
    assert output(prediction).dtype == torch.float32
    sum(losses.values()).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


@every
def test_state_dict_brings_the_kernel_points(task):
    network, other, batch = make(task), make(task, seed=1), make_batch()
    train(network, batch, 2)
    network.eval()
    other.load_state_dict(copy.deepcopy(network.state_dict()), strict=True)
    with torch.no_grad():
        assert torch.equal(output(network(batch)), output(other.eval()(batch)))
        unlike = make(task, seed=1)
        unlike.load_state_dict(
            {k: v for k, v in network.state_dict().items() if "kernel" not in k}, strict=False
        )
        assert not torch.allclose(output(network(batch)), output(unlike.eval()(batch)))


def test_joint_networks_see_the_class():
    network, batch = make("pose", classes=3), make_batch(classes=3)
    train(network, batch, 2)
    network.eval()
    other = {**batch, "class_id": (batch["class_id"] + 1) % 3}
    with torch.no_grad():
        moved = geodesic_angle_rad(network(batch).rotation, network(other).rotation)
    assert moved.min() > 1e-4
    with pytest.raises(ValueError, match="class_id"):
        network({"points": batch["points"]})


def test_descriptor_is_what_the_classifier_sees():
    network, batch = make("classification").eval(), make_batch()
    with torch.no_grad():
        prediction = network(batch)
        logits = network.classifier(prediction.descriptor)
    assert prediction.descriptor.shape == (6, 128)
    torch.testing.assert_close(prediction.logits, logits)


def test_the_target_is_the_rotation_and_not_its_inverse():
    network, batch = make("pose"), make_batch(16)
    prediction = network(batch)
    prediction.rotation = batch["rotation"]
    assert network.loss(prediction, batch)["regression"] < 1e-5
    prediction.rotation = batch["rotation"].mT
    assert network.loss(prediction, batch)["regression"] > 0.5
    with pytest.raises(ValueError, match="frobenius, mse"):
        make("pose", loss="l1")


def change(change_points, *, task="classification"):
    """Relative change of a trained network's feature by a change of the points, in float64."""
    network, batch = make(task).double(), make_batch(points=300, dtype=torch.float64)
    train(network, batch, 5)
    network.eval()
    with torch.no_grad():
        still = network.trunk(batch["points"])
        moved = network.trunk(change_points(batch["points"]))
    return ((moved - still).norm() / still.norm()).item()


def test_neither_order_nor_place_of_a_cloud_has_an_influence():
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    assert change(lambda points: points[:, order]) < 1e-12
    assert change(lambda points: points + torch.tensor([0.3, -2.0, 0.7])) < 1e-9


def test_duplicates_have_an_influence_by_the_means_of_cells_alone():
    assert change(lambda points: torch.cat([points, points], dim=1)) < 1e-12


def test_turned_and_mirrored_clouds_are_other_clouds():
    """Rigid kernels have directions: nothing makes the network invariant."""
    turn = random_rotations(1, torch.Generator().manual_seed(0))[0]
    assert change(lambda points: points @ turn.T) > 1e-2
    assert change(lambda points: points * torch.tensor([-1.0, 1.0, 1.0])) > 1e-2
