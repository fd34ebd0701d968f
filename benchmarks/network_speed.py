"""The network against the same function made the usual way: steps, inference, head, building.

python benchmarks/network_speed.py                       # all, scale=paper, ten minutes
python benchmarks/network_speed.py --parts head build    # some
python benchmarks/network_speed.py --scale small --repeats 9
python benchmarks/network_speed.py --device cuda --repeats 20

The peers are escnn's dense layers with correct residual blocks and the direct head (`published`),
and the encoder's widths in plain torch.nn with our head (`plain`). `ours by torch` leaves the
compiled code aside (`i2i.nn.native`). Variants run alternately in one
process; what counts are the ratios. Before anything is timed the published peer has to give the
same answers. Writes `benchmarks/results/<name>.json`, `.md` and `.png`; an earlier JSON of the same
name is what the new ratios are shown beside, and keeps the parts that are not measured again.
"""

import argparse
import json
import platform
import resource
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from alternation import Timing, alternate
from i2i.configuration import compose
from i2i.data.noise import noise_batch
from i2i.memory import reuse_memory
from i2i.nn import native
from i2i.nn.folding import fold
from i2i.runs.building import build_network, info_of
from peers import DirectHead, PlainResNet18, escnn_encoder, published

RESULTS = Path(__file__).parent / "results"
PARTS = ("step", "inference", "head", "build")
PEER = "published, fp32"
BY_TORCH = "ours by torch"
Timings = dict[str, Timing]


def network(scale: str, task: str = "pose", classes: int = 1) -> tuple[nn.Module, Any]:
    """I2I with the stem and the basis that escnn has, the weights always the same."""
    config = compose(
        ["model=i2i", f"task={task}", f"scale={scale}", "data=synthetic",
         "model.encoder.stem_mode=ref", "model.encoder.basis=band_limited"]
    )  # fmt: skip
    info = info_of(config, tuple(f"class{i}" for i in range(classes)))
    torch.manual_seed(0)
    return build_network(config, info), info


def with_plain_encoder(ours: nn.Module) -> nn.Module:
    """`ours` with the plain encoder, in its place."""
    ours.trunk.encoder = PlainResNet18(ours.trunk.encoder)
    return ours


def autocast(device: str, enabled: bool) -> torch.autocast:
    """bf16 products, or none."""
    return torch.autocast(device, torch.bfloat16, enabled=enabled)


def alternate_on(device: str, variants: dict[str, Callable[[], None]], **given: int) -> Timings:
    """`alternate`, with a GPU's work waited for."""
    finish = torch.cuda.synchronize if device == "cuda" else lambda: None
    return alternate(variants, finish=finish, **given)


def check_peer(ours: nn.Module, peer: nn.Module, batch: dict[str, Tensor]) -> None:
    """Both have to be the same function; 40 images, which take the spectral form."""
    ours.eval(), peer.eval()
    some = {name: value[:40] for name, value in batch.items()}
    with torch.no_grad():
        torch.testing.assert_close(ours(some).logits, peer(some).logits, rtol=1e-3, atol=1e-3)


def contestants(
    scale: str, device: str, batch_size: int
) -> tuple[dict[str, nn.Module], dict[str, Tensor]]:
    """The networks by name, and a batch for them."""
    ours, info = network(scale)
    batch = noise_batch(info, batch_size)
    peer = published(network(scale)[0])
    check_peer(ours, peer, batch)
    plain = with_plain_encoder(network(scale)[0])
    nets = {"published": peer, "plain": plain, "ours": ours}
    if device == "cpu" and native.library() is not None:
        nets[BY_TORCH] = nets["ours"]
    batch = {name: value.to(device) for name, value in batch.items()}
    return {name: net.to(device) for name, net in nets.items()}, batch


def form(name: str) -> AbstractContextManager[None]:
    """What a variant runs under."""
    return native.torch_only() if name == BY_TORCH else nullcontext()


def training_steps(scale: str, device: str, repeats: int, batch_size: int) -> Timings:
    """Forward, backward and SGD with momentum."""
    nets, batch = contestants(scale, device, batch_size)
    variants: dict[str, Callable[[], None]] = {}
    for name, net in nets.items():
        net.train()
        optimizer = torch.optim.SGD(net.parameters(), lr=1e-3, momentum=0.9, nesterov=True)
        for low in (False, True):

            def step(
                name: str = name,
                net: nn.Module = net,
                optimizer: torch.optim.Optimizer = optimizer,
                low: bool = low,
            ) -> None:
                with form(name):
                    with autocast(device, low):
                        loss = torch.stack(list(net.loss(net(batch), batch).values())).sum()
                    optimizer.zero_grad()
                    loss.backward()
                    optimizer.step()

            variants[f"{name}, {'bf16' if low else 'fp32'}"] = step
    return alternate_on(device, variants, repeats=repeats, warm_up=2)


def inference(scale: str, device: str, repeats: int, batch_size: int) -> Timings:
    """Forward in evaluation mode without gradients."""
    nets, batch = contestants(scale, device, batch_size)
    nets["ours folded"] = fold(nets["ours"])
    variants: dict[str, Callable[[], None]] = {}
    for name, net in nets.items():
        net.eval()
        for low in (False, True):

            def run(name: str = name, net: nn.Module = net, low: bool = low) -> None:
                with form(name), torch.no_grad(), autocast(device, low):
                    net(batch)

            variants[f"{name}, {'bf16' if low else 'fp32'}"] = run
    return alternate_on(device, variants, repeats=repeats, warm_up=2)


def heads(task: str, classes: int, device: str, repeats: int, batch_size: int) -> Timings:
    """Projector and group convolution at `scale=paper`, forward and backward."""
    net, _ = network("paper", task, classes)
    trunk = net.trunk.to(device)
    direct = DirectHead(trunk.projector, trunk.group_conv).to(device)
    maps = torch.rand(batch_size, 304, 8, 8, device=device, requires_grad=True)

    def ours(x: Tensor) -> Tensor:
        return trunk.group_conv(trunk.projector(x), None)

    torch.testing.assert_close(direct(maps[:2]), ours(maps[:2]), rtol=1e-4, atol=1e-4)

    def run(head: Callable[[Tensor], Tensor]) -> None:
        head(maps).square().sum().backward()

    variants = {PEER: lambda: run(direct), "ours, fp32": lambda: run(ours)}
    return alternate_on(device, variants, repeats=repeats)


def building(scale: str) -> Timings:
    """Making the network once; escnn's own initialisation is what the published one waits for."""
    start = time.perf_counter()
    ours, _ = network(scale)
    middle = time.perf_counter()
    escnn_encoder(ours.trunk.encoder, initialize=True)
    end = time.perf_counter()
    return {
        PEER: Timing(end - middle, end - middle, end - middle),
        "ours, fp32": Timing(middle - start, middle - start, middle - start),
    }


def processor() -> str:
    """Its name where the system tells it, else its kind."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.machine()


def measure(options: argparse.Namespace) -> dict[str, Timings]:
    """All parts that were asked for, by title."""
    scale, device, repeats, size = options.scale, options.device, options.repeats, options.batch
    found: dict[str, Timings] = {}
    if "step" in options.parts:
        found[f"training step, batch {size}"] = training_steps(scale, device, repeats, size)
    if "inference" in options.parts:
        for batch in (size, 8, 1):
            more = repeats if batch > 8 else 4 * repeats
            found[f"inference, batch {batch}"] = inference(scale, device, more, batch)
    if "head" in options.parts:
        for task, classes, what in (("pose", 1, "7 outputs"), ("classification", 40, "40 classes")):
            found[f"head forward+backward, {what}"] = heads(task, classes, device, repeats, size)
    if "build" in options.parts:
        found["building"] = building(scale)
    return found


def stored(part: dict[str, Any]) -> Timings:
    """Timings of an earlier run, from its JSON."""
    timings = {}
    for name, entry in part.items():
        low, high = entry["quartiles"]
        timings[name] = Timing(entry["ms"] / 1e3, low / 1e3, high / 1e3)
    return timings


def table(found: dict[str, Timings], before: dict[str, Any], *, fresh: set[str]) -> str:
    """Markdown: milliseconds with quartiles, and how many times faster than the published peer.

    The last column has the ratio of an earlier run, for the parts that were measured again.
    """
    lines = ["| | variant | ms [quartiles] | ratio | before |", "|---|---|--:|--:|--:|"]
    for title, timings in found.items():
        for name, timing in timings.items():
            ratio = timings[PEER].median / timing.median
            old = before.get(title, {}).get(name, {}).get("ratio") if title in fresh else None
            earlier = f"{old:.2f}" if old else ""
            lines.append(f"| {title} | {name} | {timing} | {ratio:.2f} | {earlier} |")
    return "\n".join(lines)


def plot(found: dict[str, Timings], path: Path) -> None:
    """Bars of the ratios."""
    from i2i.viz.style import (  # matplotlib only where it is needed
        new_figure,
        plain_axes,
        save_figure,
    )

    rows = [
        (f"{title}: {name}", timings[PEER].median / timing.median)
        for title, timings in found.items()
        for name, timing in timings.items()
        if name.startswith("ours")
    ][::-1]
    figure = new_figure(7.0, 0.9 + 0.3 * len(rows))
    axes = figure.add_subplot()
    plain_axes(axes)
    axes.barh(range(len(rows)), [ratio for _, ratio in rows])
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    for place, (_, ratio) in enumerate(rows):
        axes.annotate(
            f"{ratio:.1f}×", (ratio, place), xytext=(3, 0), textcoords="offset points", va="center"
        )
    axes.set_xscale("log")
    axes.margins(x=0.12)
    axes.set_xlabel(f"times as fast as “{PEER}”")
    save_figure(figure, path)


def main() -> None:
    """Measure, print, and write the three files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--scale", default="paper")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--name", help="of the files; network_speed_<scale>, on a GPU with _cuda")
    options = parser.parse_args()
    reuse_memory()
    torch.set_num_threads(options.threads)
    ending = "" if options.device == "cpu" else f"_{options.device}"
    name = options.name or f"network_speed_{options.scale}{ending}"
    file = RESULTS / f"{name}.json"
    machine = {
        "processor": processor(),
        "torch": torch.__version__,
        "threads": options.threads,
        "capability": torch.backends.cpu.get_cpu_capability(),
    }
    if options.device == "cuda":
        machine["gpu"] = torch.cuda.get_device_name()
    old = json.loads(file.read_text()) if file.is_file() else {"machine": machine, "parts": {}}
    if old["machine"] != machine:
        print(f"the earlier results are of another machine and are replaced: {old['machine']}")
    before = old["parts"] if old["machine"] == machine else {}
    found = measure(options)
    everything = {**{title: stored(part) for title, part in before.items()}, **found}
    text = table(everything, before, fresh=set(found))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{text}\n\n{options.threads} threads, scale={options.scale}, {options.device}")
    print(f"peak resident memory of all together {peak:.1f} GiB")
    parts = {
        title: {
            name: {
                "ms": timing.median * 1e3,
                "quartiles": [timing.low * 1e3, timing.high * 1e3],
                "ratio": timings[PEER].median / timing.median,
            }
            for name, timing in timings.items()
        }
        for title, timings in everything.items()
    }
    RESULTS.mkdir(exist_ok=True)
    file.write_text(json.dumps({"machine": machine, "parts": parts}, indent=1) + "\n")
    file.with_suffix(".md").write_text(text + "\n")
    plot(everything, file.with_suffix(".png"))


if __name__ == "__main__":
    main()
