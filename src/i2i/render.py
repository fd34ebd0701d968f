"""Render a dataset into its store: `python -m i2i.render data=meshes data.root=my_parts`."""

from omegaconf import DictConfig

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.data.datamodule import RenderedDataModule
from i2i.errors import ConfigurationError
from i2i.runs.building import build_datamodule


def render(cfg: DictConfig) -> list[str]:
    """Render what lacks; views that are there already are kept.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        The folders of the stores.
    """
    register_resolvers()
    datamodule = build_datamodule(cfg)
    if not isinstance(datamodule, RenderedDataModule):
        raise ConfigurationError(f"data={cfg.data.name} has no meshes: there is nothing to render")
    return [str(path) for path in datamodule.render(overwrite=cfg.overwrite).values()]


@door("render")
def main(cfg: DictConfig) -> None:
    """Render the views of a dataset."""
    for path in render(cfg):
        print(f"store {path}")


if __name__ == "__main__":
    main()
