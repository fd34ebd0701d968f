"""What `DistributedDataParallel` need not do where processes of one machine share a batch."""

import torch
from torch import Tensor, distributed
from torch.nn.parallel import DistributedDataParallel

from i2i.nn.batch_norm import statistics_are_joint
from i2i.nn.processes import has_shared_memory, num_processes, sum_in_place


def share_batch(model: DistributedDataParallel) -> None:
    """Add up gradients in shared memory, and send no statistics that are everywhere the same.

    All processes have to call it together, before the first backward pass. A model whose gradients
    have another way already (a communication hook of the user's) keeps it.
    """
    is_local = all(p.device.type == "cpu" for p in model.parameters())
    is_of_all = model.process_group is distributed.group.WORLD
    if is_local and is_of_all and not model._comm_hooks and has_shared_memory():
        model.register_comm_hook(None, _mean_of_bucket)
    model.broadcast_buffers = model.broadcast_buffers and not statistics_are_joint(model)


# Torch takes no other annotation of a bucket than its own type, which not every build has.
def _mean_of_bucket(_: None, bucket) -> torch.futures.Future[Tensor]:  # type: ignore[no-untyped-def]  # noqa: ANN001
    gradients = bucket.buffer()
    sum_in_place(gradients)
    future: torch.futures.Future[Tensor] = torch.futures.Future()
    future.set_result(gradients.div_(num_processes()))
    return future
