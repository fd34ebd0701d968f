"""Made-up results of finished jobs."""

import json

import numpy as np
import pytest

SKILL_DEG = {"i2i": 8.0, "cnn_gs": 40.0, "e2cnn_eq": 8.2}


def made(
    model="i2i",
    *,
    obj="chair",
    seed=0,
    modality="gray",
    data="synthetic",
    scale="small",
    views=60,
    steps=600,
    task="pose",
    changes=(),
    instances=8,
    images=6,
    number=None,
    **job,
):
    """The JSON of a job; its errors are a function of model, class, views and seed."""
    name = [obj] if isinstance(obj, str) else list(obj)
    draw = np.random.default_rng(abs(hash_of(model, obj, seed, views, modality, job)))
    names = [f"{c}/{i}" for c in name for i in range(instances)]
    changed = {"seed": seed} if seed else {}
    changed |= {"data.sampler_seed": seed} if seed else {}
    changed |= {"data.object": obj} if obj != "chair" else {}
    changed |= {"data.views_per_instance": views} if views != 60 else {}
    if steps != 1500:
        changed |= {"trainer.max_steps": steps, "task.scheduler.total_steps": steps}
    content = {
        "format": 1,
        "label": None,
        "job": {"model": model, "task": task, "data": data, "object": obj, "modality": modality,
                "scale": scale, "seed": seed, "views_per_instance": views, "precision": "32-true",
                "shift_px": 4, "test_shift_px": 0, "depth_shift": 0, "test_depth_shift": 0, **job},
        "identity": identity_with(changed | dict(changes), model, task, data, scale),
        "parameters": 730951 if model == "i2i" else 700000,
        "steps": steps,
        "instance_names": names,
        "instances": len(names),
        "images": images * len(names),
    }  # fmt: skip
    if task == "pose":
        level = SKILL_DEG.get(model, 20.0) * (60 / views)
        errors = draw.gamma(4.0, level / 4, (len(names), images)).round(2)
        content["errors_deg"] = errors.tolist()
        content["metrics"] = {"median_error_deg": float(np.median(errors))}
        for index, c in enumerate(name):
            mine = errors[index * instances : (index + 1) * instances]
            content["metrics"][f"{c}/median_error_deg"] = float(np.median(mine))
    else:
        correct = draw.integers(0, images + 1, len(names)) / images
        content["correct"] = correct.round(4).tolist()
        content["metrics"] = {"accuracy": float(correct.mean()), "map_retrieval": 0.61,
                              "map_retrieval_class_first": 0.72, "map_class": 0.83}  # fmt: skip
    content["config_hash"] = number or f"{hash_of(json.dumps(content, sort_keys=True)):012x}"
    return content


def identity_with(changed, *names):
    """The identity of a plain job of these names, with changes by dotted key."""
    from i2i.runs.identity import _standard

    identity = json.loads(json.dumps(_standard(*names) or {}))
    for key, value in changed.items():
        place, path = identity, key.split(".")
        for name in path[:-1]:
            place = place.setdefault(name, {})
        if value is None:
            place.pop(path[-1], None)
        else:
            place[path[-1]] = value
    return identity


def hash_of(*parts):
    """A number that is the same in every process."""
    import zlib

    return zlib.crc32(repr(parts).encode())


@pytest.fixture
def keep(tmp_path):
    """Writes results into a folder, returns the folder."""

    def write(*contents, folder="results"):
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        for index, content in enumerate(contents):
            (place / f"{index:03d}.json").write_text(json.dumps(content))
        return place

    return write


@pytest.fixture
def read(keep):
    """The same results as reports read them."""
    from i2i.reports.results import read_results

    def through_files(*contents, folder="results"):
        return read_results([keep(*contents, folder=folder)], None)[0]

    return through_files
