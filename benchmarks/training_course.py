"""The same training in dense and in spectral form: how far apart the losses are, and why.

python benchmarks/training_course.py               # small, 50 steps of each variant, some minutes
python benchmarks/training_course.py --scale paper --only float32      # a quarter of an hour

Each variant starts from the same weights and sees the same batches (made chairs), with the recipe
of the scale and the regression loss ungated. In float64 both forms have the same losses. In float32
they part, and the table says how much of that is theirs: it has beside them float64 itself from
weights that differ by one rounding of float32, and float32 in one form with another order of sums
(one thread instead of two).
"""

import argparse
import copy
import tempfile
from collections.abc import Iterator

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor, nn

from i2i.configuration import compose
from i2i.memory import reuse_memory
from i2i.nn.c4_dispatch import convolution_mode
from i2i.runs.building import build_datamodule, build_network

REFERENCE = "dense, float64"
ROUNDING = 2.0**-24  # relative, of float32
# Form, type, threads, and whether the first weights are a rounding away.
VARIANTS = {
    REFERENCE: ("dense", torch.float64, 2, False),
    "spectral, float64": ("spectral", torch.float64, 2, False),
    "dense, float64, weights a rounding away": ("dense", torch.float64, 2, True),
    "dense, float32": ("dense", torch.float32, 2, False),
    "dense, float32, one thread": ("dense", torch.float32, 1, False),
    "spectral, float32": ("spectral", torch.float32, 2, False),
}
PAIRS = (
    ("spectral, float64", REFERENCE),
    ("dense, float64, weights a rounding away", REFERENCE),
    ("dense, float32", REFERENCE),
    ("dense, float32, one thread", REFERENCE),
    ("spectral, float32", REFERENCE),
    ("spectral, float32", "dense, float32"),
    ("dense, float32, one thread", "dense, float32"),
)
Batch = dict[str, Tensor]


def batches_of(
    options: argparse.Namespace, folder: str
) -> tuple[nn.Module, list[Batch], int, DictConfig]:
    """The network, its batches, after how many its schedule goes on, and the configuration."""
    size = [] if options.batch is None else [f"scale.batch_size={options.batch}"]
    config = compose(
        ["model=i2i", "task=pose", f"scale={options.scale}", "data=synthetic", "data.object=chair",
         f"data.store_root={folder}", "data.source.instances_per_class=60",
         "data.source.test_instances_per_class=1", "scale.reg_on=gt_always",
         "trainer.max_steps=1500", *size]
    )  # fmt: skip
    data = build_datamodule(config)
    data.prepare_data()
    data.setup("fit")
    torch.manual_seed(0)
    network = build_network(config, data.info)

    def endless() -> Iterator[Batch]:
        while True:
            yield from data.train_dataloader()

    batches = [batch for batch, _ in zip(endless(), range(options.steps), strict=False)]
    interval = 1 if config.task.scheduler_interval == "step" else len(data.train_dataloader())
    return network, batches, interval, config


def course(
    network: nn.Module,
    batches: list[Batch],
    interval: int,
    config: DictConfig,
    form: str,
    dtype: torch.dtype,
    threads: int,
    rounded: bool,
) -> tuple[Tensor, Tensor]:
    """Losses of all steps, and the gradient of the first."""
    torch.set_num_threads(threads)
    network = copy.deepcopy(network).to(dtype).train()
    if rounded:
        noise = torch.Generator().manual_seed(1)
        for weights in network.parameters():
            factor = torch.randn(weights.shape, generator=noise, dtype=dtype)
            weights.data.mul_(1 + ROUNDING * factor)
    optimizer = instantiate(config.task.optimizer)(network.parameters())
    schedule = instantiate(config.task.scheduler)(optimizer)
    clip = config.trainer.gradient_clip_val
    losses: list[float] = []
    first = torch.empty(0)
    with convolution_mode(form):
        for step, batch in enumerate(batches, start=1):
            given = {k: v.to(dtype) if v.is_floating_point() else v for k, v in batch.items()}
            loss = torch.stack(list(network.loss(network(given), given).values())).sum()
            optimizer.zero_grad()
            loss.backward()
            if not losses:
                grads = [p.grad.flatten() for p in network.parameters() if p.grad is not None]
                first = torch.cat(grads).double()
            if clip:
                nn.utils.clip_grad_norm_(network.parameters(), clip)
            optimizer.step()
            if step % interval == 0:
                schedule.step()
            losses.append(loss.item())
    return torch.tensor(losses, dtype=torch.float64), first


def main() -> None:
    """Train all variants and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="small")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--batch", type=int, help="the scale's, if not given")
    parser.add_argument("--only", choices=("float32", "float64"), help="variants of one type")
    options = parser.parse_args()
    reuse_memory()
    with tempfile.TemporaryDirectory() as folder:
        given = batches_of(options, folder)
    found = {
        name: course(*given, *how)
        for name, how in VARIANTS.items()
        if options.only is None or options.only in name
    }
    stops = [step for step in (10, 25) if step < options.steps] + [options.steps]
    titles = [f"largest to step {stop}" for stop in stops]
    print(f"Relative differences, scale={options.scale}:\n")
    print(f"| | against | first gradient | median | {' | '.join(titles)} |")
    print("|---|---|--:|--:|" + "--:|" * len(stops))
    for name, other in PAIRS:
        if not {name, other} <= set(found):
            continue
        (losses, gradient), (expected, right) = found[name], found[other]
        of_gradient = (gradient - right).norm() / right.norm()
        differences = (losses - expected).abs() / expected.abs()
        numbers = [of_gradient, differences.median(), *(differences[:stop].max() for stop in stops)]
        print(f"| {name} | {other} | {' | '.join(f'{x.item():.1e}' for x in numbers)} |")


if __name__ == "__main__":
    main()
