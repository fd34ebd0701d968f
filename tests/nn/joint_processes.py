"""What the tests of batch norm over processes run in each of them."""

import copy
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor, distributed, nn

from i2i.nn import native
from i2i.nn.c4_dispatch import convolution_mode
from i2i.nn.c4_norm import C4BatchNorm

PROCESSES = 2


class PixelMajor(nn.Module):
    """C4 batch norm of pixel-major maps, the batch first for once, with ReLU.

    With a shortcut, or in torch's form in the second process only, as where one machine has no
    compiler.
    """

    def __init__(self, fields, *, with_shortcut=False, mixed=False):
        super().__init__()
        self.norm = C4BatchNorm(fields)
        self.with_shortcut, self.mixed = with_shortcut, mixed

    def forward(self, x):
        x = x.permute(1, 2, 3, 0).contiguous()
        shortcut = 0.5 * x if self.with_shortcut else None
        # The backward pass of one form is that form's.
        is_torch = self.mixed and distributed.is_initialized() and distributed.get_rank() == 1
        with native.torch_only() if is_torch else nullcontext():
            out = self.norm.pixel_major(x, shortcut=shortcut, relu=True)
        return out.permute(3, 0, 1, 2)


def in_processes(work, folder: Path, *given, processes: int = PROCESSES) -> list:
    """What `work(rank, *given)` returns in each of a few processes that share a group."""
    torch.multiprocessing.spawn(_run, args=(processes, work, str(folder), given), nprocs=processes)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(processes)]


def _run(rank: int, processes: int, work, folder: str, given: tuple) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=processes
    )
    torch.save(work(rank, *given), Path(folder) / f"{rank}.pt")
    distributed.destroy_process_group()


def share(x: Tensor, rank: int) -> Tensor:
    """The part of a batch that a process sees."""
    return x.chunk(PROCESSES)[rank]


def layer_step(module: nn.Module, x: Tensor, upstream: Tensor) -> dict[str, Tensor]:
    """Output, gradients, and running statistics of the batch norms."""
    x = x.clone().requires_grad_()
    module = copy.deepcopy(module).train()  # processes share the memory of what they are given
    out = module(x)
    out.backward(upstream)
    return {
        "out": out.detach(),
        "of x": x.grad,
        **{f"of {name}": p.grad for name, p in module.named_parameters()},
        **{name: b.clone() for name, b in module.named_buffers() if "running" in name},
    }


def layer_in_process(rank: int, cases: dict[str, tuple]) -> dict[str, dict[str, Tensor]]:
    """`layer_step` of each case with this process's share of its batch."""
    return {
        name: layer_step(module, share(x, rank), share(upstream, rank))
        for name, (module, x, upstream) in cases.items()
    }


def network_step(network: nn.Module, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Loss, gradients of the parameters, and running statistics."""
    network = copy.deepcopy(network).train()
    loss = torch.stack(list(network.loss(network(batch), batch).values())).sum()
    loss.backward()
    return {
        "loss": loss.detach(),
        **{f"of {n}": p.grad for n, p in network.named_parameters() if p.grad is not None},
        **{name: b.clone() for name, b in network.named_buffers() if "running" in name},
    }


def network_in_process(
    rank: int, cases: dict[str, tuple], convolution: str
) -> dict[str, dict[str, Tensor]]:
    """`network_step` of each case with this process's share of its batch."""
    with convolution_mode(convolution):
        return {
            name: network_step(network, {key: share(value, rank) for key, value in batch.items()})
            for name, (network, batch) in cases.items()
        }
