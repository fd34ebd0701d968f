"""The configuration files of the baselines build what they name, at every scale."""

import pytest
import torch

from i2i.configuration import compose
from i2i.data.info import CHANNELS, IMAGES, DataInfo
from i2i.errors import ConfigurationError
from i2i.geometry.rotations import random_rotations
from i2i.runs.building import build_network, check_fit

POSE = ("cnn_gs", "cnn_procrustes", "cnn_ier", "cnn_s3exp", "e2cnn_eq")
CLASSIFICATION = ("cnn", "e2cnn_inv")
ALL = [*((name, "pose") for name in POSE), *((name, "classification") for name in CLASSIFICATION)]

PARAMETERS = {  # gray; one class for pose and 40 for classification
    "i2i": 10_861_283,
    "cnn_gs": 11_176_006,
    "cnn_procrustes": 11_177_545,
    "cnn_ier": 11_444_818,
    "cnn_s3exp": 27_595_332,
    "e2cnn_eq": 10_585_058,
    "cnn": 11_193_448,
    "e2cnn_inv": 10_594_820,
}


def build(model, task, *, scale, modality="gray", classes=1, overrides=()):
    words = [f"model={model}", f"task={task}", f"scale={scale}", f"data.modality={modality}"]
    config = compose([*words, *overrides])
    info = DataInfo(
        tuple(f"class{k}" for k in range(classes)),
        ("none",) * classes,
        channels=CHANNELS[modality],
        image_size=config.scale.image_size,
        modality=modality,
    )
    return build_network(config, info), info


def count(model, task, *, scale):
    network, _ = build(model, task, scale=scale, classes=40 if task == "classification" else 1)
    return sum(parameter.numel() for parameter in network.parameters())


def run(network, info, n=2):
    generator = torch.Generator().manual_seed(0)
    size = (n, info.channels, info.image_size, info.image_size)
    batch = {
        "image": torch.rand(size, generator=generator),
        "rotation": random_rotations(n, generator).float(),
        "class_id": torch.arange(n) % info.num_classes,
    }
    return network.loss(network(batch), batch)


@pytest.mark.parametrize(("model", "task"), ALL)
@pytest.mark.parametrize("modality", IMAGES)
def test_tiny_sees_every_modality(model, task, modality):
    for classes in (1, 2) if task == "pose" else (3,):
        losses = run(*build(model, task, scale="tiny", modality=modality, classes=classes))
        assert torch.isfinite(sum(losses.values()))


@pytest.mark.parametrize(("model", "task"), ALL)
def test_small_takes_a_batch(model, task):
    losses = run(*build(model, task, scale="small", classes=1 if task == "pose" else 10))
    assert torch.isfinite(sum(losses.values()))


@pytest.mark.parametrize(("model", "task"), ALL)
def test_paper_scale_has_the_papers_parameters(model, task):
    assert count(model, task, scale="paper") == PARAMETERS[model]


def test_capacity_at_small_is_in_the_ratios_of_the_paper():
    """Against I2I, within a tenth: nobody wins at small by having more to learn with."""
    i2i = count("i2i", "pose", scale="small")
    for model in POSE:
        ratio = count(model, "pose", scale="small") / i2i
        assert ratio == pytest.approx(PARAMETERS[model] / PARAMETERS["i2i"], rel=0.1), model


def test_encoders_can_be_swapped():
    network, info = build("cnn_gs", "pose", scale="tiny", overrides=["model/encoder=resnet50"])
    assert type(network.encoder).__name__ == "ResNet50"
    run(network, info)
    network, info = build("cnn_s3exp", "pose", scale="tiny", overrides=["model/encoder=resnet18"])
    run(network, info)


def test_a_model_without_the_task_is_refused():
    for model, task in (("cnn_gs", "classification"), ("cnn", "pose")):
        with pytest.raises(ConfigurationError, match=model):
            check_fit(compose([f"model={model}", f"task={task}"]))
