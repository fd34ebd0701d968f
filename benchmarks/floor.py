"""How far a training step is from the least that its multiplications could take.

python benchmarks/floor.py                    # scale=paper, batch 64, two threads, two minutes

The floor is the number of multiplications of the best way that is known for each layer, divided by
the highest rate that this machine reaches in any large product or convolution, measured here. The
best ways: 3×3 convolutions of stride 1 at 20.25 instead of 144 multiplications per pixel and pair
of fields (docs/c4_spectral.md), 1×1 ones by parts of the group (6 of 16), all others dense; the
head as it is, without its sampling. A step is a forward and two products of the same size backward;
the first layer has one. Transforms, batch norms, sums and copies count as nothing: a floor, not a
forecast.
"""

import argparse
import time
from collections.abc import Callable

import torch
from torch import nn

from i2i.data.noise import noise_batch
from i2i.memory import reuse_memory
from i2i.nn.c4 import C4Conv
from i2i.nn.c4_dispatch import convolution_mode
from network_speed import autocast, network

_SPECTRAL = 20.25 / 144
_POINTWISE = 6 / 16  # sums, differences, and one complex part


def multiplications(net: nn.Module, batch: dict[str, torch.Tensor]) -> dict[str, tuple[float, int]]:
    """By layer: multiplications of a forward in the best way, and how many such make a step."""
    found: dict[str, tuple[float, int]] = {}
    hooks = []

    def of_conv(name: str, first: bool) -> Callable[..., None]:
        def count(layer: C4Conv, _: object, out: torch.Tensor) -> None:
            dense = out.numel() * layer.in_type.size * layer.kernel_size**2
            best = 1.0
            if layer.stride == 1 and layer.kernel_size == 3 and not first:
                best = _SPECTRAL
            elif layer.kernel_size == 1:
                best = _POINTWISE
            found[name] = (dense * best, 2 if first else 3)

        return count

    def of_linear(name: str) -> Callable[..., None]:
        def count(layer: nn.Linear, _: object, out: torch.Tensor) -> None:
            found[name] = (float(out.numel() * layer.in_features), 3)

        return count

    for name, layer in net.named_modules():
        if isinstance(layer, C4Conv):
            hooks.append(layer.register_forward_hook(of_conv(name, name.endswith("stem"))))
        elif isinstance(layer, nn.Linear):
            hooks.append(layer.register_forward_hook(of_linear(name)))
    with torch.no_grad(), convolution_mode("dense"):
        net(batch)
    for hook in hooks:
        hook.remove()
    head = net.trunk.group_conv
    size = len(next(iter(batch.values())))
    met = int(head.pairs.any(dim=1).sum())  # pairs of places that some element puts together
    found["trunk.group_conv"] = (float(size * met * head.features * head.out_features), 3)
    return found


def seconds_of(run: Callable[[], object], repeats: int) -> float:
    """The shortest of a few runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times[1:] or times)


def peak(dtype: torch.dtype) -> float:
    """The most multiplications a second, in large products and convolutions."""
    rates = []
    for size in (1024, 2048, 4096):
        a, b = torch.rand(size, size, dtype=dtype), torch.rand(size, size, dtype=dtype)
        rates.append(size**3 / seconds_of(lambda a=a, b=b: a @ b, 6))  # type: ignore[misc]
    for channels, side in ((304, 16), (608, 8), (1216, 8)):
        x, conv = (
            torch.rand(64, channels, side, side, dtype=dtype),
            nn.Conv2d(channels, channels, 3, padding=1, bias=False, dtype=dtype),
        )
        count = x.numel() * channels * 9
        with torch.no_grad():
            rates.append(count / seconds_of(lambda x=x, conv=conv: conv(x), 5))  # type: ignore[misc]
    return max(rates)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="paper")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    reuse_memory()
    torch.set_num_threads(options.threads)
    net, info = network(options.scale)
    batch = noise_batch(info, options.batch)
    counts = multiplications(net.train(), batch)
    forward = sum(count for count, _ in counts.values())
    step = sum(count * times for count, times in counts.values())
    print(f"{forward / 1e9:.0f} G multiplications forward, {step / 1e9:.0f} G a step; the most in")
    for name, (count, times) in sorted(counts.items(), key=lambda item: -item[1][0])[:6]:
        print(f"  {count * times / step:6.1%} {name}")
    optimizer = torch.optim.SGD(net.parameters(), lr=1e-6, momentum=0.9)
    for low in (False, True):

        def train(low: bool = low) -> None:
            with autocast("cpu", low):
                loss = torch.stack(list(net.loss(net(batch), batch).values())).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

        measured = seconds_of(train, options.repeats)
        rate = peak(torch.bfloat16 if low else torch.float32)
        floor = step / rate
        name = "bf16" if low else "fp32"
        print(
            f"{name}: {2 * rate / 1e9:.0f} GFLOP/s at most, floor {floor:.2f} s, "
            f"a step {measured:.2f} s, {floor / measured:.0%} of the floor's speed"
        )


if __name__ == "__main__":
    main()
