"""Peak resident memory of training, in a fresh process, and the time of a step.

python benchmarks/training_memory.py                  # i2i, scale=paper, batch 64, fp32
python benchmarks/training_memory.py scale=small trainer.precision=bf16-mixed
python benchmarks/training_memory.py --clouds-and-views   # those of tables 1 and 3, small and paper
"""

import multiprocessing
import resource
import sys
import time
from collections.abc import Sequence

import torch
from rich.console import Console
from rich.table import Table

from i2i.configuration import compose
from i2i.data.noise import noise_batch
from i2i.runs.building import build_network, info_of

STEPS = 4
CLOUDS_AND_VIEWS = (
    ("kpconv", "pose"),
    ("kpconv_rigid", "pose"),
    ("epn", "pose"),
    ("pointnet2", "classification"),
    ("kpconv", "classification"),
    ("epn", "classification"),
    ("rotationnet_20", "classification"),
    ("emvn_12", "classification"),
)


def measure(words: Sequence[str]) -> dict[str, float | int | str]:
    """Train a network of noise for a few steps; call it in a process of its own."""
    config = compose(words)
    batch = config.data.batch_size
    classes = 1 if config.task.name == "pose" else 40
    info = info_of(config, tuple(f"class {i}" for i in range(classes)))
    network = build_network(config, info)
    optimizer = torch.optim.SGD(network.parameters(), 1e-3, momentum=0.9, nesterov=True)
    data = noise_batch(info, batch)
    seconds = []
    for _ in range(STEPS):
        start = time.perf_counter()
        low = "bf16" in str(config.trainer.precision)
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            loss = sum(network.loss(network(data), data).values())
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        seconds.append(time.perf_counter() - start)
    return {
        "model": f"{config.model.name}, {config.task.name}",
        "scale": config.scale.name,
        "input": f"{info.num_points} points" if info.num_points else f"{info.image_size} px",
        "batch": batch,
        "parameters": sum(p.numel() for p in network.parameters()),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "step_s": sorted(seconds)[STEPS // 2],
    }


def main() -> None:
    words = sys.argv[1:]
    jobs = [["scale=paper", *words]]
    if "--clouds-and-views" in words:
        others = [word for word in words if not word.startswith("--")]
        jobs = [
            [f"model={model}", f"task={task}", f"scale={scale}", *others]
            for scale in ("small", "paper")
            for model, task in CLOUDS_AND_VIEWS
        ]
    table = Table(
        "model", "scale", "input", "batch", "parameters", "peak, GiB", "s a step", "steps/s"
    )
    for job in jobs:
        # A process of its own for each: the peak of a process never falls.
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(measure, (job,))
        table.add_row(
            *(str(row[key]) for key in ("model", "scale", "input", "batch")),
            f"{row['parameters']:,}", f"{row['peak_gib']:.2f}", f"{row['step_s']:.2f}",
            f"{1 / float(row['step_s']):.2f}",
        )  # fmt: skip
    Console(width=110).print(table)
    print(f"{torch.get_num_threads()} threads, {STEPS} steps each, the upper middle time")


if __name__ == "__main__":
    main()
