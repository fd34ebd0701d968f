"""The pose baselines: counts, one step, overfitting, symmetry, joint classes, labels."""

import copy
import inspect
from functools import partial

import pytest
import torch

from i2i.geometry.rotations import (
    axis_rotation,
    geodesic_angle_rad,
    quaternion_wxyz_from_rotation,
    random_rotations,
)
from i2i.models.cnn_gs import GramSchmidtPose
from i2i.models.cnn_ier import RefinementPose
from i2i.models.cnn_procrustes import ProcrustesPose
from i2i.models.cnn_s3exp import SphericalPose
from i2i.models.e2cnn_eq import InPlanePose
from i2i.models.pooled import RotationLoss
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.resnet import ResNet18
from i2i.nn.resnet50 import ResNet50

PLAIN = partial(ResNet18, width=4, max_pool=False)
DEEP = partial(ResNet50, width=2, max_pool=False)
TURNING = partial(
    C4ResNet18, width=2, basis="full", max_pool=False, stem_mode="k4", layer_strides=(2, 1, 1)
)
TOYS = {
    "cnn_gs": partial(GramSchmidtPose, PLAIN),
    "cnn_procrustes": partial(ProcrustesPose, PLAIN),
    "cnn_ier": partial(RefinementPose, PLAIN, hidden=8),
    "cnn_s3exp": partial(SphericalPose, DEEP, hidden=16, head_std=0.1),
    "e2cnn_eq": partial(InPlanePose, TURNING),
}
every = pytest.mark.parametrize("name", list(TOYS))


def make(name, *, classes=1, channels=1, size=32, **options):
    torch.manual_seed(0)
    return TOYS[name](channels=channels, num_classes=classes, image_size=size, **options)


def make_batch(n=6, *, classes=1, size=32, channels=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "image": torch.rand(n, channels, size, size, generator=generator),
        "rotation": random_rotations(n, generator).float(),
        "class_id": torch.arange(n) % classes,
    }


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("network", "gray", "rgb"),
    [
        (partial(GramSchmidtPose, ResNet18), 11_176_006, 11_179_206),
        (partial(ProcrustesPose, ResNet18), 11_177_545, 11_180_745),
        (partial(RefinementPose, ResNet18), 11_444_818, 11_448_018),
        (partial(SphericalPose, ResNet50), 27_595_332, 27_601_604),
        (partial(InPlanePose, partial(C4ResNet18, width=38)), 10_585_058, 10_585_894),
    ],
    ids=list(TOYS),
)
def test_parameters_of_the_paper(network, gray, rgb):
    for channels, expected in ((1, gray), (3, rgb)):
        assert count(network(channels=channels, num_classes=1, image_size=128)) == expected


def test_parameters_of_ten_classes():
    network = SphericalPose(ResNet50, channels=3, num_classes=10, image_size=128)
    assert count(network) == 27_709_280  # the original's, for its ten categories
    joint, single = make("cnn_gs", classes=10), make("cnn_gs")
    assert count(joint) - count(single) == 10 * 6


@every
@pytest.mark.parametrize("channels", [1, 3])
def test_batch_of_one_and_determinism(name, channels):
    network, batch = make(name, channels=channels), make_batch(4, channels=channels)
    alone = {key: value[:1] for key, value in batch.items()}
    loss = sum(network.train().loss(network(alone), alone).values())
    assert torch.isfinite(loss)
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
    assert torch.equal(first.rotation, second.rotation)
    torch.testing.assert_close(one.rotation, first.rotation[:1], atol=1e-4, rtol=0)


@every
def test_state_dict_restores_the_network(name):
    network, other, batch = make(name), make(name), make_batch(3)
    network.train()(batch)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    other.load_state_dict(copy.deepcopy(network.state_dict()), strict=True)
    with torch.no_grad():
        assert torch.equal(network.eval()(batch).rotation, other.eval()(batch).rotation)


@every
def test_mixed_precision_keeps_rotations_and_losses_in_float32(name):
    network, batch = make(name), make_batch(4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        losses = network.loss(prediction, batch)
    assert prediction.rotation.dtype == torch.float32
    product = prediction.rotation @ prediction.rotation.mT
    torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-5, rtol=0)
    assert {value.dtype for value in losses.values()} == {torch.float32}
    sum(losses.values()).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


@every
def test_float64(name):
    network, batch = make(name).double(), make_batch(3)
    wide = {key: v.double() if v.is_floating_point() else v for key, v in batch.items()}
    prediction = network(wide)
    assert prediction.rotation.dtype == torch.float64
    assert sum(network.loss(prediction, wide).values()).dtype == torch.float64


@every
def test_joint_networks_see_the_class(name):
    network, batch = make(name, classes=3).eval(), make_batch(6, classes=3)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    other = {**batch, "class_id": (batch["class_id"] + 1) % 3}
    with torch.no_grad():
        moved = geodesic_angle_rad(network(batch).rotation, network(other).rotation)
    assert moved.min() > 1e-4
    with pytest.raises(ValueError, match="class_id"):
        network({"image": batch["image"]})
    # A network of one class takes no notice.
    single = make(name).eval()
    with torch.no_grad():
        assert torch.equal(single(batch).rotation, single({"image": batch["image"]}).rotation)


@every
def test_the_target_is_the_rotation_and_not_its_inverse(name):
    """A prediction equal to the label has no loss; its transpose has."""
    network, batch = make(name), make_batch(16)
    if name == "cnn_s3exp":

        def exact(rotation):
            prediction = network(batch)
            q = quaternion_wxyz_from_rotation(rotation)
            number = ((q[:, 1:] >= 0) * torch.tensor([4, 2, 1])).sum(dim=1)
            logits = 100.0 * torch.nn.functional.one_hot(number, 8)
            prediction.extras |= {"quaternion_size": q.abs(), "sign_logits": logits}
            return prediction
    else:

        def exact(rotation):
            prediction = network(batch)
            prediction.rotation = rotation
            return prediction

    right = sum(network.loss(exact(batch["rotation"]), batch).values())
    wrong = sum(network.loss(exact(batch["rotation"].mT), batch).values())
    assert right < 1e-4
    assert wrong > 0.5


def test_losses_against_their_definition():
    generator = torch.Generator().manual_seed(0)
    a, b = random_rotations(9, generator), random_rotations(9, generator)
    # |A − B|_F = 2√2 sin(angle / 2) for rotations.
    chord = 8**0.5 * torch.sin(geodesic_angle_rad(a, b) / 2)
    torch.testing.assert_close(RotationLoss("frobenius")(a, b), chord.mean())
    torch.testing.assert_close(RotationLoss("mse")(a, b), chord.square().mean() / 9)
    with pytest.raises(ValueError, match="frobenius, mse"):
        make("cnn_gs", loss="l1")
    for name in ("cnn_gs", "cnn_procrustes", "cnn_ier", "e2cnn_eq"):
        assert inspect.signature(TOYS[name].func).parameters["loss"].default == "frobenius"
        network, batch = make(name, loss="mse"), make_batch(3)
        prediction = network(batch)
        expected = torch.nn.functional.mse_loss(prediction.rotation, batch["rotation"])
        torch.testing.assert_close(network.loss(prediction, batch), {"regression": expected})


def test_loss_has_a_finite_gradient_at_a_perfect_prediction():
    rotation = torch.eye(3)[None].requires_grad_()
    RotationLoss()(rotation, torch.eye(3)[None]).backward()
    assert torch.isfinite(rotation.grad).all()


def test_s3exp_loss_against_its_definition():
    network, batch = make("cnn_s3exp"), make_batch(5)
    prediction = network(batch)
    losses = network.loss(prediction, batch)
    size, logits = prediction.extras["quaternion_size"], prediction.extras["sign_logits"]
    log_probability = torch.log_softmax(logits, dim=1)
    cosine = sign = 0.0
    for i, rotation in enumerate(batch["rotation"].double()):
        # From the eigenvector of the rotation and its angle, not from our own conversion.
        half = torch.arccos(((rotation.trace() - 1) / 2).clamp(-1, 1)) / 2
        axis = torch.stack([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0],
                            rotation[1, 0] - rotation[0, 1]])  # fmt: skip
        axis = axis / axis.norm()
        q = torch.cat([half.cos()[None], half.sin() * axis]).float()
        cosine += 1 - (q.abs() @ size[i]) / 5 - 0.8  # five times (1 − cos) / 5
        digits = "".join("1" if value >= 0 else "0" for value in q[1:])
        sign -= log_probability[i, int(digits, 2)] / 5
    torch.testing.assert_close(losses["size"], 10 * cosine, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(losses["sign"], sign, atol=1e-5, rtol=1e-4)


def test_ier_starts_as_gs():
    """With the same weights up to the first layer, both networks are one at initialisation."""
    ier, gs, batch = make("cnn_ier"), make("cnn_gs"), make_batch(5)
    missing = gs.load_state_dict(
        {k: v for k, v in ier.state_dict().items() if "corrections" not in k}, strict=True
    )
    assert not missing.missing_keys
    assert torch.equal(ier.eval()(batch).rotation, gs.eval()(batch).rotation)


def _turn_errors_deg(stem_mode, *, size=32):
    """Angle between R(rot90 x) and Rz(90°) R(x) for noise, for the three turns."""
    torch.manual_seed(0)
    encoder = partial(TURNING, stem_mode=stem_mode)
    network = InPlanePose(encoder, channels=1, num_classes=1, image_size=size)
    batch = make_batch(8, size=size)
    network.train()(batch)  # running statistics of real activations
    torch.nn.init.normal_(network.out_of_plane.linear.weight)
    network.eval()
    errors = []
    with torch.no_grad():
        still = network(batch)
        for turns in (1, 2, 3):
            turned = network({"image": torch.rot90(batch["image"], turns, dims=(2, 3))})
            expected = axis_rotation("z", 90.0 * turns).float() @ still.rotation
            errors.append(geodesic_angle_rad(turned.rotation, expected))
            if stem_mode != "ref":
                torch.testing.assert_close(
                    turned.extras["out_of_plane"], still.extras["out_of_plane"], atol=1e-4, rtol=0
                )
    return torch.rad2deg(torch.stack(errors))


@pytest.mark.parametrize(("stem_mode", "size"), [("k4", 32), ("pool", 32), ("odd", 33)])
def test_in_plane_network_turns_with_the_image(stem_mode, size):
    assert _turn_errors_deg(stem_mode, size=size).max() < 0.01


def test_published_stem_does_not_turn_with_noise():
    assert _turn_errors_deg("ref").median() > 5


def test_in_plane_network_needs_fields():
    with pytest.raises(TypeError, match="c4_resnet18"):
        InPlanePose(PLAIN, channels=1, num_classes=1, image_size=32)


def test_a_ready_module_serves_as_encoder():
    encoder = PLAIN(1, image_size=32)
    network = GramSchmidtPose(encoder, channels=1, num_classes=1, image_size=32)
    assert network.encoder is encoder
    with pytest.raises(TypeError, match="out_channels"):
        GramSchmidtPose(torch.nn.Identity(), channels=1, num_classes=1, image_size=32)
