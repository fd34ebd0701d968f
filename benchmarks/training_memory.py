"""Peak resident memory of training, in a fresh process, and the time of a step.

python benchmarks/training_memory.py                  # scale=paper, batch 64, fp32
python benchmarks/training_memory.py scale=small trainer.precision=bf16-mixed
"""

import resource
import sys
import time

import torch

from i2i.configuration import compose
from i2i.data.info import DataInfo
from i2i.geometry.rotations import random_rotations
from i2i.runs.building import build_network

STEPS = 4


def main() -> None:
    config = compose(["scale=paper", *sys.argv[1:]])
    size, batch = config.data.image_size, config.data.batch_size
    info = DataInfo(("object",), ("none",), channels=1, image_size=size, modality="gray")
    network = build_network(config, info)
    optimizer = torch.optim.SGD(network.parameters(), 1e-3, momentum=0.9, nesterov=True)
    images = {
        "image": torch.rand(batch, 1, size, size),
        "rotation": random_rotations(batch).float(),
        "class_id": torch.zeros(batch, dtype=torch.int64),
    }
    seconds = []
    for _ in range(STEPS):
        start = time.perf_counter()
        low = "bf16" in str(config.trainer.precision)
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            loss = sum(network.loss(network(images), images).values())
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    parameters = sum(p.numel() for p in network.parameters())
    print(f"scale {config.scale.name}, {size} px, batch {batch}, {parameters:,} parameters")
    print(f"peak resident memory {peak:.2f} GiB")
    print(f"step {sorted(seconds)[STEPS // 2]:.2f} s with {torch.get_num_threads()} threads")


if __name__ == "__main__":
    main()
