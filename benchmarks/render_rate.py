"""Pictures per second of each renderer, in one process and in two, and the ratios to pyrender.

python benchmarks/render_rate.py --views 200 --image-size 128

pyrender is there twice: with one OpenGL context that is kept, and, as `pyrender/view`, with a new
scene and context for each view, as the paper's published code does it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from i2i.errors import RendererUnavailableError
from i2i.rendering import MODALITIES, RenderMesh, get_renderer, prepare_mesh, renderer_names


def chair(faces: int) -> RenderMesh:
    """A plain chair of boxes and round legs with about the wanted number of faces."""
    seat = trimesh.creation.box((1.0, 1.0, 0.12))
    back = trimesh.creation.box((1.0, 0.1, 1.1))
    back.apply_translation((0.0, 0.45, 0.6))
    legs = []
    for x in (-0.42, 0.42):
        for y in (-0.42, 0.42):
            leg = trimesh.creation.cylinder(0.06, 0.9, sections=24)
            leg.apply_translation((x, y, -0.45))
            legs.append(leg)
    whole = trimesh.util.concatenate([seat, back, *legs])
    edge = 1.0
    while len(whole.faces) < faces:
        edge *= 0.8
        whole = whole.subdivide_to_size(edge)
    return prepare_mesh(whole)


FRESH = "/view"  # behind a renderer's name: everything is set up anew for each view


def measure(
    name: str, modality: str, mesh: RenderMesh, views: int, image_size: int, start: object
) -> float:
    """Seconds for `views` pictures, without the first set-up of the mesh."""
    renderer = get_renderer(name.removesuffix(FRESH))
    rotations = Rotation.random(views, random_state=0).as_matrix()
    renderer.render(mesh, rotations[:2], modality=modality, image_size=image_size)
    start.wait()  # type: ignore[attr-defined]
    begin = time.perf_counter()
    if name.endswith(FRESH):
        for view in range(views):
            renderer.close()  # type: ignore[attr-defined]
            renderer.render(
                mesh, rotations[view : view + 1], modality=modality, image_size=image_size
            )
    else:
        renderer.render(mesh, rotations, modality=modality, image_size=image_size)
    return time.perf_counter() - begin


def _child(
    name: str,
    modality: str,
    mesh: RenderMesh,
    views: int,
    image_size: int,
    start: object,
    results: object,
) -> None:
    seconds = measure(name, modality, mesh, views, image_size, start)
    results.put(seconds)  # type: ignore[attr-defined]


def rate(
    name: str, modality: str, mesh: RenderMesh, *, processes: int, views: int, image_size: int
) -> float:
    """Views per second of several processes that start together."""
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(processes), context.Queue()
    children = [
        context.Process(
            target=_child, args=(name, modality, mesh, views, image_size, start, results)
        )
        for _ in range(processes)
    ]
    for child in children:
        child.start()
    seconds = max(results.get() for _ in children)
    for child in children:
        child.join()
    return processes * views / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--faces", type=int, default=5000)
    parser.add_argument("--modalities", default=",".join(MODALITIES), help="with commas")
    parser.add_argument("--renderers", default="", help="with commas; all by default")
    arguments = parser.parse_args()
    mesh = chair(arguments.faces)
    print(f"{len(mesh.faces)} faces, {arguments.image_size} px, views per second")
    peers = ("pyrender", "pyrender" + FRESH)
    print(
        f"{'renderer':<15}{'modality':<10}{'1 process':>10}{'2 processes':>13}"
        + "".join(f"{'to ' + peer:>18}" for peer in peers)
    )
    rates: dict[tuple[str, str], list[float]] = {}
    # pyrender first: the others are told as ratios to it
    for name in (*peers, *(n for n in renderer_names() if n != "pyrender")):
        if arguments.renderers and name not in arguments.renderers.split(","):
            continue
        try:
            get_renderer(name.removesuffix(FRESH))
        except RendererUnavailableError as error:
            print(f"{name:<15}left out: {error}")
            continue
        for modality in arguments.modalities.split(","):
            rates[name, modality] = [
                rate(
                    name,
                    modality,
                    mesh,
                    processes=processes,
                    # a context takes as long as dozens of views
                    views=arguments.views // 10 if name.endswith(FRESH) else arguments.views,
                    image_size=arguments.image_size,
                )
                for processes in (1, 2)
            ]
            one, two = rates[name, modality]
            ratios = [
                f"{np.divide(two, rates[peer, modality][1]):.1f}"
                if (peer, modality) in rates
                else ""
                for peer in peers
            ]
            print(
                f"{name:<15}{modality:<10}{one:>10.0f}{two:>13.0f}"
                + "".join(f"{ratio:>18}" for ratio in ratios),
                flush=True,
            )


if __name__ == "__main__":
    main()
