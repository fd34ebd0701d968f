"""A network for other programs: `python -m i2i.export run=runs/<name> output=model.onnx`."""

from pathlib import Path

from omegaconf import DictConfig

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.exporting import export_run


def export(cfg: DictConfig) -> Path:
    """Write the network of a run.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        What was written.
    """
    register_resolvers()
    return export_run(cfg.run, cfg.output, ckpt=cfg.ckpt)


@door("export")
def main(cfg: DictConfig) -> None:
    """Export a network."""
    print(f"written to {export(cfg)}")


if __name__ == "__main__":
    main()
