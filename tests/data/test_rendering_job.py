"""Rendering into stores: the same bytes however it goes, and clear errors when it does not."""

import errno
import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from render_fakes import FakeRenderer, FakeSource, folder_bytes

import i2i.data.render_worker as render_worker
import i2i.data.rendering_job as rendering_job
from i2i.data.render_guards import locked
from i2i.data.rendering_job import render_store
from i2i.data.store import RenderedStore
from i2i.errors import MeshError, StoreError, StoreMismatchError
from i2i.geometry.seeding import view_rotation


def render(root, source=None, *, views=5, test_views=2, classes=None, members=None, **options):
    source = source or FakeSource()
    items = members or source.items(classes or source.classes)
    options = {"num_workers": 0, "image_size": 8, "renderer": FakeRenderer(), **options}
    return render_store(
        source,
        {"train": items, "test": items[:2]},
        root=root,
        views_per_instance={"train": views, "test": test_views},
        **options,
    )


@pytest.fixture
def expected(tmp_path):
    render(tmp_path / "expected")
    return folder_bytes(tmp_path / "expected")


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(rendering_job, "VIEWS_PER_CHUNK", 2)


def test_contents(tmp_path):
    paths = render(tmp_path)
    assert set(paths) == {("box", "train"), ("can", "train"), ("box", "test")}
    store = RenderedStore.open(paths["can", "train"])
    assert store.content.shape == (20, 1, 8, 8)
    assert store.instance_ids == [f"can_{i:02d}" for i in range(4)]
    row = store.rows(["can_02"], views=range(3, 4))[0]
    rotation = view_rotation(
        "fake", "train", class_name="can", instance_id="can_02", view=3, seed=0
    )
    assert (store.rotations[row] == rotation).all()
    entry = store.card["items"][0]
    assert (entry["author"], entry["licence"], entry["views"]) == ("nobody", "CC0", 5)
    assert np.shape(entry["object_from_mesh"]) == (4, 4)
    assert store.card["settings"]["renderer"] == "fake"
    store.verify()


def test_views_are_disjoint(tmp_path):
    paths = render(tmp_path, views=20, test_views=20)
    rotations = np.concatenate([RenderedStore.open(path).rotations for path in paths.values()])
    assert len(np.unique(rotations.round(9), axis=0)) == len(rotations) == 20 * 11


def test_second_run_renders_nothing(tmp_path, monkeypatch):
    render(tmp_path)
    before = folder_bytes(tmp_path)
    monkeypatch.setattr(rendering_job, "_run", pytest.fail)
    render(tmp_path)
    assert folder_bytes(tmp_path) == before


@pytest.mark.parametrize("num_workers", [1, 2])
def test_bytes_do_not_depend_on_the_processes(tmp_path, expected, num_workers):
    render(tmp_path / "now", num_workers=num_workers)
    assert folder_bytes(tmp_path / "now") == expected


def test_bytes_do_not_depend_on_the_chunks(tmp_path, expected, small_chunks):
    render(tmp_path / "now")
    assert folder_bytes(tmp_path / "now") == expected


def test_extended_by_views_is_the_same_as_rendered_at_once(tmp_path, expected):
    render(tmp_path / "now", views=2, test_views=1)
    few = RenderedStore.open(render(tmp_path / "few", views=2)["box", "train"])
    render(tmp_path / "now")
    assert folder_bytes(tmp_path / "now") == expected
    many = RenderedStore.open(render(tmp_path / "now")["box", "train"])
    assert (many.content[many.views < 2] == few.content).all()
    assert (many.rotations[many.views < 2] == few.rotations).all()


def test_extended_by_objects_is_the_same_as_rendered_at_once(tmp_path, expected):
    boxes = FakeSource().items(["box"])
    render(tmp_path / "now", members=[*boxes[:2], boxes[4]])
    render(tmp_path / "now")
    assert folder_bytes(tmp_path / "now") == expected


def test_objects_that_are_not_asked_for_stay(tmp_path):
    boxes = FakeSource().items(["box"])
    render(tmp_path, members=boxes[3:])
    paths = render(tmp_path, members=boxes[:4], views=2)
    store = RenderedStore.open(paths["box", "train"])
    assert store.instance_ids == [item.instance_id for item in boxes]
    assert np.bincount(store.instances).tolist() == [2, 2, 2, 5, 5]
    store.rows(["box_04"], views=range(5))


def test_extension_renders_only_what_lacks(tmp_path, monkeypatch):
    render(tmp_path, views=3)
    rendered = []
    original = render_worker.RenderContext.render
    monkeypatch.setattr(
        render_worker.RenderContext,
        "render",
        lambda self, chunk: rendered.append((chunk.start, chunk.stop)) or original(self, chunk),
    )
    render(tmp_path, views=5)
    assert rendered == [(3, 5)] * 9


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from render_fakes import FakeRenderer, FakeSource
from i2i.data.rendering_job import render_store
if __name__ == "__main__":
    source = FakeSource(kill_at="can_01")
    items = source.items(source.classes)
    render_store(source, {{"train": items, "test": items[:2]}}, root={root!r},
        views_per_instance={{"train": 5, "test": 2}}, image_size=8, renderer=FakeRenderer(),
        num_workers={workers})
"""


@pytest.mark.parametrize("workers", [0, 2])
def test_killed_and_resumed_gives_the_same_bytes(tmp_path, expected, workers, monkeypatch):
    root = tmp_path / "now"
    script = tmp_path / "script.py"
    tests = str(Path(__file__).parent)
    script.write_text(SCRIPT.format(tests=tests, root=str(root), workers=workers))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, str(script)], env=environment, check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    assert not list(root.rglob("can/train/card.json"))
    left = {path.name for path in root.rglob(".train.chunks/*.npz")}
    rendered = []
    original = render_worker.RenderContext.render
    monkeypatch.setattr(
        render_worker.RenderContext,
        "render",
        lambda self, chunk: rendered.append(chunk.path.name) or original(self, chunk),
    )
    render(root)
    assert folder_bytes(root) == expected
    assert left
    assert left.isdisjoint(rendered)
    assert not list(root.rglob("*.npz"))


def test_damaged_or_foreign_chunks_are_rendered_again(tmp_path, expected, monkeypatch):
    root = tmp_path / "now"
    with monkeypatch.context() as context:
        context.setattr(rendering_job, "_assemble", lambda *_: None)
        render(root)
    first, second, *_ = sorted(root.rglob("*.npz"))
    first.write_bytes(first.read_bytes()[:-300])
    content = bytearray(second.read_bytes())
    content[400] ^= 1
    second.write_bytes(content)
    render(root)
    assert folder_bytes(root) == expected


def test_unreadable_mesh_is_skipped_and_listed(tmp_path, caplog):
    source = FakeSource(broken=["box_01"])
    with caplog.at_level(logging.WARNING):
        paths = render(tmp_path, source)
    assert "box/box_01" in caplog.text
    assert "holds no faces" in caplog.text
    card = json.loads((paths["box", "train"] / "card.json").read_text())
    assert [entry["id"] for entry in card["items"]] == ["box_00", "box_02", "box_03", "box_04"]
    assert card["skipped"][0]["id"] == "box_01"
    assert "holds no faces" in card["skipped"][0]["reason"]
    assert card["counts"] == {"images": 20, "items": 4, "skipped": 1}


@pytest.mark.parametrize("before", [False, True])
def test_unreadable_mesh_is_fatal_if_strict(tmp_path, before):
    source = FakeSource(broken=["box_01"])
    if before:
        render(tmp_path, source)
    with pytest.raises(MeshError, match=r"box_01.*holds no faces"):
        render(tmp_path, source, strict=True)


def test_nothing_left_is_fatal(tmp_path):
    source = FakeSource({"box": 2, "can": 2}, broken=["can_00", "can_01"])
    with pytest.raises(MeshError, match=r"class can.*can_00.*can_01"):
        render(tmp_path, source)


def test_other_renderer_version_is_refused_and_overwritten(tmp_path, expected):
    render(tmp_path / "now", renderer=FakeRenderer("0"))
    with pytest.raises(StoreMismatchError, match=r"renderer_version='0'.*'1'"):
        render(tmp_path / "now")
    render(tmp_path / "now", overwrite=True)
    assert folder_bytes(tmp_path / "now") == expected


def test_changed_mesh_file_is_refused(tmp_path):
    source = FakeSource({"box": 3}, root=tmp_path)
    for number in range(3):
        (tmp_path / f"box_{number:02d}.off").write_text(f"OFF {number}")
    render(tmp_path / "now", source)
    render(tmp_path / "now", source)
    (tmp_path / "box_02.off").write_text("OFF 9")
    with pytest.raises(StoreMismatchError, match="box_02"):
        render(tmp_path / "now", source)


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("module", "function"), [(render_worker, "write_chunk"), (rendering_job, "write_store")]
)
def test_full_disk_is_reported_and_loses_nothing(tmp_path, expected, monkeypatch, module, function):
    calls = []
    original = getattr(module, function)

    def after_one(*args, **kwargs):
        calls.append(args)
        return original(*args, **kwargs) if len(calls) == 1 else full_disk()

    with monkeypatch.context() as context:
        context.setattr(module, function, after_one)
        with pytest.raises(StoreError, match=r"full.*run the same command again.*paths\.data_dir"):
            render(tmp_path / "now")
    kept = list((tmp_path / "now").rglob("*.npz")) + list((tmp_path / "now").rglob("card.json"))
    assert kept
    render(tmp_path / "now")
    assert folder_bytes(tmp_path / "now") == expected


def test_two_processes_at_once_do_not_disturb_each_other(tmp_path, expected):
    root = tmp_path / "now"
    script = tmp_path / "script.py"
    text = SCRIPT.format(tests=str(Path(__file__).parent), root=str(root), workers=0)
    script.write_text(text.replace('kill_at="can_01"', ""))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    running = [subprocess.Popen([sys.executable, str(script)], env=environment) for _ in range(2)]
    assert [process.wait(120) for process in running] == [0, 0]
    assert folder_bytes(root) == expected


def test_wrong_settings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="modality=grey"):
        render(tmp_path, modality="grey")
    with pytest.raises(ValueError, match="render_workers=-1"):
        render(tmp_path, num_workers=-1)


def test_a_repaired_mesh_is_rendered_by_the_same_command(tmp_path):
    """A file that could not be read and was replaced since is neither skipped nor refused."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for number in range(3):
        (folder / f"box_{number:02d}.off").write_text("a mesh" if number != 1 else "rubbish")
    broken = FakeSource({"box": 3}, broken=["box_01"], root=folder)
    first = render(tmp_path / "store", broken)
    (folder / "box_01.off").write_text("a mesh after all")
    second = render(tmp_path / "store", FakeSource({"box": 3}, root=folder))
    card = RenderedStore.open(second["box", "train"]).card
    assert first == second
    assert [entry["id"] for entry in card["items"]] == ["box_00", "box_01", "box_02"]
    assert card["skipped"] == []


def test_parts_are_put_together_by_who_renders_all(tmp_path, expected):
    source = FakeSource(broken=["box_01"])
    whole = render(tmp_path / "whole", source)
    for number in (1, 2, 3, 4, 5, 6, 7, 8, 9, 10):  # the last one has no object
        render(tmp_path / "now", source, part=(number, 10))
    assert not list(tmp_path.glob("now/**/card.json"))
    assert render(tmp_path / "now", source).keys() == whole.keys()
    assert folder_bytes(tmp_path / "now") == folder_bytes(tmp_path / "whole") != expected


@pytest.mark.parametrize(
    ("held", "wanted", "waits"),
    [
        (None, None, True), (None, (1, 2), True), ((1, 2), None, True),
        ((1, 2), (1, 2), True), ((1, 2), (2, 2), False),
    ],
)  # fmt: skip
def test_different_parts_go_on_at_once_and_all_else_waits(tmp_path, held, wanted, waits):
    script = (
        "import sys; from pathlib import Path; from i2i.data.render_guards import locked\n"
        "print('ready', flush=True)\n"
        f"with locked([Path({str(tmp_path)!r}, 'box')], {wanted!r}): print('in', flush=True)"
    )
    with locked([tmp_path / "can", tmp_path / "box"], held):
        other = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "ready\n"
        if waits:
            with pytest.raises(subprocess.TimeoutExpired):
                other.wait(3)
        else:
            assert other.wait(60) == 0
    assert other.wait(60) == 0
    assert other.stdout.read() == "in\n"
