"""How equivariant a trained network is, layer by layer: `python -m i2i.check run=runs/<name>`."""

from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from torch import Tensor

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.data.noise import noise_batch
from i2i.errors import ConfigurationError, I2IError
from i2i.rendering.base import MODALITIES
from i2i.runs.building import build_datamodule, follow_root
from i2i.runs.folder import write_json
from i2i.runs.loading import load_task, locate, move_to
from i2i.testing.measured import measure
from i2i.viz.equivariance import equivariance_figure, equivariance_table
from i2i.viz.style import save_figure

_TABLE_WIDTH = 118  # of a table that is not written to a terminal


def check(cfg: DictConfig) -> dict[str, Any]:
    """Measure a trained network; writes `equivariance.json` and `equivariance.png`.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        What the JSON holds (`layers`, `data`, `notice`, ...) and beside it `rows`, the
        measurements, and `output`, the folder.

    Raises:
        CheckpointError: if there is no such run.
        ConfigurationError: if a number is not allowed.
    """
    if cfg.images < 1 or not cfg.tolerance > 0:
        raise ConfigurationError(
            f"images={cfg.images} must be at least 1 and tolerance={cfg.tolerance} positive"
        )
    register_resolvers()
    folder, checkpoint = locate(cfg.run, cfg.ckpt)
    task = load_task(checkpoint)
    if task.info.modality not in MODALITIES:
        raise ConfigurationError(
            f"the network of {folder.path.name} sees {task.info.modality}, and this command turns "
            f"images: give a run with data.modality={' | '.join(MODALITIES)}"
        )
    batch, notice = noise_batch(task.info, cfg.images), ""
    if not cfg.noise:
        batch, notice = _test_images(cfg, task.run_config, batch)
    network = move_to(task.network, cfg.device)
    batch = {name: value.to(cfg.device) for name, value in batch.items()}
    rows = measure(network, batch, symmetry=task.info.symmetry)
    content = {
        "format": 1,
        "checkpoint": checkpoint.name,
        "data": "noise" if cfg.noise or notice else "test images",
        "notice": notice,
        "images": len(batch["image"]),
        "tolerance": cfg.tolerance,
        "claims": any(row.claimed for row in rows),
        "layers": [row.to_dict(cfg.tolerance) for row in rows],
    }
    output = Path(cfg.output) if cfg.output else folder.path / "check"
    write_json(output / "equivariance.json", content)
    heading = f"{folder.path.name}: {content['images']} {content['data']}"
    figure = equivariance_figure(rows, tolerance=cfg.tolerance, heading=heading)
    save_figure(figure, output / "equivariance.png")
    return {**content, "rows": rows, "output": str(output)}


def _test_images(
    cfg: DictConfig, run_config: dict[str, Any], noise: dict[str, Tensor]
) -> tuple[dict[str, Tensor], str]:
    """Images of the run's own test set and no notice; without them the noise and the reason.

    Nothing is rendered for this: what training left is read.
    """
    changes = {key: value for key, value in cfg.data.items() if value is not None}
    config = OmegaConf.merge(run_config, {"data": changes})
    assert isinstance(config, DictConfig)
    follow_root(config)
    try:
        dataset = build_datamodule(config).dataset("test")
    except (I2IError, OSError) as error:
        return noise, f"the test images cannot be read, noise is used instead ({error})"
    if len(dataset) == 0:
        return noise, "the run has no test images, noise is used instead"
    count = min(cfg.images, len(dataset))
    chosen = np.linspace(0, len(dataset) - 1, count).round().astype(int)
    return dataset.__getitems__(chosen.tolist()), ""


@door("check")
def main(cfg: DictConfig) -> None:
    """Print the measured equivariance of a run."""
    done = check(cfg)
    if done["notice"]:
        print(f"notice: {done['notice']}")
    console = Console()
    if not console.is_terminal:
        console = Console(width=_TABLE_WIDTH)
    console.print(equivariance_table(done["rows"], tolerance=cfg.tolerance))
    if not done["claims"]:
        print("this network claims nothing; it was measured end to end all the same")
    for row in done["rows"]:
        if row.angles is not None:
            print(
                f"{row.layer}, {row.group}: the predicted rotation is off by "
                f"{max(row.angles.median):.3g}° (median), {max(row.angles.largest):.3g}° (largest)"
                f"; control {min(row.angles.control):.3g}°"
            )
    print(f"written to {done['output']}")


if __name__ == "__main__":
    main()
