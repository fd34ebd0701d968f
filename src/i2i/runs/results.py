"""What a finished run says: metrics with intervals, figures, and the JSON that tables come from.

`python -m i2i.runs.results [folder [label]]` prints the table of the published results.
"""

import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric

from i2i.configuration import slug
from i2i.data.info import DataInfo
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.metrics.bootstrap import Interval, instance_bootstrap, paired_median_difference
from i2i.metrics.classification import ClassAccuracy
from i2i.metrics.likelihood import WITHIN_DEG, calibration_error
from i2i.metrics.retrieval import RetrievalMAP
from i2i.metrics.rotation import ACCURACY_DEG, FLIP_DEG, PoseErrors
from i2i.runs.folder import read_json, versions
from i2i.runs.identity import identity_config

RESULT_FORMAT = 1
Arrays = dict[str, np.ndarray]


def summarise(arrays: Arrays, info: DataInfo, *, retrieval_samples: int = 20_000) -> dict[str, Any]:
    """Metrics of recorded test predictions, with 95 % intervals over resampled instances.

    The arrays are those of all processes already, so nothing is reduced here.

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
    correct = arrays.get("group_correct")
    metric = PoseErrors(info.class_names, info.symmetry, sync_on_compute=False)
    metric.update(
        torch.from_numpy(arrays["rotation_pred"]),
        torch.from_numpy(arrays["rotation_true"]),
        class_id=class_id,
        instance_id=instance,
        group_correct=None if correct is None else torch.from_numpy(correct),
    )
    intervals = {"median_error_deg": _ends(instance_bootstrap(errors, instance))}
    flags = {f"acc_at_{deg}deg": errors < deg for deg in ACCURACY_DEG}
    flags["flip_rate"] = errors > FLIP_DEG
    for name, flag in flags.items():
        intervals[name] = _ends(instance_bootstrap(flag.double(), instance, statistic="mean"))
    for name, interval in metric.median_intervals().items():
        intervals[f"{name}/median_error_deg"] = _ends(interval)
    metrics = _numbers(metric)
    if "log_likelihood" in arrays or "point_log_likelihood" in arrays:
        scores, their_intervals = _summarise_densities(arrays, info, class_id, instance)
        metrics, intervals = metrics | scores, intervals | their_intervals
    by_instance = [
        [round(value, 2) for value in errors[instance == i].tolist()] for i in instance.unique()
    ]
    return {"metrics": metrics, "intervals": intervals, "errors_deg": by_instance}


def _summarise_densities(
    arrays: Arrays, info: DataInfo, class_id: Tensor, instance: Tensor
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Log-likelihood, spread and calibration, and their intervals.

    With `point_` in front they are of one component at the best guess; `likelihood_gain` is what
    the distribution is better than that.
    """
    angle = torch.zeros(len(instance), dtype=torch.float64)
    for index, symmetry in enumerate(info.symmetry):
        mine = class_id == index
        predicted, true = (
            torch.from_numpy(arrays[f"rotation_{which}"]).double()[mine]
            for which in ("pred", "true")
        )
        angle[mine] = symmetric_angle_rad(predicted, true, symmetry)
    right = torch.rad2deg(angle) < WITHIN_DEG
    columns: dict[str, Tensor] = {}
    scores: dict[str, float] = {}
    for prefix in ("", "point_"):
        if f"{prefix}log_likelihood" not in arrays:
            continue
        for name in (f"{prefix}log_likelihood", f"{prefix}spread_deg"):
            columns[name] = torch.from_numpy(arrays[name]).double()
        within = torch.from_numpy(arrays[f"{prefix}within_30deg"])
        scores[f"{prefix}calibration_error"] = calibration_error(within, right).item()
    if {"log_likelihood", "point_log_likelihood"} <= columns.keys():
        gain = columns["log_likelihood"] - columns["point_log_likelihood"]
        columns["likelihood_gain"] = gain
    intervals = {
        name: _ends(instance_bootstrap(values, instance, statistic="mean"))
        for name, values in columns.items()
    }
    return scores | {name: values.mean().item() for name, values in columns.items()}, intervals


def _summarise_classes(
    arrays: Arrays, info: DataInfo, instance: Tensor, retrieval_samples: int
) -> dict[str, Any]:
    logits = torch.from_numpy(arrays["logits"])
    labels = torch.from_numpy(arrays["class_id"])
    accuracy = ClassAccuracy(info.class_names, sync_on_compute=False)
    accuracy.update(logits, labels)
    retrieval = RetrievalMAP(max_queries=retrieval_samples, sync_on_compute=False)
    retrieval.update(logits, torch.from_numpy(arrays["descriptor"]), labels, instance)
    correct = (logits.argmax(dim=1) == labels).double()
    interval = instance_bootstrap(correct, instance, statistic="mean")
    return {
        "metrics": _numbers(accuracy) | _numbers(retrieval),
        "intervals": {"accuracy": _ends(interval)},
        "correct": [round(correct[instance == i].mean().item(), 4) for i in instance.unique()],
    }


def _numbers(metric: Metric) -> dict[str, float]:
    return {name: float(value) for name, value in metric.compute().items()}


def _ends(interval: Interval) -> list[float]:
    return [interval.low, interval.high]


def result(
    summary: dict[str, Any],
    config: dict[str, Any],
    *,
    identity: str,
    instance_names: Sequence[str],
    parameters: int,
    steps: int,
) -> dict[str, Any]:
    """The small JSON of a finished job: what it was, what it gave, what made it.

    Args:
        summary: Of `summarise`.
        config: The run's resolved configuration.
        identity: Its hash.
        instance_names: Name of each test instance, in the order of the summary's errors.
        parameters: Trainable parameters of the network.
        steps: Optimiser steps.
    """
    return {
        "format": RESULT_FORMAT,
        "label": config.get("label"),
        "job": describe(config),
        "config_hash": identity,
        "identity": identity_config(config),
        "parameters": parameters,
        "steps": steps,
        "instance_names": list(instance_names),
        "versions": versions(),
        **summary,
    }


def file_name(config: dict[str, Any], identity: str) -> str:
    """Name of a job's JSON, from what it is and its hash."""
    job = describe(config)
    return f"{job['model']}-{job['data']}-{slug(job['object'])}-{job['scale']}-{identity}.json"


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
        "split": data.get("split"),
        "fold": data.get("fold"),
        "precision": str(config["trainer"]["precision"]),
        "image_size": data["image_size"],
        "target": model.get("target"),
        "group_frame": model.get("group_frame"),
        "projector_axes": model.get("projector_axes"),
        "stem_mode": encoder.get("stem_mode"),
        "labels": scale.get("labels"),
        "reg_on": scale.get("reg_on"),
        "sigma": scale.get("sigma"),
        "shift_px": data.get("shift_px"),
        "test_shift_px": data.get("test_shift_px"),
        "depth_shift": data.get("depth_shift"),
        "test_depth_shift": data.get("test_depth_shift"),
    }


def collect(folder: Path) -> list[dict[str, Any]]:
    """Every result JSON below a folder, in the order of their paths."""
    found = [read_json(path) for path in sorted(folder.rglob("*.json"))]
    return [result for result in found if result.get("format") == RESULT_FORMAT]


def table(results: list[dict[str, Any]], *, against: str | None = None) -> str:
    """Markdown table of pose results: one row a label and number of views, seeds pooled.

    Intervals resample instances; an instance keeps its errors of all seeds together.

    Args:
        results: Of `collect`.
        against: Label of a row to compare the others of as many views with: the last column is the
            difference of the medians over the seeds that both have, resampled in pairs.
    """
    rows: dict[tuple[str, int, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        if "errors_deg" in result and result["label"]:
            job = result["job"]
            what = json.dumps([job[key] for key in ("data", "object", "scale", "fold")])
            rows[what, job["views_per_instance"], result["label"]].append(result)
    head = ["", "views", "seeds", "steps", "median error (°)", "Acc@15 (%)", "Acc@30 (%)"]
    head += [f"less than “{against}” by (°)"] if against else []
    lines = ["| " + " | ".join(head) + " |", "|---" + "|--:" * (len(head) - 1) + "|"]
    for (what, views, label), members in sorted(rows.items()):
        errors, instance = pooled_errors(members)
        cells = [_cell(instance_bootstrap(errors, instance), 1)]
        for limit in ACCURACY_DEG:
            inside = (errors < limit).double()
            cells.append(_cell(instance_bootstrap(inside, instance, statistic="mean"), 100))
        if against:
            cells.append(_compared(rows.get((what, views, against), []), members))
        steps = "/".join(map(str, sorted({m["steps"] for m in members})))
        seeds = len({m["job"]["seed"] for m in members})
        lines.append("| " + " | ".join([label, str(views), str(seeds), steps, *cells]) + " |")
    return "\n".join(lines)


def pooled_errors(members: list[dict[str, Any]]) -> tuple[Tensor, Tensor]:
    """Errors of all seeds and the instances that they belong to."""
    pooled: dict[str, list[float]] = defaultdict(list)
    for member in sorted(members, key=lambda m: m["job"]["seed"]):
        for name, values in zip(member["instance_names"], member["errors_deg"], strict=True):
            pooled[name] += values
    errors = torch.tensor([e for v in pooled.values() for e in v], dtype=torch.float64)
    return errors, torch.tensor([i for i, v in enumerate(pooled.values()) for _ in v])


def _compared(baseline: list[dict[str, Any]], members: list[dict[str, Any]]) -> str:
    seeds = {m["job"]["seed"] for m in baseline} & {m["job"]["seed"] for m in members}
    if not seeds or baseline == members:
        return ""
    first, instance = pooled_errors([m for m in baseline if m["job"]["seed"] in seeds])
    second, same = pooled_errors([m for m in members if m["job"]["seed"] in seeds])
    if not torch.equal(instance, same):
        return ""
    return _cell(paired_median_difference(first, second, instance), 1)


def _cell(interval: Interval, unit: float) -> str:
    digits = 1 if unit == 1 else 0
    value, low, high = (unit * v for v in (interval.value, interval.low, interval.high))
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def main() -> None:
    """Print the table of the results below a folder, compared with the row of a label if given."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
    against = sys.argv[2] if len(sys.argv) > 2 else None
    results = collect(folder)
    if not results:
        sys.exit(
            f"error: no results below {folder}; a run leaves one with paths.results_dir={folder}"
        )
    print(table(results, against=against))
    scales = sorted({json.dumps([r["job"]["scale"], r["job"]["data"]]) for r in results})
    print(f"\n{len(results)} jobs; scale and source: {', '.join(scales)}")


if __name__ == "__main__":
    main()
