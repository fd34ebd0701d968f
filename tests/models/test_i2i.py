"""The whole network: counts, one step, overfitting, symmetry, labels, saving and loading."""

import copy
import math
from functools import partial

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.models.i2i import I2IClassifier, I2IPose
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import IcosahedralProjector
from i2i.nn.resnet import ResNet18
from i2i.testing import assert_c4_equivariant

PAPER = partial(C4ResNet18, width=38)
TOY = partial(
    C4ResNet18, width=2, basis="full", max_pool=False, stem_mode="k4", layer_strides=(2, 1, 1)
)


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def pose(*, encoder=TOY, features=16, level=1, classes=1, channels=1, size=32, **options):
    return I2IPose(
        encoder,
        partial(IcosahedralProjector, mesh_level=level, sigma=0.35),
        partial(DynamicFilterConv, features, mesh_level=level),
        channels=channels,
        num_classes=classes,
        image_size=size,
        **options,
    )


def classifier(*, classes=3, features=16, size=32, encoder=TOY, **options):
    return I2IClassifier(
        encoder,
        partial(IcosahedralProjector, sigma=0.35),
        partial(DynamicFilterConv, features),
        channels=1,
        num_classes=classes,
        image_size=size,
        **options,
    )


def make_batch(n=6, *, classes=1, size=32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "image": torch.rand(n, 1, size, size, generator=generator),
        "rotation": random_rotations(n, generator).float(),
        "class_id": torch.arange(n) % classes,
    }


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 10_861_283),
        ({"classes": 10}, 10_909_730),
        ({"channels": 3}, 10_862_119),
        ({"level": 0}, 10_857_443),
        ({"encoder": ResNet18}, 11_637_959),
    ],
)
def test_parameters_of_the_paper(options, expected):
    options = {"encoder": PAPER, "features": 128, "size": 128} | options
    assert count(pose(**options)) == expected


def test_parameters_of_the_classifier():
    assert count(classifier(encoder=PAPER, features=128, size=128, classes=40)) == 12_149_636


@pytest.mark.parametrize("classes", [1, 3])
@pytest.mark.parametrize("encoder", [TOY, partial(ResNet18, width=4)])
def test_one_step_changes_every_parameter(classes, encoder):
    torch.manual_seed(0)
    network = pose(encoder=encoder, classes=classes, reg_on="gt_always")
    batch = make_batch(classes=classes)
    before = copy.deepcopy(dict(network.named_parameters()))
    optimiser = torch.optim.SGD(network.parameters(), lr=0.1)
    sum(network.loss(network(batch), batch).values()).backward()
    optimiser.step()
    same = [n for n, p in network.named_parameters() if torch.equal(p, before[n])]
    assert same == []


def test_one_step_changes_every_parameter_of_the_classifier():
    torch.manual_seed(0)
    network, batch = classifier(), make_batch(classes=3)
    before = copy.deepcopy(dict(network.named_parameters()))
    network.loss(network(batch), batch)["classification"].backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    same = [n for n, p in network.named_parameters() if torch.equal(p, before[n])]
    assert same == []


@pytest.mark.parametrize("network", [pose(), classifier()], ids=["pose", "classifier"])
def test_batch_of_one_and_determinism(network):
    batch = make_batch(1)
    loss = sum(network.train().loss(network(batch), batch).values())
    assert torch.isfinite(loss)
    network.eval()
    whole = make_batch(4)
    with torch.no_grad():
        first, second = network(whole), network(whole)
        one = network({key: value[:1] for key, value in whole.items()})
    assert torch.equal(first.logits, second.logits)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-5, rtol=1e-5)


def overfit(network, batch, *, steps, lr):
    optimiser = torch.optim.SGD(network.parameters(), lr=lr, momentum=0.9, nesterov=True)
    for _ in range(steps):
        optimiser.zero_grad()
        loss = sum(network.loss(network(batch), batch).values())
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
    return network(batch)


@pytest.mark.parametrize(
    "options",
    [
        {"reg_on": "gt_always"},
        {"labels": "soft"},
        {"target": "rotation", "group_frame": "standard", "reg_on": "gt_always"},
    ],
    ids=["hard", "soft", "published frame"],
)
def test_overfits_a_batch(options):
    torch.manual_seed(0)
    network = pose(regression_weight=10.0, **options)
    batch = make_batch(8)
    prediction = overfit(network, batch, steps=80, lr=0.02)
    assert network.group_correct(prediction, batch).float().mean() > 0.8
    error = torch.rad2deg(geodesic_angle_rad(prediction.rotation, batch["rotation"]))
    assert error.quantile(0.5) < 15


def test_classifier_overfits_a_batch():
    torch.manual_seed(0)
    network, batch = classifier(), make_batch(9, classes=3)
    prediction = overfit(network, batch, steps=60, lr=0.02)
    assert torch.equal(prediction.logits.argmax(dim=1), batch["class_id"])


@pytest.mark.parametrize("target", ["view", "rotation"])
@pytest.mark.parametrize("group_frame", ["conjugated", "standard"])
def test_labels_recompose(target, group_frame):
    """A network that outputs the label predicts the rotation of the batch."""
    network = pose(target=target, group_frame=group_frame)
    batch = make_batch(200)
    label = network.group_target(batch)
    element = icosahedron(frame=group_frame).rotations.float()[label.element]
    wanted = batch["rotation"].mT if target == "view" else batch["rotation"]
    residual = label.residual[torch.arange(200), label.element]
    torch.testing.assert_close(residual @ element, wanted, atol=1e-5, rtol=0)
    nearest = label.angle_rad.min(dim=1)
    assert torch.equal(nearest.indices, label.element)
    assert math.degrees(nearest.values.max()) < 44.5

    class Oracle(torch.nn.Module):
        def forward(self, image, index=None):
            six = label.residual[..., :2].mT.reshape(200, 60, 6)
            logits = torch.nn.functional.one_hot(label.element, 60).float()[..., None]
            return torch.cat([logits, six], dim=-1)

    network.trunk = Oracle()
    prediction = network(batch)
    torch.testing.assert_close(prediction.rotation, batch["rotation"], atol=1e-5, rtol=0)
    # Every candidate with its own residual is the same rotation.
    torch.testing.assert_close(
        prediction.candidates, batch["rotation"][:, None].expand(-1, 60, -1, -1), atol=1e-5, rtol=0
    )
    assert network.group_correct(prediction, batch).all()
    # The norm's square root turns rounding of 1e-7 into 1e-6 at most.
    assert network.loss(prediction, batch)["regression"] < 1e-3


def test_each_class_has_its_own_sphere():
    torch.manual_seed(0)
    network = pose(classes=2).eval()
    batch = make_batch(4)
    with torch.no_grad():
        zeros = network(batch | {"class_id": torch.zeros(4, dtype=torch.int64)}).logits
        mixed = network(batch | {"class_id": torch.tensor([0, 1, 0, 1])}).logits
    torch.testing.assert_close(mixed[::2], zeros[::2])
    assert not torch.allclose(mixed[1::2], zeros[1::2])


def test_mean_pooling_knows_nothing_of_rotations():
    """Averaging over the group leaves the two orbit means of the sphere (12 and 30 vertices)."""
    torch.manual_seed(0)
    network = classifier(classes=4, pooling="mean").double()
    signal = torch.rand(5, 16, 16 * 4, dtype=torch.float64)
    network.trunk.encoder = torch.nn.Identity()
    network.trunk.projector = torch.nn.Identity()
    with torch.no_grad():
        logits = network({"image": signal}).logits
        mesh, sphere = icosahedron(1), network.trunk.group_conv.sphere[0]
        psi = signal.view(5, 16, 16, 4)
        corner = mesh.visible < 12
        expected = network.trunk.group_conv.bias + sum(
            torch.einsum("n,bvnm->bm", sphere[orbit].mean(dim=0), psi[:, half])
            for orbit, half in ((slice(0, 12), corner), (slice(12, 42), ~corner))
        )
    torch.testing.assert_close(logits, expected, atol=1e-13, rtol=1e-12)
    network.pooling = "max"
    with torch.no_grad():
        assert not torch.allclose(network({"image": signal}).logits, expected)


def test_poolings():
    torch.manual_seed(0)
    batch = make_batch(2)
    network = classifier().eval()
    with torch.no_grad():
        output = network.trunk(batch["image"])
        for pooling, expected in (
            ("max", output.max(dim=1).values),
            ("mean", output.sum(dim=1) / 60),
            ("mean_after_relu", output.clamp(min=0).sum(dim=1) / 60),
        ):
            network.pooling = pooling
            prediction = network(batch)
            torch.testing.assert_close(prediction.logits, expected)
            assert prediction.descriptor is prediction.logits


def test_encoder_inside_turns_with_the_image():
    torch.manual_seed(0)
    encoder = pose().trunk.encoder
    image = make_batch(2)["image"]
    assert_c4_equivariant(encoder, image, dtype=torch.float32, tolerance=1e-5)


@pytest.mark.parametrize("saved", ["train", "eval"])
@pytest.mark.parametrize("loaded", ["train", "eval", "frozen"])
def test_saves_and_loads_in_every_mode(saved, loaded, tmp_path):
    source, target, batch = pose(), pose(), make_batch(3)
    with torch.no_grad():
        source.train()(batch)  # moves the running statistics
        target.eval()(batch)  # fills the caches
    if loaded == "frozen":
        target.requires_grad_(False)
    else:
        target.train(loaded == "train")
    source.train(saved == "train")
    torch.save(source.state_dict(), tmp_path / "weights.pt")
    target.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True), strict=True)
    # The way that Lightning restores modes.
    for module in target.modules():
        module.training = False
    with torch.no_grad():
        assert torch.equal(target(batch).logits, source.eval()(batch).logits)


def test_state_dict_has_nothing_but_parameters_and_statistics():
    network = pose().eval()
    parameters = {name for name, _ in network.named_parameters()}
    rest = {name.rsplit(".", 1)[-1] for name in network.state_dict() if name not in parameters}
    assert rest == {"running_mean", "running_var", "num_batches_tracked"}


def test_float64_on_one_network_leaves_another_alone():
    one, other = pose(), pose()
    batch = make_batch(2)
    wide = {key: v.double() if v.is_floating_point() else v for key, v in batch.items()}
    assert one.double()(wide).rotation.dtype == torch.float64
    assert sum(one.loss(one(wide), wide).values()).dtype == torch.float64
    assert other(batch).rotation.dtype == torch.float32
    assert pose()(batch).rotation.dtype == torch.float32


def test_mixed_precision_keeps_rotations_and_losses_in_float32():
    torch.manual_seed(0)
    network, batch = pose(reg_on="gt_always"), make_batch(4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        losses = network.loss(prediction, batch)
    assert prediction.rotation.dtype == torch.float32
    product = prediction.candidates @ prediction.candidates.mT
    torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-5, rtol=0)
    exact = network.loss(network(batch), batch)
    for name, value in losses.items():
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, exact[name], rtol=0.05, atol=0.05)


def test_a_ready_module_serves_as_encoder():
    class Foreign(torch.nn.Module):
        out_channels, map_size = 4, 8

        def __init__(self):
            super().__init__()
            self.conv = torch.nn.Conv2d(1, 4, 4, stride=4)

        def forward(self, image):
            return self.conv(image)

    assert pose(encoder=Foreign())(make_batch(2)).rotation.shape == (2, 3, 3)
    assert pose(encoder=lambda in_channels, image_size: Foreign())(make_batch(2)) is not None
    with pytest.raises(TypeError, match="out_channels"):
        pose(encoder=torch.nn.Identity())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": "pose"}, "view, rotation"),
        ({"reg_on": "all"}, "correct_only"),
        ({"labels": "fuzzy"}, "hard, soft"),
        ({"group_frame": "tilted"}, "conjugated"),
    ],
)
def test_unknown_choices(options, message):
    with pytest.raises(ValueError, match=message):
        pose(**options)


def test_levels_must_agree():
    with pytest.raises(ValueError, match="mesh_level"):
        I2IPose(
            TOY,
            partial(IcosahedralProjector, mesh_level=0),
            partial(DynamicFilterConv, 4),
            channels=1,
            num_classes=1,
            image_size=32,
        )
    with pytest.raises(ValueError, match="max, mean, mean_after_relu"):
        classifier(pooling="median")
