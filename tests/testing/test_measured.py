"""Exact layers measure exact beside a control that does not; what is broken is found."""

import pytest
import torch
from torch import nn

from i2i.models.e2cnn_eq import InPlanePose
from i2i.models.e2cnn_inv import InvariantClassifier
from i2i.models.i2i import I2IPose
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import IcosahedralProjector
from i2i.testing.measured import END_TO_END, Measurement, evaluating, measure

SIZES = {"ref": 16, "k4": 16, "pool": 16, "odd": 17}
EXACT = ("k4", "pool", "odd")


def encoder(stem_mode="k4"):
    return C4ResNet18(
        1, width=2, image_size=SIZES[stem_mode], stem_mode=stem_mode, layer_strides=(2, 1),
        max_pool=False,
    )  # fmt: skip


def i2i(stem_mode="k4"):
    return I2IPose(
        encoder(stem_mode),
        lambda i, o, *, map_size: IcosahedralProjector(i, o, map_size=map_size, sigma=0.5),
        lambda **options: DynamicFilterConv(4, **options),
        channels=1, num_classes=1, image_size=SIZES[stem_mode],
    )  # fmt: skip


def noise(stem_mode="k4", count=4):
    size = SIZES[stem_mode]
    return {"image": torch.rand(count, 1, size, size), "class_id": torch.arange(count) % 2}


def by_layer(rows):
    return {(row.layer, row.group): row for row in rows}


def settled(network, **options):
    """With batch statistics as after training: they are not symmetric by construction."""
    network.train()
    for _ in range(3):
        network({**noise(**options), "image": noise(**options)["image"] ** 2})
    return network


@pytest.mark.parametrize("stem_mode", EXACT)
def test_exact_stems_stay_below_1e_4_and_their_controls_above_a_tenth(stem_mode):
    rows = measure(settled(i2i(stem_mode), stem_mode=stem_mode), noise(stem_mode))
    quarter = [row for row in rows if row.group == "C4" and row.layer != END_TO_END]
    assert [row.layer.removeprefix("trunk.encoder") for row in quarter] == [
        ".stem", ".blocks.0", ".blocks.1", ".blocks.2", ".blocks.3", "",
    ]  # fmt: skip
    for row in quarter:
        assert row.max_error < 1e-4, row
        assert row.max_from_image < 1e-4, row
        assert row.min_control > 0.1, row
        assert row.verdict(1e-3) == "exact"


def test_the_published_stem_is_not_exact_on_noise():
    rows = by_layer(measure(i2i("ref"), noise("ref")))
    assert rows["trunk.encoder.stem", "C4"].max_error > 0.01
    assert rows["trunk.encoder", "C4"].max_error > 0.01
    # A block that does not stride is exact alone and inherits what came before it.
    later = rows["trunk.encoder.blocks.3", "C4"]
    assert later.max_error < 1e-4 < 0.01 < later.max_from_image
    assert later.verdict(1e-3) == "exact"


def test_all_sixty_rotations_of_the_feature_sphere():
    row = by_layer(measure(i2i(), noise()))["trunk.group_conv", "I60"]
    assert len(row.errors) == 60
    assert row.max_error < 1e-5
    assert row.min_control > 0.01
    assert row.from_image is None


def test_the_five_turns_are_exact_for_the_sum_and_approximate_for_the_sampling():
    rows = by_layer(measure(i2i(), noise()))
    assert rows["trunk.group_conv", "C5"].max_error < 1e-5
    sampled = rows["trunk.projector", "C5"]
    assert 1e-3 < sampled.max_error < sampled.min_control
    assert sampled.max_from_image > 1e-3


class Shifted(nn.Module):
    """Regular fields whose channels were shifted by one turn too many."""

    def __init__(self, inner, shift):
        super().__init__()
        self.inner, self.shift = inner, shift

    def forward(self, x):
        fields = self.inner(x).unflatten(1, (-1, 4))
        # A constant shift would commute with the group: this one depends on the image.
        left = x[:, :, 0].abs().mean() > x[:, :, -1].abs().mean()
        return fields.roll(self.shift * int(left), dims=2).flatten(1, 2)


def test_a_wrong_channel_shift_is_found_where_it_is():
    network = i2i()
    network.trunk.encoder.blocks[2] = Shifted(network.trunk.encoder.blocks[2], 1)
    batch = noise()
    batch["image"][:, :, :8] *= 0.2
    rows = by_layer(measure(network, batch))
    broken = rows["trunk.encoder.blocks.2", "C4"]
    assert broken.max_error > 0.1
    assert broken.verdict(1e-3) == "none"
    for name in ("blocks.0", "blocks.1", "blocks.3"):
        assert rows[f"trunk.encoder.{name}", "C4"].verdict(1e-3) == "exact"
    assert rows["trunk.encoder.blocks.3", "C4"].max_from_image > 0.1


def test_a_wrong_table_of_the_group_convolution_is_found():
    network = i2i()
    conv, order = network.trunk.group_conv, torch.randperm(60)
    conv.pairs, conv.moved = conv.pairs[:, order], conv.moved[:, order].contiguous()
    assert by_layer(measure(network, noise()))["trunk.group_conv", "I60"].verdict(1e-3) == "none"


def test_a_pose_that_turns_with_the_image_end_to_end():
    network = settled(InPlanePose(encoder(), channels=1, num_classes=1, image_size=16))
    row = by_layer(measure(network, noise()))[END_TO_END, "C4"]
    assert max(row.angles.largest) < 0.01
    assert row.angles.control == pytest.approx([180.0, 90.0, 180.0], abs=0.01)
    assert row.verdict(1e-3) == "exact"


def test_logits_that_stay_end_to_end():
    network = settled(InvariantClassifier(encoder(), channels=1, num_classes=3, image_size=16))
    row = by_layer(measure(network, noise()))[END_TO_END, "C4"]
    assert row.max_error < 1e-4
    assert row.min_control > 1e-3  # the logits of the next image
    assert row.angles is None


class Plain(nn.Module):
    """Claims nothing; a linear map to a pose (`rotations` of an image) or to logits."""

    def __init__(self, kind):
        super().__init__()
        self.kind, self.drop = kind, nn.Dropout()
        self.linear = nn.Linear(256, 9 if kind == "pose" else 2)

    def forward(self, batch):
        out = self.linear(self.drop(batch["image"].flatten(1)))
        if self.kind == "logits":
            return ClassPrediction(out, out)
        return PosePrediction(torch.linalg.qr(out.view(-1, 3, 3))[0])


@pytest.mark.parametrize("kind", ["pose", "logits"])
def test_a_network_that_claims_nothing_is_measured_end_to_end(kind):
    rows = measure(Plain(kind), noise())
    assert [row.layer for row in rows] == [END_TO_END]
    assert not rows[0].claimed
    assert rows[0].verdict(1e-3) != "exact"


class Upright(nn.Module):
    """Turns with the image up to the given right factor, which depends on the image."""

    def __init__(self, factor):
        super().__init__()
        self.factor = factor

    def claims(self):
        return [("", "map", "rotation")]

    def forward(self, batch):
        image = batch["image"][:, 0].double()
        offset = torch.arange(16) - 7.5
        angle = torch.atan2((image * -offset[:, None]).sum((1, 2)), (image * offset).sum((1, 2)))
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        cos, sin = angle.cos(), angle.sin()
        rows = [cos, -sin, zero, sin, cos, zero, zero, zero, one]
        turn = torch.stack(rows, dim=1).view(-1, 3, 3)
        tilt = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
        return PosePrediction(turn @ tilt @ self.factor(image))


def z_turn(image):
    """A turn about the object's z axis that changes when the image turns."""
    angle = 5 * image[:, 0].mean(dim=1)
    matrix = torch.eye(3, dtype=torch.float64).repeat(len(image), 1, 1)
    matrix[:, 0, 0], matrix[:, 0, 1] = angle.cos(), -angle.sin()
    matrix[:, 1, 0], matrix[:, 1, 1] = angle.sin(), angle.cos()
    return matrix


def test_only_the_axis_counts_for_an_object_without_a_front():
    row = measure(Upright(z_turn), noise(), symmetry=("none", "none"))[0]
    assert max(row.angles.largest) > 1
    row = measure(Upright(z_turn), noise(), symmetry=("z", "z"))[0]
    assert max(row.angles.largest) < 1e-3
    assert row.claimed
    assert min(row.angles.control) > 80


def test_claims_of_a_users_module_are_measured():
    class Ring(nn.Module):
        def __init__(self, kernel):
            super().__init__()
            self.conv = nn.Conv2d(1, 1, 3, padding=1)
            self.conv.weight = nn.Parameter(kernel[None, None])

        def claims(self):
            return [("conv", "map", "map")]

        def forward(self, batch):
            return self.conv(batch["image"]).mean((2, 3))

    symmetric = torch.tensor([[1.0, 2, 1], [2, 3, 2], [1, 2, 1]])
    assert measure(Ring(symmetric), noise())[0].verdict(1e-3) == "exact"
    assert measure(Ring(torch.randn(3, 3)), noise())[0].verdict(1e-3) == "none"


def test_modes_are_restored_and_no_number_changes():
    network = i2i()
    network.train()
    network.trunk.encoder.blocks[1].eval()
    before = {k: v.clone() for k, v in network.state_dict().items()}
    modes = [m.training for m in network.modules()]
    measure(network, noise())
    assert [m.training for m in network.modules()] == modes
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    assert all(not m._forward_hooks for m in network.modules())
    with evaluating(network):
        network.eval()
        assert not torch.is_grad_enabled()
    assert [m.training for m in network.modules()] == modes


def measurement(errors, controls):
    names = tuple(str(i) for i in range(len(errors)))
    return Measurement("layer", "C4", "map -> map", True, names, errors, controls)


@pytest.mark.parametrize(
    ("errors", "controls", "verdict"),
    [
        ((1e-7, 1e-4), (0.5, 0.9), "exact"),
        ((1e-7, 0.1), (0.5, 0.9), "approximate"),
        ((0.4, 0.1), (0.5, 0.9), "none"),
        ((1e-7, 1e-7), (1e-7, 0.9), "undecided"),
        ((float("nan"), 1e-7), (0.5, 0.9), "undecided"),
        ((1e-7, 1e-7), (float("nan"), float("nan")), "undecided"),
    ],
)
def test_verdicts(errors, controls, verdict):
    row = measurement(errors, controls)
    assert row.verdict(1e-3) == verdict
    assert row.to_dict(1e-3)["verdict"] == verdict


def test_one_image_and_dead_layers_prove_nothing():
    network = InvariantClassifier(encoder(), channels=1, num_classes=3, image_size=16)
    row = by_layer(measure(network, noise(count=1)))[END_TO_END, "C4"]
    assert row.verdict(1e-3) == "undecided"
    nn.init.zeros_(network.encoder.stem.weights)
    row = by_layer(measure(network, noise()))["encoder.stem", "C4"]
    assert row.verdict(1e-3) == "undecided"
    assert row.to_dict(1e-3)["max_error"] is None


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="square"):
        measure(Plain("pose"), {"image": torch.rand(2, 1, 4, 5)})
    with pytest.raises(ValueError, match="`rotation` or `logits`"):
        measure(type("Odd", (nn.Module,), {"forward": lambda _, b: 3})(), noise())
