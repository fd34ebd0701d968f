"""From configuration to objects: data module, network, task; training and loading come here."""

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import nn

from i2i.configuration import modalities, plain
from i2i.data.info import CHANNELS, CLOUDS, VIEWS, DataInfo
from i2i.data.loaders import ImageDataModule
from i2i.errors import ConfigurationError
from i2i.geometry.view_sets import num_views
from i2i.tasks.base import Task

Config = DictConfig | dict[str, Any]


def build_datamodule(config: Config) -> ImageDataModule:
    """The data module of a configuration; nothing is read or rendered yet.

    Raises:
        ConfigurationError: if model and data, or model and task, do not fit.
    """
    config = _as_config(config)
    check_fit(config)
    left_out = {"name", "up_axis"} | ({"root"} if "source" in config.data else set())
    settings = {k: v for k, v in config.data.items_ex(resolve=False) if k not in left_out}
    data = OmegaConf.create(settings)
    data._set_parent(config)  # interpolations go on pointing into the whole configuration
    made: ImageDataModule = instantiate(data, _convert_="all")
    return made


def follow_root(config: DictConfig) -> None:
    """Let the source of a resolved configuration read from `data.root` after that was changed."""
    if "source" in config.data and "root" in config.data.source:
        config.data.source.root = config.data.root


def build_task(config: Config, info: DataInfo) -> Task:
    """The task and its network, with fresh weights.

    Args:
        config: A resolved configuration of the train door.
        info: What the data are; gives the network its channels, classes and image size.

    Raises:
        ConfigurationError: if the model has no network for the task or cannot see the modality.
    """
    config = _as_config(config)
    check_fit(config)
    settings = {
        k: v for k, v in config.task.items_ex(resolve=False)
        if k not in ("name", "monitor", "monitor_mode")
    }  # fmt: skip
    node = OmegaConf.create(settings)
    node._set_parent(config)
    network = build_network(config, info)
    # As a partial: Hydra would turn a dataclass among its arguments into a config.
    task: Task = instantiate(node, _partial_=True)(network, info=info)
    task.run_config = plain(config)
    return task


def build_network(config: Config, info: DataInfo) -> nn.Module:
    """The network of a configuration for its task, with fresh weights."""
    config = _as_config(config)
    network: nn.Module = instantiate(
        config.model.networks[config.task.name], **info.network_arguments()
    )
    return network


def info_of(config: DictConfig, class_names: tuple[str, ...] = ("object",)) -> DataInfo:
    """What a configuration's data would be for some classes, without any meshes.

    Args:
        config: A composed configuration of the train door.
        class_names: The classes, without symmetries.
    """
    data = config.data
    cameras = data.get("camera_set") if data.modality == VIEWS else None
    return DataInfo(
        class_names,
        ("none",) * len(class_names),
        channels=CHANNELS[data.modality],
        image_size=data.image_size,
        modality=data.modality,
        num_points=data.num_points if data.modality in CLOUDS else None,
        num_views=num_views(cameras) if cameras else None,
        camera_set=cameras,
    )


def check_fit(config: DictConfig) -> None:
    """Refuse a model that has no network for the task or does not see the data's modality.

    Raises:
        ConfigurationError: naming what was asked and what the model can do.
    """
    model, task = config.model, config.task.name
    tasks = [name for name, network in model.networks.items() if network is not None]
    if task not in tasks:
        raise ConfigurationError(
            f"model={model.name} has no network for task={task}; it has one for "
            f"{', '.join(f'task={name}' for name in tasks)}"
        )
    seen = modalities(model.modalities, task)
    if config.data.modality not in seen:
        raise ConfigurationError(
            f"model={model.name} does not see data.modality={config.data.modality}; it sees "
            f"{', '.join(f'data.modality={name}' for name in seen)}. Other networks see others: "
            "docs/networks.md, and `python -m i2i.train --help` lists them"
        )


def _as_config(config: Config) -> DictConfig:
    if isinstance(config, DictConfig):
        return config
    made = OmegaConf.create(config)
    assert isinstance(made, DictConfig)
    return made
