"""What processes tell each other through memory that they share, against gloo and closed forms."""

import gc
import multiprocessing
import os
import weakref
from pathlib import Path

import pytest
import torch
from joint_processes import in_processes
from torch import distributed, nn
from torch.distributed.algorithms.ddp_comm_hooks.default_hooks import allreduce_hook
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
    offered, offer = [], exchange._offered
    exchange._offered = lambda: offered.append(offer()) or offered[-1]
    assert has_shared_memory()
    assert len(offered) == (rank == 0)
    found = {"nothing stays": not any(path.exists() for path in offered)}
    for dtype in (torch.float32, torch.float64, torch.int64):
        for shape in SHAPES:
            ours = numbers(rank, dtype, shape)
            gathered = gather_from_processes(ours)
            theirs = [torch.empty_like(ours) for _ in range(distributed.get_world_size())]
            distributed.all_gather(theirs, ours)
            found[dtype, shape] = torch.equal(gathered, torch.stack(theirs))
            turned = gather_from_processes(ours.T)
            found[dtype, shape, "turned"] = torch.equal(
                turned, torch.stack([part.T for part in theirs])
            )
            (total,) = sum_over_processes(ours)
            # In the order of the ranks, so that no process has another last digit.
            found[dtype, shape, "sum"] = torch.equal(total, sum(theirs[1:], start=theirs[0]))
            of_gloo = ours.clone()
            distributed.all_reduce(of_gloo)
            relative = 0 if dtype == torch.int64 else 4 * torch.finfo(dtype).eps
            largest = torch.stack(theirs).abs().amax(dim=0)  # what a sum is rounded by
            near = ((total - of_gloo).abs() <= relative * largest).all()
            found[dtype, shape, "gloo's sum"] = bool(near)
            found[dtype, shape, "kept"] = torch.equal(ours, numbers(rank, dtype, shape))
    some, others = sum_over_processes(torch.full((2, 3), 1.0 + rank), torch.tensor(0.5))
    processes = distributed.get_world_size()
    found["several at once"] = (
        torch.equal(some, torch.full((2, 3), processes * (processes + 1) / 2))
        and others.shape == ()
        and others == 0.5 * processes
    )
    return found


@needs_memory
@pytest.mark.parametrize("processes", [2, 3])
def test_all_that_is_sent_arrives(processes, tmp_path):
    for found in in_processes(of_all, tmp_path, processes=processes):
        assert all(found.values()), [key for key, value in found.items() if not value]


def many_turns(rank, patience):
    """How often something else than this turn's numbers arrived; one process is ever late."""
    if patience is not None:
        exchange._PATIENCE_SECONDS = patience
    wrong, processes = 0, distributed.get_world_size()
    for turn in range(3000):
        # Once in a while more than two slots take, so that others' parities follow.
        ours = torch.full((550_000 if turn % 500 == 499 else 1 + turn % 7,), 10.0 * turn + rank)
        if turn % processes == rank:
            sum(range(2000))  # another one waits
        every = 10.0 * turn + torch.arange(float(processes))
        gathered = gather_from_processes(ours)
        wrong += not torch.equal(gathered, every[:, None].expand(-1, len(ours)))
        (total,) = sum_over_processes(ours)
        wrong += not (total == every.sum()).all()
    return wrong


@needs_memory
@pytest.mark.parametrize(("processes", "patience"), [(2, None), (3, None), (2, 0.0)])
def test_turns_are_not_mixed_up(processes, patience, tmp_path):
    """Also where every wait is given up at once and begun again: the others are slow, not gone."""
    found = in_processes(many_turns, tmp_path, patience, processes=processes)
    assert found == [0] * processes


def declined(rank, folder, by):
    exchange._FOLDER = Path(folder)
    if by == "first" or (by, rank) == ("second", 1):
        name = "_offered" if by == "first" else "_mapped"
        setattr(exchange, name, lambda *_: None)
    if by == "another namespace":
        exchange._namespace = lambda: f"that of {rank}"
    if by == "no room":

        def no_room(*_):
            raise OSError("no space left on device")

        os.posix_fallocate = no_room
    (total,) = sum_over_processes(torch.full((3,), 1.0 + rank))
    return has_shared_memory(), total, gather_from_processes(torch.tensor([rank]))


@pytest.mark.parametrize("by", ["nobody", "first", "second", "no room", "another namespace"])
def test_where_one_declines_all_take_gloo(by, tmp_path):
    if by == "nobody" and native.library() is None:
        pytest.skip("no compiler was found")
    memory = tmp_path / "memory"
    memory.mkdir()
    for is_shared, total, gathered in in_processes(declined, tmp_path, str(memory), by):
        assert is_shared == (by == "nobody")
        assert torch.equal(total, torch.full((3,), 3.0))
        assert gathered.tolist() == [[0], [1]]
    assert not list(memory.iterdir())


def out_of_step(rank, by):
    """What is said where the second process sends something else."""
    ours = torch.zeros(3 if by == "size" and rank else 2)
    # Two floats are as many bytes as what is gathered of two.
    exchange_ = gather_from_processes if by == "way" and rank else sum_over_processes
    try:
        exchange_(ours)
    except RuntimeError as error:
        return str(error)
    return ""


@needs_memory
@pytest.mark.parametrize("by", ["nothing", "size", "way"])
def test_what_does_not_belong_together_is_not_mixed(by, tmp_path):
    for said in in_processes(out_of_step, tmp_path, by):
        assert ("out of step" in said) == (by != "nothing")


def two_groups(rank, folder):
    """What arrives in the group that there is, and in the next one."""
    found = [gather_from_processes(torch.tensor([rank])).tolist() for _ in range(3)]
    distributed.destroy_process_group()
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/next", rank=1 - rank, world_size=2
    )
    found += [gather_from_processes(torch.tensor([rank])).tolist() for _ in range(2)]
    return found, has_shared_memory()


@needs_memory
def test_a_new_group_has_memory_of_its_own(tmp_path):
    for found, is_shared in in_processes(two_groups, tmp_path, str(tmp_path)):
        assert found == 3 * [[[0], [1]]] + 2 * [[[1], [0]]]
        assert is_shared


def keeps_a_group(rank, folder):
    group = weakref.ref(distributed.group.WORLD)
    sum_over_processes(torch.zeros(1))
    distributed.destroy_process_group()
    gc.collect()
    is_kept = group() is not None
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/next", rank=rank, world_size=2
    )
    return is_kept


def test_no_group_is_kept_beyond_its_end(tmp_path):
    """Its threads would abort the process, now and then, when that exits."""
    assert in_processes(keeps_a_group, tmp_path, str(tmp_path)) == [False, False]


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
    for name in ("shared", "plain", "with a hook"):
        model = DistributedDataParallel(_Net(JointBatchNorm1d(4)))
        if name == "with a hook":
            model.register_comm_hook(None, allreduce_hook)
        if name != "plain":
            share_batch(model)
        found[name, "broadcast"] = model.broadcast_buffers
        for _ in range(2):  # the buckets are put together anew after the first pass
            model.zero_grad()
            model(batch().chunk(2)[rank]).backward()
        found[name] = gradients_of(model)
        found[name, "hooks"] = [hook.__name__ for hook, _ in model._comm_hooks]
    own = DistributedDataParallel(_Net(nn.BatchNorm1d(4)))
    share_batch(own)
    return {**found, "own": own.broadcast_buffers}


@needs_memory
def test_gradients_are_those_of_the_joint_batch(tmp_path):
    net = _Net(JointBatchNorm1d(4))
    net(batch()).backward()
    for found in in_processes(data_parallel, tmp_path):
        for name in ("shared", "plain", "with a hook"):
            torch.testing.assert_close(found[name], gradients_of(net), atol=1e-14, rtol=1e-12)
        assert found["shared", "hooks"] == ["_mean_of_bucket"]
        assert found["plain", "hooks"] == []
        assert found["with a hook", "hooks"] == ["allreduce_hook"]
        # Only statistics that every process takes for itself have to be sent.
        assert found["plain", "broadcast"]
        assert found["own"]
        assert not found["shared", "broadcast"]
        assert not found["with a hook", "broadcast"]
