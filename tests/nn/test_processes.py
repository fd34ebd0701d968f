"""What processes tell each other through memory that they share, against gloo and closed forms."""

import multiprocessing
import os
from pathlib import Path

import pytest
import torch
from joint_processes import in_processes
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from i2i.nn import native
from i2i.nn.batch_norm import JointBatchNorm1d
from i2i.nn.data_parallel import share_batch
from i2i.nn.native import exchange
from i2i.nn.processes import gather_from_processes, has_shared_memory, sum_over_processes

needs_memory = pytest.mark.skipif(
    native.library() is None or not Path("/dev/shm").is_dir(),
    reason="no compiler was found, or there is no /dev/shm",
)
SHAPES = [(1,), (3, 5), (400_000,), (2, 1_000_003)]  # the last two are several slots


def numbers(rank, dtype, shape):
    generator = torch.Generator().manual_seed(rank)
    return torch.randn(shape, generator=generator).mul(100).to(dtype)


def of_all(rank):
    """What arrives in this process, by type and shape."""
    assert has_shared_memory()
    found = {}
    for dtype in (torch.float32, torch.float64, torch.int64):
        for shape in SHAPES:
            ours = numbers(rank, dtype, shape)
            gathered = gather_from_processes(ours)
            theirs = [torch.empty_like(ours) for _ in range(distributed.get_world_size())]
            distributed.all_gather(theirs, ours)
            found[dtype, shape] = torch.equal(gathered, torch.stack(theirs))
            (total,) = sum_over_processes(ours)
            found[dtype, shape, "sum"] = torch.allclose(total, gathered.sum(dim=0).to(dtype))
            found[dtype, shape, "kept"] = torch.equal(ours, numbers(rank, dtype, shape))
    return found


@needs_memory
@pytest.mark.parametrize("processes", [2, 3])
def test_all_that_is_sent_arrives(processes, tmp_path):
    before = set(Path("/dev/shm").iterdir())
    for found in in_processes(of_all, tmp_path, processes=processes):
        assert all(found.values()), [key for key, value in found.items() if not value]
    assert not {path for path in set(Path("/dev/shm").iterdir()) - before if "i2i_" in path.name}


def many_turns(rank):
    """How often something else than this turn's numbers arrived; one process is ever late."""
    wrong = 0
    for turn in range(3000):
        ours = torch.full((1 + turn % 7,), 10.0 * turn + rank)
        if turn % 3 == rank:
            sum(range(2000))  # another one waits
        expected = 10.0 * turn + torch.arange(3.0)[:, None].expand(-1, len(ours))
        wrong += not torch.equal(gather_from_processes(ours), expected)
        (total,) = sum_over_processes(ours)
        wrong += not torch.equal(total, expected.sum(dim=0))
    return wrong


@needs_memory
def test_turns_are_not_mixed_up(tmp_path):
    assert in_processes(many_turns, tmp_path, processes=3) == [0, 0, 0]


def declined(rank, by):
    if by == "first" or rank == 1:
        name = "_offered" if by == "first" else "_mapped"
        setattr(exchange, name, lambda *_: None)
    (total,) = sum_over_processes(torch.full((3,), 1.0 + rank))
    return has_shared_memory(), total, gather_from_processes(torch.tensor([rank]))


@pytest.mark.parametrize("by", ["first", "second"])
def test_where_one_declines_all_take_gloo(by, tmp_path):
    for is_shared, total, gathered in in_processes(declined, tmp_path, by):
        assert not is_shared
        assert torch.equal(total, torch.full((3,), 3.0))
        assert gathered.tolist() == [[0], [1]]


def ends(rank, folder):
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2
    )
    sum_over_processes(torch.zeros(1))
    if rank == 1:
        os._exit(0)
    exchange._PATIENCE_SECONDS = 0.05
    try:
        sum_over_processes(torch.zeros(1))
    except RuntimeError as error:
        Path(folder, "told").write_text(str(error))
    os._exit(0)


@needs_memory
def test_a_process_that_ends_is_not_waited_for(tmp_path):
    context = multiprocessing.get_context("spawn")
    children = [context.Process(target=ends, args=(rank, str(tmp_path))) for rank in range(2)]
    for child in children:
        child.start()
    for child in children:
        child.join()
    assert "process 1 of 2" in (tmp_path / "told").read_text()


class _Net(nn.Module):
    def __init__(self, norm):
        super().__init__()
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Linear(5, 4), norm, nn.ReLU(), nn.Linear(4, 1)).double()

    def forward(self, x):
        return self.layers(x).square().mean()


def batch():
    return torch.randn(12, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def gradients_of(model):
    return [p.grad.clone() for p in model.parameters()]


def data_parallel(rank):
    found = {}
    for name in ("shared", "plain", "without gradients"):
        model = DistributedDataParallel(_Net(JointBatchNorm1d(4)))
        if name != "plain":
            share_batch(model, gradients=name == "shared")
        found[name, "broadcast"] = model.broadcast_buffers
        for _ in range(2):  # the buckets are put together anew after the first pass
            model.zero_grad()
            model(batch().chunk(2)[rank]).backward()
        found[name] = gradients_of(model)
        found[name, "hook"] = bool(model._comm_hooks)
    own = DistributedDataParallel(_Net(nn.BatchNorm1d(4)))
    share_batch(own)
    return {**found, "own": own.broadcast_buffers}


@needs_memory
def test_gradients_are_those_of_the_joint_batch(tmp_path):
    net = _Net(JointBatchNorm1d(4))
    net(batch()).backward()
    for found in in_processes(data_parallel, tmp_path):
        for name in ("shared", "plain", "without gradients"):
            torch.testing.assert_close(found[name], gradients_of(net), atol=1e-14, rtol=1e-12)
        assert [found[name, "hook"] for name in ("shared", "without gradients")] == [True, False]
        # Only statistics that every process takes for itself have to be sent.
        assert found["plain", "broadcast"]
        assert found["own"]
        assert not found["shared", "broadcast"]
