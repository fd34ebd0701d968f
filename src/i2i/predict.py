"""How the object in a picture is turned: `python -m i2i.predict run=... input=photo.png`."""

import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.data.point_files import SUFFIXES as CLOUDS
from i2i.errors import ImageError
from i2i.prediction_results import PoseResult
from i2i.predictor import load
from i2i.runs.loading import locate

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


def predict(cfg: DictConfig) -> dict[str, Path]:
    """Predict for one picture or cloud, or each of a folder; writes a picture and a JSON for each.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        For each input file the JSON with its answer.

    Raises:
        ImageError: if there is no picture.
    """
    register_resolvers()
    predictor = load(cfg.run, ckpt=cfg.ckpt, device=cfg.device, optimize=cfg.optimize)
    folder, _ = locate(cfg.run, cfg.ckpt)
    output = Path(cfg.output) if cfg.output else folder.path / "predictions"
    output.mkdir(parents=True, exist_ok=True)
    options = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(options, dict)
    paths = _inputs(Path(cfg.input), CLOUDS if predictor.info.num_points else PICTURES)
    how = ("class_name", "mask", "box", "intrinsics", "margin", "axes", "batch_size", "workers",
           "read_ahead")  # fmt: skip
    results = predictor.predict_many(paths, **{name: options[name] for name in how})
    written: dict[str, Path] = {}
    for path, result in zip(paths, results, strict=True):
        answer = _place(output, path, "pose" if isinstance(result, PoseResult) else "class")
        print(f"{path}\n{result}")
        if cfg.pictures:
            picture = answer.with_suffix(".png")
            if picture in paths:
                raise ImageError(f"{picture} is itself an input picture: give another output=...")
            result.draw(picture)
            print(f"picture {picture}")
        print(f"answer  {answer}\n")
        content = {"input": str(path.resolve()), **result.to_dict()}
        answer.write_text(json.dumps(content, indent=1) + "\n")
        written[str(path)] = answer
    return written


def _place(output: Path, path: Path, kind: str) -> Path:
    """The JSON of an input's answer: the one that it has already, else one that nobody has.

    `photo_pose.json`, and where that answers for another file (x.jpg beside x.png, or a file of
    this name from another folder) `photo_2_pose.json` and so on.
    """
    for number in count(1):
        # "_pose" or "_class": an answer beside its picture never takes the picture's own name.
        stem = path.stem if number == 1 else f"{path.stem}_{number}"
        answer = output / f"{stem}_{kind}.json"
        if not answer.exists() or _answered(answer) == str(path.resolve()):
            return answer
    raise AssertionError("unreachable")


def _answered(answer: Path) -> str | None:
    """The input file that a JSON answers for; None where it does not say."""
    try:
        content = json.loads(answer.read_text())
    except ValueError:
        return None
    given = content.get("input") if isinstance(content, dict) else None
    return given if isinstance(given, str) else None


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
