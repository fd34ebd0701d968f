"""What a task spares processes that share a batch."""

from types import SimpleNamespace

import torch
from torch import distributed, nn
from torch.distributed.algorithms.ddp_comm_hooks.default_hooks import allreduce_hook
from torch.nn.parallel import DistributedDataParallel

from i2i.nn.batch_norm import JointBatchNorm1d
from i2i.nn.processes import has_shared_memory
from i2i.tasks.base import Task


def _begin(model):
    task = Task(nn.Identity(), optimizer=None, scheduler=None, scheduler_interval="step", info=None)
    task.trainer = SimpleNamespace(strategy=SimpleNamespace(model=model))
    task.on_train_start()


def test_gradients_go_through_shared_memory_unless_the_user_has_another_way(tmp_path):
    distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path}/meeting", rank=0, world_size=1
    )
    try:
        ours, users = (
            DistributedDataParallel(nn.Sequential(nn.Linear(3, 2), JointBatchNorm1d(2)))
            for _ in range(2)
        )
        users.register_comm_hook(None, allreduce_hook)
        _begin(ours)
        _begin(users)
        assert len(ours._comm_hooks) == has_shared_memory()
        assert [hook for hook, _ in users._comm_hooks] == [allreduce_hook]
        assert not ours.broadcast_buffers
        ours(torch.randn(4, 3)).square().sum().backward()
        assert all(p.grad is not None for p in ours.parameters())
    finally:
        distributed.destroy_process_group()


def test_one_process_is_left_alone():
    model = nn.Linear(3, 2)
    before = dict(vars(model))
    _begin(model)
    assert vars(model) == before
