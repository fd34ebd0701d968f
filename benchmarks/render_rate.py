"""Pictures per second of each renderer, in one process and in two, and the ratio to pyrender.

python benchmarks/render_rate.py --views 200 --image-size 128
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


def measure(
    name: str, modality: str, mesh: RenderMesh, views: int, image_size: int, start: object
) -> float:
    """Seconds for `views` pictures, the set-up of the mesh not counted."""
    renderer = get_renderer(name)
    rotations = Rotation.random(views, random_state=0).as_matrix()
    renderer.render(mesh, rotations[:2], modality=modality, image_size=image_size)
    start.wait()  # type: ignore[attr-defined]
    begin = time.perf_counter()
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
    arguments = parser.parse_args()
    mesh = chair(arguments.faces)
    print(f"{len(mesh.faces)} faces, {arguments.image_size} px, views per second")
    print(
        f"{'renderer':<10}{'modality':<10}{'1 process':>10}{'2 processes':>13}{'to pyrender':>13}"
    )
    rates: dict[tuple[str, str], list[float]] = {}
    # pyrender first: the others are told as ratios to it
    for name in sorted(renderer_names(), key=lambda n: n != "pyrender"):
        try:
            get_renderer(name)
        except RendererUnavailableError as error:
            print(f"{name:<10}left out: {error}")
            continue
        for modality in MODALITIES:
            rates[name, modality] = [
                rate(
                    name,
                    modality,
                    mesh,
                    processes=processes,
                    views=arguments.views,
                    image_size=arguments.image_size,
                )
                for processes in (1, 2)
            ]
            one, two = rates[name, modality]
            peer = rates.get(("pyrender", modality))
            ratio = "" if peer is None else f"{np.divide(two, peer[1]):.1f}"
            print(f"{name:<10}{modality:<10}{one:>10.0f}{two:>13.0f}{ratio:>13}", flush=True)


if __name__ == "__main__":
    main()
