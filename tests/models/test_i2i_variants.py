"""The ablations of I2I: sizes, seams on the command line, classes, and what each can see."""

import inspect

import pytest
import torch

from i2i.configuration import compose, plain
from i2i.data.info import DataInfo
from i2i.geometry.rotations import random_rotations
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


def test_a_weight_for_each_cell_adds_a_map_of_parameters_for_each_field():
    sizes = [
        count(build("scale=paper", *VARIANTS[name])) for name in ("full_group", "full_group cells")
    ]
    assert sizes == [10_863_587, 10_863_587 + 304 * 8 * 8]


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
