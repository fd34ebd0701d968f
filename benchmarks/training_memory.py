"""Peak resident memory of training, and the times of a step and of its batch of data.

python benchmarks/training_memory.py                  # i2i, scale=paper, batch 64, fp32
python benchmarks/training_memory.py scale=small trainer.precision=bf16-mixed
python benchmarks/training_memory.py --clouds-and-views   # those of tables 1 and 3, small and paper
"""

import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from statistics import median

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from i2i.configuration import compose
from i2i.runs.building import build_datamodule, build_network

STEPS = 3
OBJECTS = 26  # at least a batch of them where a pass shows each once
CLOUDS_AND_VIEWS = (
    "model=kpconv task=pose",
    "model=kpconv_rigid task=pose",
    "model=epn task=pose",
    "model=pointnet2 task=classification",
    "model=kpconv task=classification",
    "model=epn task=classification",
    "model=emvn_12 task=classification",
    "model=emvn_60 task=classification",
    "model=rotationnet_20 task=classification",
    "model=rotationnet_20 model/trunk=alexnet task=classification",
)
COLUMNS = "| model | scale | a sample | batch | parameters | peak, GiB | s a step | ms its data |"


def configuration(words: Sequence[str], store_root: str) -> DictConfig:
    """Training on a few made chairs, or chairs and tables."""
    pose = compose(words).task.name == "pose"
    few = [
        "data=synthetic", f"data.store_root={store_root}",
        f"data.object={'chair' if pose else '[chair,table]'}",
        f"data.source.instances_per_class={OBJECTS if pose else OBJECTS // 2}",
        "data.source.test_instances_per_class=1", "data.test_views_per_instance=1",
    ]  # fmt: skip
    return compose([*few, *words])


def measure(words: Sequence[str], store_root: str) -> str:
    """A row of the table; called in a process of its own, as the peak of one never falls."""
    config = configuration(words, store_root)
    data = build_datamodule(config)
    data.prepare_data()
    data.setup("fit")
    classes = 1 if config.task.name == "pose" else 40
    info = replace(
        data.info,
        class_names=tuple(f"class {i}" for i in range(classes)),
        symmetry=("none",) * classes,
    )
    network = build_network(config, info)
    optimizer = instantiate(config.task.optimizer)(network.parameters())
    low = "bf16" in str(config.trainer.precision)
    batches, waits, steps = iter(data.train_dataloader()), [], []
    for _ in range(STEPS):
        start = time.perf_counter()
        try:
            batch = next(batches)
        except StopIteration:  # the few objects are over
            batches = iter(data.train_dataloader())
            batch = next(batches)
        loaded = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            loss = sum(network.loss(network(batch), batch).values())
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        waits.append(loaded - start)
        steps.append(time.perf_counter() - loaded)
    shown = f"{info.num_points} points" if info.num_points else f"{info.image_size} px"
    if info.num_views:
        shown = f"{info.num_views} × {shown}"
    count = sum(p.numel() for p in network.parameters())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return (
        f"| {' '.join(words)} | {config.scale.name} | {shown} | {len(batch['class_id'])} | "
        f"{count:,} | {peak:.2f} | {median(steps):.2f} | {1000 * median(waits):.0f} |"
    )


def main() -> None:
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    jobs = [words if any(w.startswith("scale=") for w in words) else ["scale=paper", *words]]
    if "--clouds-and-views" in sys.argv:
        jobs = [
            [*job.split(), f"scale={scale}", *words]
            for scale in ("small", "paper")
            for job in CLOUDS_AND_VIEWS
        ]
    print(COLUMNS, "|---" * COLUMNS.count(" | ") + "|---|", sep="\n", flush=True)
    for job in jobs:
        with tempfile.TemporaryDirectory() as store_root:
            build_datamodule(configuration(job, store_root)).prepare_data()
            context = multiprocessing.get_context("spawn")
            try:
                with ProcessPoolExecutor(1, mp_context=context) as pool:
                    print(pool.submit(measure, job, store_root).result(), flush=True)
            except BrokenProcessPool:
                print(f"| {' '.join(job)} | ended by the system: too little memory |", flush=True)
    print(f"{torch.get_num_threads()} threads; medians of {STEPS} steps on made objects")


if __name__ == "__main__":
    main()
