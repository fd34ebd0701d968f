"""How the object in a picture is turned: `python -m i2i.predict run=... input=photo.png`."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.data.point_files import SUFFIXES as CLOUDS
from i2i.errors import ImageError
from i2i.prediction_results import PoseResult
from i2i.predictor import load
from i2i.runs.loading import locate

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


def predict(cfg: DictConfig) -> dict[str, Any]:
    """Predict for one picture or cloud, or each of a folder; writes a picture and a JSON for each.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        For each input file its result, as `PoseResult` or `ClassResult` objects.

    Raises:
        ImageError: if there is no picture.
    """
    register_resolvers()
    predictor = load(cfg.run, ckpt=cfg.ckpt, device=cfg.device)
    folder, _ = locate(cfg.run, cfg.ckpt)
    output = Path(cfg.output) if cfg.output else folder.path / "predictions"
    output.mkdir(parents=True, exist_ok=True)
    options = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(options, dict)
    results: dict[str, Any] = {}
    pictures = _inputs(Path(cfg.input), CLOUDS if predictor.info.num_points else PICTURES)
    stems = Counter(path.stem for path in pictures)
    for path in pictures:
        result = predictor.predict(
            path,
            **{
                k: options[k] for k in ("class_name", "mask", "box", "intrinsics", "margin", "axes")
            },
        )
        # "_pose" or "_class": an answer beside its picture never takes the picture's own name.
        stem = path.stem if stems[path.stem] == 1 else path.name.replace(".", "_")
        answer = output / f"{stem}_{'pose' if isinstance(result, PoseResult) else 'class'}.png"
        if answer in pictures:
            raise ImageError(f"{answer} is itself an input picture: give another output=...")
        result.draw(answer)
        answer.with_suffix(".json").write_text(json.dumps(result.to_dict(), indent=1) + "\n")
        print(f"{path}\n{result}\npicture {answer}\n")
        results[str(path)] = result
    return results


def _inputs(given: Path, suffixes: Sequence[str]) -> list[Path]:
    if given.is_dir():
        found = sorted(p for p in given.iterdir() if p.suffix.lower() in suffixes)
        if not found:
            raise ImageError(f"input={given}: no input there ({', '.join(suffixes)})")
        return found
    if not given.exists():
        raise ImageError(
            f"input={given}: no such file; give one of {', '.join(suffixes)}, or a folder"
        )
    return [given]


@door("predict")
def main(cfg: DictConfig) -> None:
    """Predict for a picture."""
    predict(cfg)


if __name__ == "__main__":
    main()
