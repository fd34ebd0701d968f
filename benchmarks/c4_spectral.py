"""Dense against spectral C4 convolution, alternated in one process.

Times forward and forward + backward (gradients of the maps and of the filters, filter transform
included) of ``torch.nn.functional.conv2d`` with the expanded kernel and of
:func:`i2i.nn.c4_spectral.spectral_conv_pixel_major`, each on maps in its own layout, and prints
medians, minima and ratios. The dense side starts from the ready expanded kernel, so the cost of
expanding it is not counted against it.

Example:
    python benchmarks/c4_spectral.py --threads 2 --repeats 15
    python benchmarks/c4_spectral.py --bf16 --fields 64x64 --batch 1 4 16 64
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import time
from collections.abc import Callable

import torch
import torch.nn.functional as functional
from torch import Tensor

from i2i.memory import reuse_memory
from i2i.nn.c4_spectral import spectral_conv_pixel_major, transform_matrix
from i2i.nn.pixel_major import to_pixel_major


def expand(base: Tensor) -> Tensor:
    """Expand base filters (C_out, C_in * 4, k, k) to the kernel (C_out * 4, C_in * 4, k, k)."""
    out_fields, channels, size, _ = base.shape
    filters = base.view(out_fields, channels // 4, 4, size, size)
    rows = [torch.rot90(filters.roll(h, dims=2), h, (-2, -1)) for h in range(4)]
    return torch.stack(rows, dim=1).reshape(out_fields * 4, channels, size, size)


def alternate(variants: list[Callable[[], object]], repeats: int) -> list[list[float]]:
    """Run the variants in turn; seconds per run, one list per variant, first two rounds unused."""
    seconds: list[list[float]] = [[] for _ in variants]
    for turn in range(repeats + 2):
        for variant, times in zip(variants, seconds, strict=True):
            start = time.perf_counter()
            variant()
            if turn >= 2:
                times.append(time.perf_counter() - start)
    return seconds


def measure(
    fields: tuple[int, int], *, map_size: int, batch: int, bf16: bool, backward: bool, repeats: int
) -> list[list[float]]:
    """Time dense and spectral for one layer: two lists of seconds."""
    base = torch.randn(fields[1], fields[0] * 4, 3, 3, requires_grad=backward)
    kernel = expand(base.detach()).requires_grad_(backward)
    x = torch.randn(batch, fields[0] * 4, map_size, map_size, requires_grad=backward)
    maps = to_pixel_major(x.detach()).requires_grad_(backward)
    matrix = transform_matrix(map_size, 3, dtype=base.dtype)

    def spectral(x: Tensor, weight: Tensor) -> Tensor:
        coefficients = weight.reshape(fields[1], fields[0], -1)
        return spectral_conv_pixel_major(x, coefficients, matrix, kernel_size=3)

    def run(convolve: Callable[[Tensor, Tensor], Tensor], x: Tensor, weight: Tensor) -> None:
        with torch.autocast("cpu", torch.bfloat16) if bf16 else contextlib.nullcontext():
            y = convolve(x, weight)
        if backward:
            torch.autograd.grad(y, (x, weight), torch.ones_like(y))

    return alternate(
        [
            lambda: run(lambda a, w: functional.conv2d(a, w, padding=1), x, kernel),
            lambda: run(spectral, maps, base),
        ],
        repeats,
    )


def main() -> None:
    """Parse the command line and print one line per layer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    layers = ["16x16", "16x32", "32x32", "32x64", "64x64"]
    parser.add_argument("--fields", nargs="+", default=layers, help="C_in x C_out")
    parser.add_argument("--map-size", type=int, default=8)
    parser.add_argument("--batch", type=int, nargs="+", default=[64])
    parser.add_argument("--bf16", action="store_true", help="under torch.autocast")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    reuse_memory()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    print(
        f"{'layer':>8} {'batch':>5} {'pass':>8} {'dense ms':>14} {'spectral ms':>14}  ratio (min)"
    )
    for name in options.fields:
        c_in, c_out = (int(part) for part in name.split("x"))
        for batch in options.batch:
            for backward in (False, True):
                dense, spectral = measure(
                    (c_in, c_out),
                    map_size=options.map_size,
                    batch=batch,
                    bf16=options.bf16,
                    backward=backward,
                    repeats=options.repeats,
                )
                medians = [statistics.median(times) * 1e3 for times in (dense, spectral)]
                minima = [min(times) * 1e3 for times in (dense, spectral)]
                print(
                    f"{name:>8} {batch:>5} {'fwd+bwd' if backward else 'forward':>8} "
                    f"{medians[0]:6.1f} ({minima[0]:5.1f}) {medians[1]:6.1f} ({minima[1]:5.1f})  "
                    f"{medians[0] / medians[1]:4.2f} ({minima[0] / minima[1]:4.2f})"
                )


if __name__ == "__main__":
    main()
