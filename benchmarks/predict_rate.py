"""Pictures a second of `predict` on a folder, against the network alone on what it reads.

python benchmarks/predict_rate.py                    # scale=paper, a minute or two
python benchmarks/predict_rate.py --scale small

The network is untrained: how fast it is does not depend on its weights. The pictures are PNG files
of the network's size and, of `--large` pixels, such as have to be scaled down.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from alternation import alternate
from i2i.memory import reuse_memory
from i2i.network_input import see
from i2i.predictor import Predictor
from network_speed import network


def pictures(folder: Path, count: int, size: int) -> list[Path]:
    """A gray ball with a stripe on white, each of its own size and place."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:size, :size] / size
    paths = []
    for number in range(count):
        x, y = rng.uniform(0.4, 0.6, size=2)
        inside = np.hypot(column - x, row - y) < rng.uniform(0.15, 0.3)
        stripe = np.abs(column - x + 0.5 * (row - y)) < 0.05
        shade = np.where(stripe, 60, 150).astype(np.uint8)
        paths.append(folder / f"{number:04d}.png")
        Image.fromarray(np.where(inside, shade, 255).astype(np.uint8)).save(paths[-1])
    return paths


def batches(predictor: Predictor, paths: list[Path], size: int) -> Iterator[dict[str, Tensor]]:
    """What the network sees of the pictures, read beforehand."""
    seen = [see(path, predictor.info) for path in paths]
    for start in range(0, len(seen), size):
        some = seen[start : start + size]
        batch = {name: torch.cat([one.batch[name] for one in some]) for name in some[0].batch}
        batch["class_id"] = torch.zeros(len(some), dtype=torch.long)
        yield batch


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="paper")
    parser.add_argument("--count", type=int, default=192)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--large", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    reuse_memory()
    torch.set_num_threads(2)
    net, info = network(options.scale)
    predictor = Predictor(net, info)
    print(f"scale={options.scale}, {options.count} pictures, {options.batch} at once, 2 threads")
    for size in (info.image_size, options.large):
        with tempfile.TemporaryDirectory() as folder:
            paths = pictures(Path(folder), options.count, size)
            read = list(batches(predictor, paths, options.batch))

            def alone(read: list[dict[str, Tensor]] = read) -> None:
                with torch.inference_mode():
                    for batch in read:
                        net(batch)

            def stream(paths: list[Path] = paths) -> None:
                for _ in predictor.predict_many(paths, batch_size=options.batch):
                    pass

            times = alternate({"network": alone, "predict": stream}, repeats=options.repeats)
        rate = {name: options.count / timing.median for name, timing in times.items()}
        print(
            f"pictures of {size:4d} px: the network alone {rate['network']:.1f} a second, predict "
            f"{rate['predict']:.1f}: {rate['predict'] / rate['network']:.2f} of it"
        )


if __name__ == "__main__":
    main()
