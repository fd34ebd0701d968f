"""What a finished run says: metrics with intervals, figures, and the JSON that tables come from.

`python -m i2i.runs.results [folder]` prints the table of the published results.
"""

import json
import sys
from collections import defaultdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, Trainer
from torch import Tensor

from i2i.callbacks.record import PredictionRecord
from i2i.data.info import DataInfo
from i2i.data.loaders import ImageDataModule
from i2i.metrics.bootstrap import Interval, instance_bootstrap
from i2i.metrics.retrieval import RetrievalMAP
from i2i.metrics.rotation import ACCURACY_DEG, FLIP_DEG, axis_error_deg, pose_scores
from i2i.rendering.reference import decimate_mesh, save_mesh
from i2i.runs.folder import RunFolder, read_json, versions, write_json
from i2i.tasks.base import Task

RESULT_FORMAT = 1
Arrays = dict[str, np.ndarray]


def summarise(arrays: Arrays, info: DataInfo, *, retrieval_samples: int = 20_000) -> dict[str, Any]:
    """Metrics of recorded test predictions, with 95 % intervals over resampled instances.

    Args:
        arrays: What `PredictionRecord` wrote.
        info: What the data are.
        retrieval_samples: At most so many images take part in the retrieval mAP.

    Returns:
        `metrics` by name, `intervals` by name as [low, high], `instances` and `images`, and
        `errors_deg` (pose; a list for each instance) or `correct` (classification; one fraction).
    """
    instance = torch.from_numpy(arrays["instance_id"])
    counts = {"instances": len(instance.unique()), "images": len(instance)}
    if "rotation_pred" in arrays:
        return _summarise_pose(arrays, info, instance) | counts
    return _summarise_classes(arrays, info, instance, retrieval_samples) | counts


def _summarise_pose(arrays: Arrays, info: DataInfo, instance: Tensor) -> dict[str, Any]:
    errors = torch.from_numpy(arrays["error_deg"]).double()
    class_id = torch.from_numpy(arrays["class_id"])
    metrics = {name: value.item() for name, value in pose_scores(errors).items()}
    if "group_correct" in arrays:
        metrics["group_accuracy"] = float(arrays["group_correct"].mean())
    intervals = {"median_error_deg": _ends(instance_bootstrap(errors, instance))}
    flags = {f"acc_at_{deg}deg": errors < deg for deg in ACCURACY_DEG}
    flags["flip_rate"] = errors > FLIP_DEG
    for name, flag in flags.items():
        intervals[name] = _ends(instance_bootstrap(flag.double(), instance, statistic="mean"))
    medians = []
    for index, name in enumerate(info.class_names):
        mine = class_id == index
        if not mine.any():
            continue
        for key, value in pose_scores(errors[mine]).items():
            metrics[f"{name}/{key}"] = value.item()
        medians.append(metrics[f"{name}/median_error_deg"])
        key = f"{name}/median_error_deg"
        intervals[key] = _ends(instance_bootstrap(errors[mine], instance[mine]))
        if info.symmetry[index] == "z":
            axis = axis_error_deg(
                torch.from_numpy(arrays["rotation_pred"])[mine],
                torch.from_numpy(arrays["rotation_true"])[mine],
            )
            metrics[f"{name}/median_axis_error_deg"] = axis.quantile(0.5).item()
    metrics["mean_class_median_error_deg"] = float(np.mean(medians))
    by_instance = [
        [round(value, 2) for value in errors[instance == i].tolist()] for i in instance.unique()
    ]
    return {"metrics": metrics, "intervals": intervals, "errors_deg": by_instance}


def _summarise_classes(
    arrays: Arrays, info: DataInfo, instance: Tensor, retrieval_samples: int
) -> dict[str, Any]:
    logits = torch.from_numpy(arrays["logits"])
    labels = torch.from_numpy(arrays["class_id"])
    correct = (logits.argmax(dim=1) == labels).double()
    metrics = {"accuracy": correct.mean().item()}
    for index, name in enumerate(info.class_names):
        if (labels == index).any():
            metrics[f"{name}/accuracy"] = correct[labels == index].mean().item()
    retrieval = RetrievalMAP(max_queries=retrieval_samples)
    retrieval.update(logits, torch.from_numpy(arrays["descriptor"]), labels, instance)
    metrics |= {name: value.item() for name, value in retrieval.compute().items()}
    interval = instance_bootstrap(correct, instance, statistic="mean")
    fractions = [round(correct[instance == i].mean().item(), 4) for i in instance.unique()]
    return {"metrics": metrics, "intervals": {"accuracy": _ends(interval)}, "correct": fractions}


def _ends(interval: Interval) -> list[float]:
    return [interval.low, interval.high]


def finish(
    folder: RunFolder, trainer: Trainer, task: Task, *, config: dict[str, Any], identity: str
) -> dict[str, float]:
    """Write metrics, reference meshes, figures and the small result of a run that went through.

    Returns:
        Final metrics by name, `test/...`; empty where no test was run.
    """
    record = next((c for c in _callbacks(trainer) if isinstance(c, PredictionRecord)), None)
    if not trainer.is_global_zero:
        return {}
    datamodule: ImageDataModule = trainer.datamodule  # type: ignore[attr-defined]
    save_reference_meshes(folder, task.info, datamodule)
    if record is None or not record.arrays:
        folder.write_status("done")
        return {}
    summary = summarise(record.arrays, task.info)
    write_json(folder.metrics, summary)
    draw(folder, record.arrays, task, datamodule)
    result = {
        "format": RESULT_FORMAT,
        "label": config.get("label"),
        "job": describe(config),
        "config_hash": identity,
        "parameters": sum(p.numel() for p in task.network.parameters() if p.requires_grad),
        "steps": trainer.global_step,
        "versions": versions(),
        **summary,
    }
    write_json(folder.path / "result.json", result)
    if config["paths"]["results_dir"]:
        write_json(
            Path(config["paths"]["results_dir"]) / f"{_file_name(config, identity)}.json", result
        )
    folder.write_status("done")
    return {f"test/{name}": value for name, value in summary["metrics"].items()}


def _callbacks(trainer: Trainer) -> list[Callback]:
    found: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    return found


def describe(config: dict[str, Any]) -> dict[str, Any]:
    """The choices that tell one job from another, flat."""
    data, model, scale = config["data"], config["model"], config["scale"]
    encoder = model.get("encoder") or {}
    return {
        "model": model["name"],
        "task": config["task"]["name"],
        "data": data["name"],
        "object": data.get("object"),
        "modality": data["modality"],
        "scale": scale["name"],
        "seed": config["seed"],
        "views_per_instance": data.get("views_per_instance"),
        "precision": str(config["trainer"]["precision"]),
        "image_size": data["image_size"],
        "label_frame": model.get("label_frame"),
        "stem_mode": encoder.get("stem_mode"),
        "labels": scale.get("labels"),
        "sigma": scale.get("sigma"),
    }


def _file_name(config: dict[str, Any], identity: str) -> str:
    job = describe(config)
    object_name = job["object"] if isinstance(job["object"], str) else "-".join(job["object"])
    return f"{job['model']}-{job['data']}-{object_name}-{job['scale']}-{identity}"


def save_reference_meshes(folder: RunFolder, info: DataInfo, datamodule: ImageDataModule) -> None:
    """Keep one decimated mesh of each class, so that predictions can be drawn without the data."""
    for name in info.class_names:
        path = folder.reference_meshes / f"{name}.npz"
        mesh = None if path.exists() else datamodule.reference_mesh(name)
        if mesh is not None:
            folder.reference_meshes.mkdir(parents=True, exist_ok=True)
            save_mesh(decimate_mesh(mesh), path)


def draw(folder: RunFolder, arrays: Arrays, task: Task, datamodule: ImageDataModule) -> None:
    """Write the figures of a test: errors, and a grid of predictions."""
    from i2i.viz.results import result_figures
    from i2i.viz.style import save_figure

    folder.figures.mkdir(parents=True, exist_ok=True)
    for name, figure in result_figures(arrays, task.info, datamodule).items():
        save_figure(figure, folder.figures / f"{name}.png")


def collect(folder: Path) -> list[dict[str, Any]]:
    """Every result JSON below a folder, in the order of their paths."""
    found = [read_json(path) for path in sorted(folder.rglob("*.json"))]
    return [result for result in found if result.get("format") == RESULT_FORMAT]


def table(results: list[dict[str, Any]]) -> str:
    """Markdown table of pose results: one row a label and number of views, seeds pooled.

    Intervals resample instances; an instance keeps its errors of all seeds together.
    """
    rows: dict[tuple[str, Any], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        if "errors_deg" in result and result["label"]:
            rows[result["label"], result["job"]["views_per_instance"]].append(result)
    lines = [
        "| | views | seeds | steps | median error (°) | Acc@15 (%) | Acc@30 (%) |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    for (label, views), members in rows.items():
        pooled = [
            list(chain.from_iterable(lists))
            for lists in zip(*(m["errors_deg"] for m in members), strict=True)
        ]
        errors = torch.tensor(list(chain.from_iterable(pooled)), dtype=torch.float64)
        instance = torch.tensor([i for i, e in enumerate(pooled) for _ in e])
        cells = [_cell(instance_bootstrap(errors, instance), 1)]
        for limit in ACCURACY_DEG:
            inside = (errors < limit).double()
            cells.append(_cell(instance_bootstrap(inside, instance, statistic="mean"), 100))
        steps = "/".join(map(str, sorted({m["steps"] for m in members})))
        lines.append(
            f"| {label} | {views} | {len(members)} | {steps} | " + " | ".join(cells) + " |"
        )
    return "\n".join(lines)


def _cell(interval: Interval, unit: float) -> str:
    digits = 1 if unit == 1 else 0
    value, low, high = (unit * v for v in (interval.value, interval.low, interval.high))
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def main() -> None:
    """Print the table of the results below a folder (default: results)."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
    results = collect(folder)
    if not results:
        sys.exit(
            f"error: no results below {folder}; a run leaves one with paths.results_dir={folder}"
        )
    print(table(results))
    scales = sorted({json.dumps([r["job"]["scale"], r["job"]["data"]]) for r in results})
    print(f"\n{len(results)} jobs; scale and source: {', '.join(scales)}")


if __name__ == "__main__":
    main()
