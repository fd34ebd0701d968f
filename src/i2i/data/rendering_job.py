"""Rendering a data set into stores: resumable, parallel, and the same bytes whatever happens."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from i2i.data.content import content_notes, content_of
from i2i.data.fingerprint import mesh_fingerprint
from i2i.data.render_guards import disk_errors, locked, progress_of, worker_count
from i2i.data.render_worker import (
    VIEWS_PER_CHUNK,
    Chunk,
    ChunkData,
    RenderContext,
    chunk_tag,
    has_chunk,
    read_chunk,
    render_chunks,
)  # fmt: skip
from i2i.data.settings import store_settings
from i2i.data.sources.base import MeshItem, MeshSource
from i2i.data.store import (
    SCHEMA_VERSION,
    RenderedStore,
    StoredRun,
    StoreSettings,
    check_settings,
    mesh_mismatch,
    read_card,
    recover,
    write_store,
)  # fmt: skip
from i2i.errors import MeshError, StoreError
from i2i.geometry.cameras import Camera
from i2i.geometry.view_sets import camera_rotations
from i2i.rendering.base import Renderer

log = logging.getLogger(__name__)

MAX_WARNINGS = 10
"""Skipped meshes of a store that are reported one by one; the card lists all of them."""

StorePaths = dict[tuple[str, str], Path]
"""Store folder of each (class name, split)."""


@dataclass
class _Plan:
    """What one store has and lacks.

    Attributes:
        folder: Folder of the store.
        class_name: Class.
        split: Split.
        card: Card of the existing store, or None.
        fingerprints: Of each object asked for.
        chunks: Tasks, by instance.
        items: Objects of the tasks, by instance.
        whole: Whether its objects are all that are asked for, not a part of them.
        failed: Reasons of the objects that cannot be used, by instance.
        pending: Tasks that are not finished.
    """

    folder: Path
    class_name: str
    split: str
    whole: bool = True
    card: dict[str, Any] | None = None
    fingerprints: dict[str, str] = field(default_factory=dict)
    chunks: dict[str, list[Chunk]] = field(default_factory=dict)
    items: dict[str, MeshItem] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    pending: int = 0

    @property
    def chunk_folder(self) -> Path:
        """Folder of the chunk files."""
        return self.folder.parent / f".{self.split}.chunks"


def render_store(
    source: MeshSource,
    items: Mapping[str, Sequence[MeshItem]],
    *,
    views_per_instance: Mapping[str, int],
    root: str | os.PathLike[str],
    renderer: Renderer | str = "embree",
    camera: Camera | None = None,
    modality: str = "gray",
    image_size: int = 128,
    seed: int = 0,
    num_points: int | None = None,
    camera_set: str | None = None,
    cloud_image_size: int = 128,
    num_workers: int | None = None,
    strict: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    part: tuple[int, int] | None = None,
) -> StorePaths:
    """Make what the stores lack of some objects and views; nothing if they have it all.

    Each view has a seed of its own, made from (source, split, class, object, view, seed), so a
    store that is extended is the same as one that was rendered at once. An interrupted run is
    continued by the next one with the same settings.

    Args:
        source: Where the meshes come from.
        items: Objects for each split; ``"train"`` and ``"test"`` are seeds of disjoint views.
        views_per_instance: Views of each object, for each split.
        root: Folder of all stores.
        renderer: Name of a renderer, or one.
        camera: Defaults to the paper's.
        modality: A key of `i2i.data.info.CHANNELS`.
        image_size: Height and width of images and views in pixels.
        seed: Seed of the views.
        num_points: See `store_settings`, as for the next two.
        camera_set: See `store_settings`.
        cloud_image_size: See `store_settings`.
        num_workers: Processes; None for one per processor that may be used, 0 for this one.
        strict: Stop at the first mesh that cannot be read, instead of leaving it out.
        overwrite: Render again what is there.
        progress: Show a bar on a terminal, else log lines.
        part: ``(2, 8)`` for the second eighth of the objects: their views are rendered and kept
            beside the stores, and who renders all of them finds them there. None for all.

    Returns:
        Folder of the store of each (class name, split); of a part it may not be there yet.

    Raises:
        StoreMismatchError: if a store was made with other settings or from other meshes.
        MeshError: if a mesh cannot be read and ``strict``, or no mesh of a class can be read.
        StoreError: if the disk is full or a worker process dies.
    """
    settings = store_settings(
        source,
        renderer=renderer,
        camera=camera or Camera(),
        modality=modality,
        image_size=image_size,
        seed=seed,
        num_points=num_points,
        camera_set=camera_set,
        cloud_image_size=cloud_image_size,
    )

    def plans() -> list[_Plan]:
        return _plans(items, settings, root, views_per_instance, fresh=overwrite, part=part)

    todo = plans()
    if any(plan.chunks for plan in todo):
        base = Path(root) / settings.source / settings.key
        # Here, and not in each process: the camera sets need torch.
        cameras = None if camera_set is None else camera_rotations(camera_set)
        context = RenderContext(source, renderer, settings, cameras)
        with disk_errors(base), locked({plan.folder.parent for plan in todo}, part):
            # Another process may have rendered all of it while this one waited for the lock.
            if part is None:
                for plan in todo:
                    recover(plan.folder)
                    if overwrite:
                        shutil.rmtree(plan.chunk_folder, ignore_errors=True)
            todo = plans()
            _run(context, todo, worker_count(num_workers), strict=strict, progress=progress)
    _check_skipped(todo, strict=strict)
    return {(plan.class_name, plan.split): plan.folder for plan in todo}


def is_rendered(
    items: Mapping[str, Sequence[MeshItem]],
    settings: StoreSettings,
    *,
    views_per_instance: Mapping[str, int],
    root: str | os.PathLike[str],
    part: tuple[int, int] | None = None,
) -> bool:
    """Whether `render_store` would find all of some objects and views there.

    Raises:
        StoreMismatchError: as `render_store`.
    """
    todo = _plans(items, settings, root, views_per_instance, fresh=False, part=part)
    chunks = [chunk for plan in todo for group in plan.chunks.values() for chunk in group]
    return not chunks if part is None else all(map(has_chunk, chunks))


def _plans(
    items: Mapping[str, Sequence[MeshItem]],
    settings: StoreSettings,
    root: str | os.PathLike[str],
    views: Mapping[str, int],
    *,
    fresh: bool,
    part: tuple[int, int] | None,
) -> list[_Plan]:
    """What each store lacks, one plan for each class and split."""
    number, count = part or (1, 1)
    groups: dict[tuple[str, str], list[MeshItem]] = {}
    for split, members in items.items():
        for item in members[number - 1 :: count]:
            groups.setdefault((item.class_name, split), []).append(item)
    return [
        _plan(
            _Plan(settings.folder(root, name, split), name, split, whole=part is None),
            members, settings, views[split], fresh=fresh,
        )
        for (name, split), members in groups.items()
    ]  # fmt: skip


def _plan(
    plan: _Plan, members: Sequence[MeshItem], settings: StoreSettings, views: int, *, fresh: bool
) -> _Plan:
    """Find out what a store lacks.

    Raises:
        StoreMismatchError: if it was made with other settings or from other meshes.
    """
    plan.card = None if fresh else read_card(plan.folder)
    there: dict[str, dict[str, Any]] = {}
    if plan.card is not None:
        check_settings(plan.card, settings, plan.folder)
        there = {entry["id"]: entry for entry in (*plan.card["items"], *plan.card["skipped"])}
    for item in members:
        name, print_ = item.instance_id, mesh_fingerprint(item)
        known = there.get(name)
        if known is not None and known["fingerprint"] != print_:
            if "reason" in known:  # it could not be read then, and has been replaced since
                known = None
            else:
                raise mesh_mismatch(plan.folder, name)
        plan.fingerprints[name] = print_
        if known is not None and "reason" in known:
            plan.failed[name] = known["reason"]
            continue
        have = known["views"] if known is not None else 0
        if have < views:
            plan.items[name] = item
            plan.chunks[name] = _chunks(plan, item, settings, range(have, views))
    plan.pending = sum(len(chunks) for chunks in plan.chunks.values())
    return plan


def _chunks(plan: _Plan, item: MeshItem, settings: StoreSettings, views: range) -> list[Chunk]:
    """Tasks for some views of one object."""
    short = hashlib.sha256(item.instance_id.encode()).hexdigest()[:16]
    tag = chunk_tag(settings, item, plan.fingerprints[item.instance_id])
    step = max(1, VIEWS_PER_CHUNK // content_of(settings.told()).pictures)
    chunks = []
    for start in range(views.start, views.stop, step):
        stop = min(start + step, views.stop)
        path = plan.chunk_folder / f"{short}-{start:06d}-{stop:06d}.npz"
        chunks.append(Chunk(item, plan.split, start, stop, path, tag))
    return chunks


def _run(
    context: RenderContext, plans: list[_Plan], num_workers: int, *, strict: bool, progress: bool
) -> None:
    """Render all missing chunks and assemble each store as soon as it has all of its own."""
    owner = {
        chunk.path: plan for plan in plans for chunks in plan.chunks.values() for chunk in chunks
    }
    chunks = [chunk for plan in plans for group in plan.chunks.values() for chunk in group]
    total = sum(chunk.stop - chunk.start for chunk in chunks)
    with progress_of(total, enabled=progress) as advance:
        waiting = []
        for chunk in chunks:
            if read_chunk(chunk) is None:
                waiting.append(chunk)
            else:
                _finish(context, owner[chunk.path], chunk, None, strict=strict)
                advance(chunk.stop - chunk.start)
        done = render_chunks(context, waiting, num_workers=num_workers)
        with contextlib.closing(done):
            for chunk, reason in done:
                _finish(context, owner[chunk.path], chunk, reason, strict=strict)
                advance(chunk.stop - chunk.start)


def _finish(
    context: RenderContext, plan: _Plan, chunk: Chunk, reason: str | None, *, strict: bool
) -> None:
    """Note that a chunk is finished; assemble its store after the last one."""
    name = chunk.item.instance_id
    if reason is not None and name not in plan.failed:
        plan.failed[name] = reason
        if strict:
            raise MeshError(_unreadable(plan, [name]) + " (strict=true)")
        if len(plan.failed) <= MAX_WARNINGS:
            log.warning("Skipped mesh %s/%s: %s", plan.class_name, name, reason)
    plan.pending -= 1
    if plan.pending == 0 and plan.whole:
        if len(plan.failed) > MAX_WARNINGS:
            log.warning("Skipped %d meshes of %s in all.", len(plan.failed), plan.class_name)
        _assemble(context, plan)


def _assemble(context: RenderContext, plan: _Plan) -> None:
    """Put the chunks and the former store together, in an order that depends on names alone."""
    former = RenderedStore.open(plan.folder) if plan.card is not None else None
    entries = {entry["id"]: dict(entry) for entry in former.card["items"]} if former else {}
    skipped = {entry["id"]: entry for entry in former.card["skipped"]} if former else {}
    for name, item in plan.items.items():
        if name in plan.failed:
            skipped[name] = {
                "id": name,
                "reason": plan.failed[name],
                "fingerprint": plan.fingerprints[name],
            }
            entries.pop(name, None)
            continue
        skipped.pop(name, None)
        data = _chunk_data(plan.chunks[name][0])
        entries[name] = {
            "id": name,
            "group": item.group,
            "author": item.author,
            "licence": item.licence,
            "fingerprint": plan.fingerprints[name],
            "object_from_mesh": data.object_from_mesh.tolist(),
            "views": plan.chunks[name][-1].stop,
        }
    if not entries:
        raise MeshError(_unreadable(plan, sorted(plan.failed)) + " None of the class is left.")
    ordered = [entries[name] for name in sorted(entries)]
    write_store(
        plan.folder,
        {
            "schema": SCHEMA_VERSION,
            "settings": context.settings.told(),
            "class": plan.class_name,
            "split": plan.split,
            "licence": context.source.licence,
            **content_notes(context.settings.modality),
            "views_per_instance": max(entry["views"] for entry in ordered),
            "items": ordered,
            "skipped": [skipped[name] for name in sorted(skipped)],
        },
        _stored_runs(plan, former, ordered),
        num_rows=sum(entry["views"] for entry in ordered),
    )
    shutil.rmtree(plan.chunk_folder, ignore_errors=True)


def _stored_runs(
    plan: _Plan, former: RenderedStore | None, entries: Sequence[dict[str, Any]]
) -> Iterator[StoredRun]:
    """Rows of each object in order: those of the former store, then the new chunks."""
    had = {entry["id"]: entry["views"] for entry in former.card["items"]} if former else {}
    for name in (entry["id"] for entry in entries):
        if former is not None and name in had:
            rows = former.rows([name], views=range(had[name]))
            yield StoredRun(name, 0, former.content[rows], former.rotations[rows])
        for chunk in plan.chunks.get(name, ()):
            data = _chunk_data(chunk)
            yield StoredRun(name, chunk.start, data.content, data.rotations)


def _chunk_data(chunk: Chunk) -> ChunkData:
    data = read_chunk(chunk)
    if data is None:
        raise StoreError(f"The chunk file {chunk.path} vanished. Run the same command again.")
    return data


def _check_skipped(plans: Sequence[_Plan], *, strict: bool) -> None:
    """Raise if meshes were skipped now or earlier and that is not acceptable."""
    for plan in plans:
        if plan.failed and strict:
            raise MeshError(_unreadable(plan, sorted(plan.failed)) + " (strict=true)")
        if plan.whole and set(plan.fingerprints) <= set(plan.failed):
            raise MeshError(_unreadable(plan, sorted(plan.failed)) + " None of them is left.")


def _unreadable(plan: _Plan, names: Sequence[str]) -> str:
    reasons = "; ".join(f"{name} ({plan.failed[name]})" for name in names[:5])
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return (
        f"{len(names)} mesh(es) of class {plan.class_name}, split {plan.split}, cannot be used: "
        f"{reasons}{more}. Repair or remove the files and run the same command again."
    )
