"""The classification baselines: counts, one step, overfitting, invariance."""

from functools import partial

import pytest
import torch

from i2i.models.cnn import CNNClassifier
from i2i.models.e2cnn_inv import InvariantClassifier
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.resnet import ResNet18

PLAIN = partial(ResNet18, width=4, max_pool=False)
TURNING = partial(
    C4ResNet18, width=2, basis="full", max_pool=False, stem_mode="k4", layer_strides=(2, 1, 1)
)
TOYS = {
    "cnn": partial(CNNClassifier, PLAIN),
    "e2cnn_inv": partial(InvariantClassifier, TURNING),
    "e2cnn_inv max first": partial(InvariantClassifier, TURNING, order="max_then_mean"),
}
every = pytest.mark.parametrize("name", list(TOYS))


def make(name, *, classes=3, channels=1, size=32, **options):
    torch.manual_seed(0)
    return TOYS[name](channels=channels, num_classes=classes, image_size=size, **options)


def make_batch(n=6, *, classes=3, size=32, channels=1):
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(n, channels, size, size, generator=generator)
    return {"image": image, "class_id": torch.arange(n) % classes}


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        (partial(CNNClassifier, ResNet18), 11_193_448),
        (partial(InvariantClassifier, partial(C4ResNet18, width=38)), 10_594_820),
    ],
    ids=["cnn", "e2cnn_inv"],
)
def test_parameters_of_the_paper(network, expected):
    made = network(channels=1, num_classes=40, image_size=128)
    assert sum(parameter.numel() for parameter in made.parameters()) == expected


@every
@pytest.mark.parametrize("channels", [1, 3])
def test_batch_of_one_and_determinism(name, channels):
    network, batch = make(name, channels=channels), make_batch(4, channels=channels)
    alone = {key: value[:1] for key, value in batch.items()}
    assert torch.isfinite(network.train().loss(network(alone), alone)["classification"])
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
    assert torch.equal(first.logits, second.logits)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-5, rtol=1e-5)


@every
def test_descriptor_is_what_the_classifier_sees(name):
    network, batch = make(name).eval(), make_batch()
    with torch.no_grad():
        prediction = network(batch)
        logits = prediction.descriptor @ network.classifier.weight.T + network.classifier.bias
    assert prediction.descriptor.shape == (6, network.encoder.out_channels)
    torch.testing.assert_close(prediction.logits, logits)


@every
def test_mixed_precision_gives_float32(name):
    network, batch = make(name), make_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        loss = network.loss(prediction, batch)["classification"]
    assert prediction.logits.dtype == prediction.descriptor.dtype == loss.dtype == torch.float32


def test_orders_against_their_definition():
    network, image = make("e2cnn_inv").eval(), make_batch()["image"]
    with torch.no_grad():
        fields = network.encoder.regular_map(image)
        batch, channels, height, width = fields.shape
        fields = fields.view(batch, channels // 4, 4, height, width)
        mean_first = fields.flatten(3).mean(dim=3).max(dim=2).values
        max_first = fields.max(dim=2).values.flatten(2).mean(dim=2)
        torch.testing.assert_close(network.feature(image), mean_first)
        network.order = "max_then_mean"
        torch.testing.assert_close(network.feature(image), max_first)
    # The largest at every place is never below the largest of the means, and differs.
    assert (max_first >= mean_first - 1e-6).all()
    assert (max_first - mean_first).max() > 1e-3


def _change_by_turns(name, *, stem_mode="k4", size=32):
    """Largest relative change of the descriptor of noise by quarter turns."""
    torch.manual_seed(0)
    options = {} if name == "cnn" else {"encoder": partial(TURNING, stem_mode=stem_mode)}
    network = make(name, size=size) if name == "cnn" else TOYS[name].func(
        channels=1, num_classes=3, image_size=size, **TOYS[name].keywords, **options
    )  # fmt: skip
    batch = make_batch(8, size=size)
    network.train()(batch)
    network.eval()
    changes = []
    with torch.no_grad():
        still = network(batch)
        for turns in (1, 2, 3):
            turned = network({"image": torch.rot90(batch["image"], turns, dims=(2, 3))})
            for one, other in (
                (turned.descriptor, still.descriptor),
                (turned.logits, still.logits),
            ):
                changes.append(((one - other).norm() / other.norm()).item())
    return max(changes)


@pytest.mark.parametrize("name", ["e2cnn_inv", "e2cnn_inv max first"])
@pytest.mark.parametrize(("stem_mode", "size"), [("k4", 32), ("pool", 32), ("odd", 33)])
def test_invariant_network_does_not_notice_quarter_turns(name, stem_mode, size):
    assert _change_by_turns(name, stem_mode=stem_mode, size=size) < 1e-5


def test_published_stem_and_plain_network_notice_them():
    assert _change_by_turns("e2cnn_inv", stem_mode="ref") > 1e-2
    assert _change_by_turns("cnn") > 1e-2


def test_bad_choices():
    with pytest.raises(ValueError, match="mean_then_max, max_then_mean"):
        make("e2cnn_inv", order="median")
    with pytest.raises(TypeError, match="c4_resnet18"):
        InvariantClassifier(PLAIN, channels=1, num_classes=3, image_size=32)
