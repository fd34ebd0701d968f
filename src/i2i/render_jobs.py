"""The jobs of the render door: what each renders, and what a sweep has to know of them."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from i2i.data.datamodule import RenderedDataModule
from i2i.data.loaders import LoaderSettings
from i2i.errors import ConfigurationError
from i2i.runs.building import build_datamodule
from i2i.sweeping import Rules

# What a store does not depend on: how its rows are loaded, labelled and divided.
_OF_LOADING = {field.name for field in fields(LoaderSettings)} | {
    "render_workers", "strip_symmetry", "symmetry", "val_fraction",
}  # fmt: skip


def what_to_render(
    cfg: DictConfig | dict[str, Any],
) -> tuple[RenderedDataModule, tuple[int, int] | None]:
    """The data of a configuration of the render door, and the part of them; None for all.

    Raises:
        ConfigurationError: if the data have no meshes, or there is no such part.
    """
    datamodule = build_datamodule(cfg)
    if not isinstance(datamodule, RenderedDataModule):
        raise ConfigurationError(
            f"data={cfg['data']['name']} has no meshes: there is nothing to render"
        )
    return datamodule, _part(cfg)


def _part(cfg: Mapping[str, Any]) -> tuple[int, int] | None:
    part, parts = cfg["part"], cfg["parts"]
    if part is None and parts is None:
        return None
    if not isinstance(part, int) or not isinstance(parts, int) or not 1 <= part <= parts:
        raise ConfigurationError(
            f"part={part} parts={parts}: give both, such as part=1 parts=8, the first of eight"
        )
    if cfg["overwrite"]:
        raise ConfigurationError(
            "overwrite=true with part: the parts would throw away each other's views. Delete the "
            "store's folder, or leave part and parts out"
        )
    return part, parts


def rendering_hash(config: dict[str, Any]) -> str:
    """Twelve hexadecimal digits that are the same for jobs that render the same."""
    kept = {key: value for key, value in config["data"].items() if key not in _OF_LOADING}
    text = json.dumps([kept, config["part"], config["parts"]], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def find_rendered(config: dict[str, Any], identity: str) -> Path | None:
    """The folder of the stores of a job that has nothing left to render; None if it has.

    Raises:
        I2IError: if the meshes are not there, or the stores were made with other settings.
    """
    datamodule, part = what_to_render(config)
    if config["overwrite"] or not datamodule.is_rendered(part):
        return None
    return datamodule.store_root / datamodule.source.name / datamodule.settings.key


RENDERING = Rules(
    rendering_hash, find_rendered, broken=lambda config, identity: None, left_to_others=False
)
