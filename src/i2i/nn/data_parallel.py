"""What `DistributedDataParallel` need not do where processes of one machine share a batch."""

import torch
from torch import Tensor, distributed
from torch.nn.parallel import DistributedDataParallel

from i2i.nn.batch_norm import statistics_are_joint
from i2i.nn.processes import has_shared_memory, num_processes, sum_in_place


def share_batch(model: DistributedDataParallel, *, gradients: bool = True) -> None:
    """Add up gradients in shared memory, and send no statistics that are everywhere the same.

    All processes have to call it together, before the first forward pass.

    Args:
        model: Each of them has one.
        gradients: Whether gradients may take this way: a model has one communication hook.
    """
    if gradients and has_shared_memory():
        model.register_comm_hook(None, _mean_of_bucket)
    model.broadcast_buffers = model.broadcast_buffers and not statistics_are_joint(model)


def _mean_of_bucket(_: None, bucket: distributed.GradBucket) -> torch.futures.Future[Tensor]:
    gradients = bucket.buffer()
    sum_in_place(gradients)
    future: torch.futures.Future[Tensor] = torch.futures.Future()
    future.set_result(gradients.div_(num_processes()))
    return future
