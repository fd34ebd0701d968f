"""One process with two threads against two processes with one each (DDP), on the same batches.

python benchmarks/processes.py                       # scale=paper, batch 64, some minutes
python benchmarks/processes.py --scale small --steps 20

Rounds by turns, each in fresh processes; the time of a step is the median within a round, counted
in all processes from a common start. Both see the same joint batches and begin from the same
weights, so that their losses agree up to rounding; the largest difference is printed. Beside them
stand two processes that train on half the batch each and tell each other nothing: what is left of
their time is not for any exchange to save.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from i2i.data.noise import noise_batch
from i2i.memory import reuse_memory
from i2i.nn.data_parallel import share_batch
from network_speed import network

THREADS = 2
# Processes, and whether they share a batch.
ONE, TOGETHER, APART = (1, False), (2, True), (2, False)


def run(
    rank: int, processes: int, are_joined: bool, folder: str, options: argparse.Namespace
) -> None:
    """Train a few steps as one of `processes`, and leave seconds and losses in the folder."""
    reuse_memory()
    torch.set_num_threads(THREADS // processes)
    net, info = network(options.scale)
    for module in net.modules():
        if hasattr(module, "reg_on"):  # a gated loss jumps where rounding flips an arg-max
            module.reg_on = "gt_always"
    net.train()
    model: nn.Module = Loss(net)
    if are_joined:
        meeting = f"file://{folder}/meeting"
        distributed.init_process_group("gloo", meeting, rank=rank, world_size=processes)
        model = DistributedDataParallel(model, gradient_as_bucket_view=True)
        share_batch(model)
    optimizer = torch.optim.SGD(net.parameters(), lr=1e-4, momentum=0.9, nesterov=True)
    seconds, losses = [], []
    for step in range(options.warm_up + options.steps):
        joint = noise_batch(info, options.batch, seed=step)
        batch = {name: value.chunk(processes)[rank] for name, value in joint.items()}
        if are_joined:
            distributed.barrier()
        start = time.perf_counter()
        loss = model(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step >= options.warm_up:
            seconds.append(time.perf_counter() - start)
        losses.append(loss.item())
    torch.save((seconds, losses), Path(folder) / f"{rank}.pt")


class Loss(nn.Module):
    """From a batch to the network's loss, in one forward, as DDP wants it."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """A scalar."""
        return torch.stack(list(self.net.loss(self.net(batch), batch).values())).sum()


def one_round(kind: tuple[int, bool], options: argparse.Namespace) -> tuple[float, torch.Tensor]:
    """Seconds of a step, and the losses of the joint batches."""
    processes, _ = kind
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(run, (*kind, folder, options), nprocs=processes)
        parts = [torch.load(Path(folder) / f"{rank}.pt") for rank in range(processes)]
    slowest = [max(times) for times in zip(*(part[0] for part in parts), strict=True)]
    losses = torch.tensor([part[1] for part in parts], dtype=torch.float64).mean(dim=0)
    return statistics.median(slowest), losses


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="paper")
    parser.add_argument("--batch", type=int, default=64, help="of all processes together")
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--warm-up", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    seconds: dict[tuple[int, bool], list[float]] = {ONE: [], TOGETHER: [], APART: []}
    losses = {}
    for _ in range(options.rounds):
        for kind in seconds:
            time_, losses[kind] = one_round(kind, options)
            seconds[kind].append(time_)
    middle = {kind: statistics.median(times) for kind, times in seconds.items()}
    for kind, title in (
        (ONE, f"one process, {THREADS} threads"),
        (TOGETHER, "two processes (DDP), one thread each"),
        (APART, "two that exchange nothing, one thread each"),
    ):
        low, high = min(seconds[kind]) * 1e3, max(seconds[kind]) * 1e3
        print(f"{title}: {middle[kind] * 1e3:.0f} ms a step [{low:.0f}, {high:.0f}]")
    print(f"two processes are {middle[ONE] / middle[TOGETHER]:.2f} times as fast as one;")
    print(f"with exchanges that take no time they would be {middle[ONE] / middle[APART]:.2f} times")
    differences = (losses[ONE] - losses[TOGETHER]).abs() / losses[ONE].abs()
    print(f"largest relative difference of the losses {differences.max().item():.1e}")


if __name__ == "__main__":
    main()
