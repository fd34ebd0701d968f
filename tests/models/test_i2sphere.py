"""I2Sphere: counts, one step, overfitting, symmetry, the three losses, the distribution."""

import copy
from functools import partial

import pytest
import torch
from hydra.utils import instantiate

from i2i.configuration import compose
from i2i.geometry.rotation_grids import nearest_cell, rotation_grid
from i2i.geometry.rotations import axis_rotation, geodesic_angle_rad, random_rotations
from i2i.models.i2sphere import LOSSES, I2SpherePose
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.resnet import ResNet18
from i2i.nn.so3_signal import HemisphereProjector
from i2i.nn.spherical import wigner_basis, wigner_blocks

TOY = partial(
    C4ResNet18, width=2, basis="full", max_pool=False, stem_mode="k4", layer_strides=(2, 1, 1)
)


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def pose(*, encoder=TOY, classes=1, channels=1, size=32, lmax=3, level=1, features=4, **options):
    return I2SpherePose(
        encoder,
        partial(HemisphereProjector, sigma=0.35),
        channels=channels,
        num_classes=classes,
        image_size=size,
        sphere_features=features,
        lmax=lmax,
        grid_level=level,
        **options,
    )


def make_batch(n=6, *, classes=1, size=32, channels=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "image": torch.rand(n, channels, size, size, generator=generator),
        "rotation": random_rotations(n, generator).float(),
        "class_id": torch.arange(n) % classes,
    }


def total(network, batch):
    return sum(network.loss(network(batch), batch).values())


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, 10_854_492), ({"classes": 10}, 11_193_180), ({"loss": "joint"}, 10_854_493)],
)
def test_parameters_at_the_sizes_of_the_paper(options, expected):
    """Of I2I's 10,861,283, 0.06 % less."""
    encoder = partial(C4ResNet18, width=38)
    network = pose(encoder=encoder, size=128, lmax=6, features=128, **options)
    assert count(network) == expected


@pytest.mark.parametrize("options", [{}, {"loss": "wigner_mse"}, {"so3_features": 3}])
@pytest.mark.parametrize("modality", ["gray", "rgb"])
def test_configurations_train(options, modality):
    words = [f"model.{key}={value}" for key, value in options.items()]
    config = compose(["model=i2sphere", "scale=tiny", f"data.modality={modality}", *words])
    channels = 3 if modality == "rgb" else 1
    network = instantiate(
        config.model.networks.pose, channels=channels, num_classes=1, image_size=32
    )
    batch = make_batch(3, channels=channels)
    assert network(batch).candidates.shape == (576, 3, 3)
    assert torch.isfinite(total(network, batch))


@pytest.mark.parametrize("classes", [1, 3])
@pytest.mark.parametrize(
    "options",
    [{"loss": loss} for loss in LOSSES]
    + [{"encoder": partial(ResNet18, width=4)}, {"so3_features": 3}],
)
def test_one_step_changes_every_parameter(classes, options):
    torch.manual_seed(0)
    network, batch = pose(classes=classes, **options), make_batch(classes=classes)
    before = copy.deepcopy(dict(network.named_parameters()))
    total(network, batch).backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    same = [n for n, p in network.named_parameters() if torch.equal(p, before[n])]
    assert same == []


@pytest.mark.parametrize("loss", LOSSES)
def test_overfits_a_batch(loss):
    torch.manual_seed(0)
    network, batch = pose(loss=loss), make_batch(8)
    optimiser = torch.optim.SGD(network.parameters(), lr=0.02, momentum=0.9, nesterov=True)
    first = total(network, batch).item()
    for _ in range(60):
        optimiser.zero_grad()
        total(network, batch).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
    prediction = network(batch)
    assert total(network, batch) < first / 2
    cell = torch.rad2deg(geodesic_angle_rad(prediction.rotation, batch["rotation"]))
    assert cell.median() < 25  # cells are 30° apart
    # What the network says in evaluation needs its running statistics, so refine by hand.
    network.training = False
    error = torch.rad2deg(geodesic_angle_rad(network(batch).rotation, batch["rotation"]))
    assert error.median() < 12


@pytest.mark.parametrize("options", [{"loss": loss} for loss in LOSSES] + [{"so3_features": 2}])
def test_batch_of_one_and_determinism(options):
    torch.manual_seed(0)
    network = pose(**options)
    assert torch.isfinite(total(network.train(), make_batch(1)))
    network.eval()
    whole = make_batch(4)
    with torch.no_grad():
        first, second = network(whole), network(whole)
        one = network({key: value[:1] for key, value in whole.items()})
    assert torch.equal(first.logits, second.logits)
    assert torch.equal(first.rotation, second.rotation)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-5, rtol=1e-5)
    assert geodesic_angle_rad(one.rotation, first.rotation[:1]).max() < 1e-2


@pytest.mark.parametrize("loss", LOSSES)
def test_distribution(loss):
    network, batch = pose(loss=loss).eval(), make_batch(3)
    with torch.no_grad():
        prediction = network(batch)
    assert prediction.equal_volume
    assert prediction.candidates.shape == (576, 3, 3)
    torch.testing.assert_close(prediction.log_prob.exp().sum(dim=1), torch.ones(3))
    torch.testing.assert_close(prediction.log_prob, prediction.logits.log_softmax(dim=1))
    # The candidates are object -> camera: the transposes of the grid's views.
    expected = rotation_grid(1).rotations.float().mT
    torch.testing.assert_close(prediction.candidates, expected)
    best = prediction.candidates[prediction.log_prob.argmax(dim=1)]
    assert torch.rad2deg(geodesic_angle_rad(prediction.rotation, best)).max() < 35
    network.train()
    trained = network(batch)
    best = trained.candidates[trained.log_prob.argmax(dim=1)]
    torch.testing.assert_close(trained.rotation, best)
    assert prediction.sample(5).shape == (3, 5, 3, 3)


def test_cross_entropy_is_that_of_the_nearest_candidate():
    network, batch = pose(), make_batch(5)
    prediction = network(batch)
    expected = 0
    for i in range(5):
        angle = geodesic_angle_rad(batch["rotation"][i], prediction.candidates)
        expected -= prediction.logits[i].double().softmax(dim=0)[angle.argmin()].log() / 5
    terms = network.loss(prediction, batch)
    assert set(terms) == {"classification"}
    torch.testing.assert_close(terms["classification"].double(), expected, atol=1e-5, rtol=0)


def with_coefficients(network, coefficients):
    """The prediction that the network would make had its trunk given these coefficients."""
    network.coefficients = lambda batch: coefficients
    return network


def test_regression_is_zero_at_the_target_only():
    """The loss is (Σ (2l+1) ‖Ĉ − D(view)‖²)/84 times its weight."""
    batch = make_batch(4)
    view = batch["rotation"].mT
    network = with_coefficients(pose(loss="wigner_mse"), wigner_basis(view, 3)).eval()
    prediction = network(batch)
    terms = network.loss(prediction, batch)
    assert set(terms) == {"calibration", "regression"}
    assert terms["regression"] < 1e-8
    assert torch.rad2deg(geodesic_angle_rad(prediction.rotation, batch["rotation"])).max() < 0.5
    cell = nearest_cell(view, rotation_grid(1).rotations)
    assert torch.equal(prediction.logits.argmax(dim=1), cell)
    # ρ is 1 at the target itself, so no logit exceeds κ.
    assert (prediction.logits.max() / network.log_kappa.exp()) < 1 + 1e-5

    wrong = wigner_basis(view.mT, 3)
    network = with_coefficients(pose(loss="wigner_mse", mse_weight=7.0), wrong)
    squares = [
        (2 * d + 1) * (a - b).square().sum(dim=(1, 2))
        for d, (a, b) in enumerate(
            zip(wigner_blocks(view, 3), wigner_blocks(view.mT, 3), strict=True)
        )
    ]
    found = network.loss(network(batch), batch)["regression"]
    torch.testing.assert_close(found, 7 * sum(squares).mean() / 84)
    network = with_coefficients(pose(loss="wigner_mse", mse_weight=1.0), torch.zeros(4, 84))
    torch.testing.assert_close(network.loss(network(batch), batch)["regression"], torch.tensor(1.0))


def test_calibration_moves_kappa_only():
    torch.manual_seed(0)
    batch = make_batch(4)
    for loss, others in (("wigner_mse", False), ("joint", True)):
        network = pose(loss=loss, kappa=30.0)
        assert network.log_kappa.exp().item() == pytest.approx(30.0)
        terms = network.loss(network(batch), batch)
        terms["classification" if others else "calibration"].backward()
        moved = {n for n, p in network.named_parameters() if p.grad is not None}
        assert "log_kappa" in moved
        assert (len(moved) > 1) is others
    assert not hasattr(pose(), "log_kappa")


def test_a_quarter_turn_of_the_image_turns_the_prediction():
    """With an exactly equivariant encoder the whole network is: the grid is closed under it."""
    torch.manual_seed(0)
    network = pose(lmax=4).eval()
    batch = make_batch(4)
    quarter = axis_rotation("z", 90).float()
    with torch.no_grad():
        here = network(batch)
        there = network(batch | {"image": torch.rot90(batch["image"], 1, (2, 3))})
    expected = quarter @ here.rotation
    assert torch.rad2deg(geodesic_angle_rad(there.rotation, expected)).max() < 0.05
    moved = nearest_cell(quarter @ here.candidates, here.candidates)
    scale = here.logits.std()
    torch.testing.assert_close(
        there.logits[:, moved], here.logits, atol=1e-4 * float(scale), rtol=0
    )
    # The control: on the other side the turn is another one.
    wrong = torch.rad2deg(geodesic_angle_rad(there.rotation, here.rotation @ quarter))
    assert wrong.median() > 10
    back = nearest_cell(quarter.T @ here.candidates, here.candidates)
    assert (there.logits[:, back] - here.logits).abs().max() > 0.1 * scale


def test_each_class_has_its_own_filter():
    torch.manual_seed(0)
    network, batch = pose(classes=2).eval(), make_batch(4)
    with torch.no_grad():
        zeros = network(batch | {"class_id": torch.zeros(4, dtype=torch.int64)}).logits
        mixed = network(batch | {"class_id": torch.tensor([0, 1, 0, 1])}).logits
    torch.testing.assert_close(mixed[::2], zeros[::2])
    assert not torch.allclose(mixed[1::2], zeros[1::2])


def test_state_dict_has_nothing_but_parameters_and_statistics():
    network = pose(loss="joint", so3_features=2)
    parameters = {name for name, _ in network.named_parameters()}
    rest = {name.rsplit(".", 1)[-1] for name in network.state_dict() if name not in parameters}
    assert rest == {"running_mean", "running_var", "num_batches_tracked"}
    other = pose(loss="joint", so3_features=2)
    other.load_state_dict(network.state_dict(), strict=True)


def test_mixed_precision_keeps_the_head_in_float32():
    torch.manual_seed(0)
    network, batch = pose(loss="joint"), make_batch(4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        losses = network.loss(prediction, batch)
    assert prediction.logits.dtype == prediction.rotation.dtype == torch.float32
    exact = network.loss(network(batch), batch)
    for name, value in losses.items():
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, exact[name], rtol=0.05, atol=0.05)


def test_float64():
    network, batch = pose().double().eval(), make_batch(2)
    wide = {key: v.double() if v.is_floating_point() else v for key, v in batch.items()}
    assert network(wide).rotation.dtype == torch.float64
    assert total(network, wide).dtype == torch.float64


def test_without_refinement_the_prediction_is_a_cell():
    network, batch = pose(refine_steps=0).eval(), make_batch(3)
    prediction = network(batch)
    best = prediction.candidates[prediction.logits.argmax(dim=1)]
    assert torch.equal(prediction.rotation, best)
    refined = pose(refine_steps=12).eval()
    refined.load_state_dict(network.state_dict())
    moved = torch.rad2deg(geodesic_angle_rad(refined(batch).rotation, best))
    assert 0.1 < moved.max() < 35


def test_unknown_choices():
    with pytest.raises(ValueError, match="ce_grid, wigner_mse, joint"):
        pose(loss="mse")
    with pytest.raises(ValueError, match="0 to 5"):
        pose(level=9)
    with pytest.raises(TypeError, match="out_channels"):
        pose(encoder=torch.nn.Identity())
