"""The ablations of I2I: sizes, seams on the command line, classes, and what each can see."""

import copy
import inspect

import pytest
import torch

from i2i.configuration import compose, plain
from i2i.data.info import DataInfo
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.runs.building import build_network

VARIANTS = {
    "no_e2cnn": ["model=i2i_no_e2cnn"],
    "no_groupconv": ["model=i2i_no_groupconv"],
    "no_groupconv pooled": ["model=i2i_no_groupconv", "model.reading=pooled"],
    "sparse": ["model=i2i_sparse"],
    "full_group": ["model=i2i_full_group", "model.projector.pooling=average"],
    "full_group cells": ["model=i2i_full_group", "model.projector.pooling=cells"],
    "full_group local13": ["model=i2i_full_group", "model.support=local13"],
    "vector": ["model=i2i_vector"],
    "twofold": ["model=i2i_twofold"],
}
# Those that a field chooses; what every file of conf/model must do is tested elsewhere.
CHOSEN_BY_A_FIELD = ["no_groupconv pooled", "full_group cells", "full_group local13"]
# One class, gray, at paper scale. What the paper leaves open is kept as large as I2I.
PARAMETERS = {
    "no_e2cnn": 11_637_959,
    "no_groupconv": 10_864_040,
    "no_groupconv pooled": 10_710_720,
    "sparse": 10_857_443,
    "full_group": 10_863_587,
    "full_group cells": 10_883_043,
    "full_group local13": 10_863_587,
    "vector": 10_659_299,
    "twofold": 10_861_283,
}


def build(*words, classes=1, seed=0):
    config = compose(list(words))
    names = tuple(f"class{i}" for i in range(classes))
    torch.manual_seed(seed)
    info = DataInfo(names, ("none",) * classes, 1, int(config.data.image_size), "gray")
    return build_network(config, info)


def make_batch(n=6, *, classes=1, size=32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "image": torch.rand(n, 1, size, size, generator=generator),
        "rotation": random_rotations(n, generator).float(),
        "class_id": torch.arange(n) % classes,
    }


def count(network):
    return sum(p.numel() for p in network.parameters())


@pytest.mark.parametrize("variant", VARIANTS)
def test_parameters_at_paper_scale(variant):
    assert count(build("scale=paper", *VARIANTS[variant])) == PARAMETERS[variant]


@pytest.mark.parametrize("variant", VARIANTS)
def test_small_has_the_capacity_of_i2i_as_at_paper_scale(variant):
    ratio = count(build("scale=small", *VARIANTS[variant])) / count(build("scale=small"))
    assert ratio == pytest.approx(PARAMETERS[variant] / 10_861_283, rel=0.04)
    if variant.startswith("no_groupconv"):
        assert ratio == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("classes", [1, 3])
@pytest.mark.parametrize("variant", CHOSEN_BY_A_FIELD)
def test_one_step_changes_every_parameter(variant, classes):
    network = build("scale=tiny", "scale.reg_on=gt_always", *VARIANTS[variant], classes=classes)
    batch = make_batch(classes=classes)
    before = copy.deepcopy(dict(network.named_parameters()))
    sum(network.loss(network(batch), batch).values()).backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    same = [
        n for n, p in network.named_parameters()
        # a batch norm takes the bias before it away
        if torch.equal(p, before[n]) and not ("shortcut" in n and n.endswith("bias"))
    ]  # fmt: skip
    assert same == []


@pytest.mark.parametrize("variant", CHOSEN_BY_A_FIELD)
def test_overfits_a_batch_and_takes_a_single_image(variant):
    network = build("scale=tiny", "scale.reg_on=gt_always", "scale.sphere_features=16",
                    *VARIANTS[variant])  # fmt: skip
    batch = make_batch(6)
    optimiser = torch.optim.SGD(network.parameters(), lr=0.02, momentum=0.9, nesterov=True)
    for _ in range(80):
        optimiser.zero_grad()
        sum(network.loss(network(batch), batch).values()).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
    prediction = network(batch)
    error = torch.rad2deg(geodesic_angle_rad(prediction.rotation, batch["rotation"]))
    assert error.median() < 20
    one = make_batch(1)
    assert torch.isfinite(sum(network.loss(network(one), one).values()))
    network.eval()
    with torch.no_grad():
        alone = network({key: value[:1] for key, value in batch.items()})
        torch.testing.assert_close(alone.logits, network(batch).logits[:1], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_class_has_weights_of_its_own(variant):
    network = build("scale=tiny", *VARIANTS[variant], classes=2).eval()
    batch = make_batch(4)
    with torch.no_grad():
        zeros = network(batch | {"class_id": torch.zeros(4, dtype=torch.int64)}).logits
        mixed = network(batch | {"class_id": torch.tensor([0, 1, 0, 1])}).logits
    torch.testing.assert_close(mixed[::2], zeros[::2])
    assert not torch.allclose(mixed[1::2], zeros[1::2])
    with pytest.raises(ValueError, match="class_id"):
        network({"image": batch["image"]})


@pytest.mark.parametrize(
    ("words", "variant"),
    [
        (["model/encoder=resnet18"], "no_e2cnn"),
        (["model/projector=sparse"], "sparse"),
        (["model.mesh_level=0"], "sparse"),
        (["model/group_conv=none"], "no_groupconv"),
        (["model/group_conv=none", "model/projector=unconstrained", "+model.reading=pooled"],
         "no_groupconv pooled"),
        (["model/group_conv=vector"], "vector"),
        (["model/group_conv=full_group", "model/projector=full_group"], "full_group cells"),
        (["model/group_conv=full_group", "model/projector=full_group", "+model.support=local13"],
         "full_group local13"),
        (["model.mesh_axis=twofold"], "twofold"),
    ],
)  # fmt: skip
def test_parts_swapped_on_the_command_line_make_the_variant(words, variant):
    swapped = build("scale=tiny", "model=i2i", *words)
    named = build("scale=tiny", *VARIANTS[variant])
    assert repr(swapped) == repr(named)
    assert torch.equal(swapped.elements, named.elements)
    state = named.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in swapped.state_dict().items())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["model/projector=full_group"], "length 1 and .* wants 16: .* belong together"),
        (["model/group_conv=full_group"], "length 16 and .* wants 1: .* belong together"),
        (["model=i2i_full_group", "model/projector=sparse"], "length 6 and .* wants 1"),
        (["model=i2i_full_group", "model.projector.support=local13"], "length 13 and .* wants 1"),
        (["model=i2i_full_group", "model.support=all"], "identity, local13"),
        (["model=i2i_no_groupconv", "model.reading=flat"], "sampled, pooled"),
        (["model=i2i_no_groupconv", "model.projector.reading=pooled"], "model.reading=pooled"),
        (["model=i2i_no_groupconv", "model.group_conv.reading=pooled"], "wants 1: "),
        (["model.group_conv.mesh_level=0"], "length 16 and .* wants 6: .* same mesh_level"),
        (["model.group_conv.mesh_axis=twofold"], "length 16 and .* wants 17"),
        (["model=i2i_full_group", "model.support=local13", "model.projector.mesh_axis=twofold"],
         "mesh_axis twofold and .* wants vertex"),
        (["model.mesh_axis=face"], "vertex, twofold"),
    ],
)  # fmt: skip
def test_parts_that_do_not_fit_are_refused(words, message):
    with pytest.raises(Exception, match=message) as caught:
        build("scale=tiny", *words)
    cause = caught.value
    while cause.__cause__ is not None:
        cause = cause.__cause__
    assert isinstance(cause, ValueError)


def test_the_variants_differ_from_i2i_in_nothing_else():
    """Head, loss and labels come from one file; only the parts and their fields are others."""
    reference = plain(compose(["model=i2i"]))["model"]
    for words in VARIANTS.values():
        model = plain(compose(words))["model"]
        for field in ("label_frame", "target", "group_frame", "projector_axes", "modalities"):
            assert model[field] == reference[field]
        pose, wanted = dict(model["networks"]["pose"]), dict(reference["networks"]["pose"])
        for part in ("encoder", "projector", "group_conv"):
            assert pose.pop(part) == model[part]
            wanted.pop(part)
        assert pose == wanted


@pytest.mark.parametrize(
    ("variant", "blind"),
    [("full_group", True), ("no_groupconv pooled", True), ("full_group cells", False),
     ("full_group local13", False), ("no_groupconv", False), ("sparse", False)],
)  # fmt: skip
def test_an_average_of_an_exact_c4_map_is_blind_to_quarter_turns(variant, blind):
    """So these two readings cannot do better than one in four on an exact stem."""
    network = build("scale=tiny", *VARIANTS[variant]).eval()
    assert network.trunk.encoder.stem_mode == "k4"
    if variant == "full_group cells":  # its weights are equal until they are trained
        torch.nn.init.normal_(network.trunk.projector.weight)
    image = make_batch(4)["image"]
    with torch.no_grad():
        upright, turned = (network({"image": torch.rot90(image, k, (-2, -1))}) for k in (0, 1))
    difference = (upright.logits - turned.logits).abs().max()
    assert (difference < 1e-5 * upright.logits.abs().max()) == blind


def test_a_group_convolution_is_told_the_encoders_width_only_if_it_asks():
    network = build("scale=tiny", "model=i2i_no_groupconv")
    assert "in_channels" in inspect.signature(type(network.trunk.group_conv)).parameters
    assert "in_channels" not in inspect.signature(type(build().trunk.group_conv)).parameters
