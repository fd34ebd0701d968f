"""Every network of conf/model, folded for inference: the same answers up to rounding."""

from pathlib import Path

import pytest
import torch
from torch import nn

from i2i.configuration import compose, config_dir, modalities
from i2i.data.info import CLOUDS
from i2i.data.noise import noise_batch
from i2i.nn.c4 import C4Conv
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.folding import fold
from i2i.runs.building import build_network, info_of

MODELS = sorted(path.stem for path in (Path(config_dir()) / "model").glob("*.yaml"))
CONFIGS = {model: compose([f"model={model}"]).model for model in MODELS}
NETWORKS = [
    (model, task)
    for model in MODELS
    for task in CONFIGS[model].networks
    if not set(modalities(CONFIGS[model].modalities, task)) <= set(CLOUDS)
]


def lived(model, task, *, num_classes, words=()):
    """A network with the statistics of a few batches, and what its data are."""
    config = compose([f"model={model}", f"task={task}", "scale=tiny", "data=synthetic", *words])
    info = info_of(config, tuple(f"class{i}" for i in range(num_classes)))
    torch.manual_seed(0)
    network = build_network(config, info).train()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.3)
        if isinstance(module, C4Conv) and module.bias is not None:
            nn.init.normal_(module.bias)
    with torch.no_grad():
        for seed in range(3):
            network(noise_batch(info, 6, seed=seed))
    return network.eval(), info


def difference(a, b):
    return float((a - b).norm() / b.norm())


@pytest.mark.parametrize(("model", "task"), NETWORKS)
def test_a_folded_network_gives_the_same_answers(model, task):
    network, info = lived(model, task, num_classes=3)
    batch = noise_batch(info, 5, seed=9)
    folded = fold(network)
    left = {type(module) for module in folded.modules()}
    assert not left & {C4Conv, C4BatchNorm, nn.BatchNorm2d}
    with torch.inference_mode():
        expected, found = network(batch), folded(batch)
    if task == "classification":
        assert difference(found.logits, expected.logits) < 1e-5
        assert difference(found.descriptor, expected.descriptor) < 1e-5
        return
    if expected.logits is None:
        assert difference(found.rotation, expected.rotation) < 1e-5
    else:
        assert difference(found.logits, expected.logits) < 1e-5
        assert torch.equal(found.logits.argmax(1), expected.logits.argmax(1))
        assert difference(found.rotation, expected.rotation) < 1e-4  # Gram-Schmidt amplifies


@pytest.mark.parametrize("mode", ["ref", "k4", "pool"])
def test_every_stem_of_i2i(mode):
    network, info = lived("i2i", "pose", num_classes=1, words=[f"scale.stem_mode={mode}"])
    batch = noise_batch(info, 4)
    with torch.inference_mode():
        assert difference(fold(network)(batch).logits, network(batch).logits) < 1e-5
