"""Images per second that one process cuts from a rendered store, and its private memory.

Usage: ``python benchmarks/loader_rate.py [--size 128] [--images 4000]``. The store holds noise and
is made in a temporary folder. Prints the rate without and with augmentation (target: 5,000 a
second for gray images of 128 px) and how much private memory grows when the store grows tenfold
(target: nothing; the pages of the memory map belong to the system's cache).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import BatchSampler, DataLoader

from i2i.data.augment import Augmentation, scaled_shift
from i2i.data.dataset import Batch, ImageBlock, RenderedDataset, collate
from i2i.data.sampler import EpochSampler


def make_dataset(
    folder: Path, *, num_images: int, size: int, augmentation: Augmentation
) -> RenderedDataset:
    """Data set over a new store of noise."""
    path = folder / f"images_{num_images}.npy"
    if not path.exists():
        rng = np.random.default_rng(0)
        shape = (num_images, 1, size, size)
        images = np.lib.format.open_memmap(path, "w+", np.uint8, shape)
        for start in range(0, num_images, 1000):
            part = images[start : start + 1000]
            part[:] = rng.integers(0, 256, part.shape, dtype=np.uint8)
    numbers = np.arange(num_images)
    rotation = np.zeros((num_images, 3, 3), np.float32)
    return RenderedDataset(
        [ImageBlock(path, numbers, rotation, numbers, numbers, numbers, numbers)],
        augmentation=augmentation,
    )


def make_loader(dataset: RenderedDataset, batch_size: int) -> DataLoader[Batch]:
    """The training loader of the data modules, in this process."""
    sampler = EpochSampler(len(dataset), seed=0, batch_size=batch_size)
    batches = BatchSampler(sampler, batch_size, drop_last=True)
    return DataLoader(dataset, batch_sampler=batches, collate_fn=collate)


def images_per_second(loader: DataLoader[Batch]) -> float:
    """Rate over one epoch."""
    start = time.perf_counter()
    count = sum(len(batch["image"]) for batch in loader)
    return count / (time.perf_counter() - start)


def private_mib() -> float:
    """Private memory of this process (RssAnon), in MiB."""
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1024


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--images", type=int, default=4000)
    parser.add_argument("--batch", type=int, default=64)
    options = parser.parse_args()
    torch.set_num_threads(1)
    shifts = {
        "no augmentation": Augmentation(),
        "pixel shift": Augmentation(shift_px=scaled_shift(3, options.size)),
        "pixel and depth shift": Augmentation(scaled_shift(3, options.size), depth_shift=5),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sizes = {"size": options.size}
        for label, augmentation in shifts.items():
            dataset = make_dataset(
                folder, num_images=options.images, augmentation=augmentation, **sizes
            )
            loader = make_loader(dataset, options.batch)
            images_per_second(loader)  # fills the system's cache
            rate = statistics.median(images_per_second(loader) for _ in range(5))
            print(f"{label:22s} {rate:9.0f} images/s")
        for factor in (1, 10):
            dataset = make_dataset(
                folder,
                num_images=options.images * factor,
                augmentation=shifts["pixel shift"],
                **sizes,
            )
            images_per_second(make_loader(dataset, options.batch))
            store = options.images * factor * options.size**2 / 2**20
            print(f"store of {store:7.0f} MiB: RssAnon {private_mib():7.1f} MiB")


if __name__ == "__main__":
    main()
