"""Render a dataset into its store: `python -m i2i.render data=meshes data.root=my_parts`."""

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.render_jobs import what_to_render
from i2i.sweeping import run_job


def render(cfg: DictConfig) -> list[str]:
    """Render what lacks; views that are there already are kept.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        The folders of the stores; of a part they may not be there yet.

    Raises:
        ConfigurationError: if there is nothing to render, or no such part.
        I2IError: see `i2i.data.rendering_job.render_store`.
    """
    register_resolvers()
    datamodule, part = what_to_render(cfg)
    return [str(path) for path in datamodule.render(overwrite=cfg.overwrite, part=part).values()]


@door("render")
def main(cfg: DictConfig) -> None:
    """Render the views of a dataset."""
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        run_job(lambda: _render_and_tell(cfg))
    else:
        _render_and_tell(cfg)


def _render_and_tell(cfg: DictConfig) -> None:
    paths = render(cfg)
    if cfg.part is not None:
        print(f"part {cfg.part} of {cfg.parts} rendered; the command without them makes the stores")
        return
    for path in paths:
        print(f"store {path}")


if __name__ == "__main__":
    main()
