"""How the cost of rendering and loading grows with the number of views: 1,000 to 100,000.

python benchmarks/scaling.py                         # 128 px, gray, two workers, ten minutes
python benchmarks/scaling.py --views 1000 10000

Made chairs, 50 views of each, in a temporary folder (16 KB a view). Every size is measured in a
fresh process; memory is the peak of what is private (RssAnon), sampled from outside, of the process
that asks and loads and of its largest worker. The mapped store's pages belong to the system's
cache and are not counted. Writes `benchmarks/results/scaling.{json,md,png}`.
"""

import argparse
import json
import multiprocessing
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from i2i.configuration import compose
from i2i.runs.building import build_datamodule

RESULTS = Path(__file__).parent / "results"
VIEWS_OF_ONE = 50


def private_mib(pid: int) -> float:
    """Private memory of a process now, 0 if it is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        return next(
            int(line.split()[1]) / 1024 for line in status.splitlines() if line[:7] == "RssAnon"
        )
    except (OSError, StopIteration):
        return 0.0


def descendants(pid: int) -> list[int]:
    """The processes that a process has started, and those that they have."""
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            words = path.read_text().split()
        except OSError:
            continue  # the thread ended
        for child in map(int, words):
            found += [child, *descendants(child)]
    return found


def peaks_while(run: Callable[[], Any]) -> tuple[Any, float, float]:
    """What `run` returns, and the peaks of this process and of its largest child, MiB."""
    here, stop, peaks = multiprocessing.current_process().pid or 0, threading.Event(), [0.0, 0.0]

    def look() -> None:
        peaks[0] = max(peaks[0], private_mib(here))
        peaks[1] = max([peaks[1], *(private_mib(other) for other in descendants(here))])

    def watch() -> None:
        while not stop.wait(0.05):
            look()

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        result = run()
        look()
        return result, peaks[0], peaks[1]
    finally:
        stop.set()
        watcher.join()


def measure(views: int, image_size: int, workers: int) -> dict[str, float]:
    """Render and load this many views."""
    with tempfile.TemporaryDirectory() as folder:
        config = compose(
            ["data=synthetic", "data.object=chair", "scale=paper", f"data.image_size={image_size}",
             f"data.source.instances_per_class={views // VIEWS_OF_ONE}",
             "data.source.test_instances_per_class=1", f"data.views_per_instance={VIEWS_OF_ONE}",
             "data.test_views_per_instance=1", f"data.render_workers={workers}",
             f"data.store_root={folder}", "data.modality=gray"]
        )  # fmt: skip
        data = build_datamodule(config)
        start = time.perf_counter()
        _, ours, worker = peaks_while(data.prepare_data)
        rendered = time.perf_counter() - start
        data.setup("fit")

        def load() -> int:
            return sum(len(batch["image"]) for batch in data.train_dataloader())

        load()  # fills the system's cache
        start = time.perf_counter()
        count, loading, _ = peaks_while(load)
        loaded = time.perf_counter() - start
    return {
        "views": views,
        "render_s": rendered,
        "render_mib": ours,
        "worker_mib": worker,
        "load_s": loaded * views / count,
        "load_mib": loading,
    }


def in_fresh_process(views: int, options: argparse.Namespace) -> dict[str, float]:
    """`measure` where nothing was done before."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(measure, views, options.image_size, options.workers).result()


def table(rows: list[dict[str, float]]) -> str:
    """Markdown."""
    lines = [
        "| views | rendering, s | views/s | MiB | a worker, MiB | loading, s | images/s | MiB |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        views = row["views"]
        lines.append(
            f"| {views:,.0f} | {row['render_s']:.1f} | {views / row['render_s']:.0f} "
            f"| {row['render_mib']:.0f} | {row['worker_mib']:.0f} | {row['load_s']:.2f} "
            f"| {views / row['load_s']:,.0f} | {row['load_mib']:.0f} |"
        )
    return "\n".join(lines)


def plot(rows: list[dict[str, float]], path: Path) -> None:
    """Seconds and memory over the number of views."""
    from i2i.viz.style import new_figure, plain_axes, save_figure  # matplotlib only where needed

    figure = new_figure(8.0, 3.2)
    views = [row["views"] for row in rows]
    for index, (keys, label) in enumerate(
        (
            ({"render_s": "rendering", "load_s": "loading"}, "seconds"),
            (
                {"render_mib": "rendering", "worker_mib": "a worker", "load_mib": "loading"},
                "private memory, MiB",
            ),
        )
    ):
        axes = figure.add_subplot(1, 2, index + 1)
        plain_axes(axes)
        for key, name in keys.items():
            axes.plot(views, [row[key] for row in rows], marker="o", label=name)
        axes.set_xscale("log")
        axes.set_xlabel("views")
        axes.set_ylabel(label)
        if index == 0:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.legend(frameon=False)
    save_figure(figure, path)


def main() -> None:
    """Measure, print, and write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--name", default="scaling", help="of the files in benchmarks/results")
    options = parser.parse_args()
    rows = []
    for views in options.views:
        rows.append(in_fresh_process(views, options))
        print(table(rows[-1:]).splitlines()[-1], flush=True)
    print(table(rows))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{options.name}.json").write_text(json.dumps(rows, indent=1) + "\n")
    (RESULTS / f"{options.name}.md").write_text(table(rows) + "\n")
    plot(rows, RESULTS / f"{options.name}.png")


if __name__ == "__main__":
    main()
