"""Stores of clouds and view sets: the same bytes however they come about, as those of images."""

import json
import logging

import numpy as np
import pytest
from render_fakes import FakeRenderer, FakeSource, folder_bytes

import i2i.data.render_worker as render_worker
import i2i.data.rendering_job as rendering_job
from i2i.data.rendering_job import render_store
from i2i.data.store import RenderedStore
from i2i.errors import MeshError, StoreMismatchError
from i2i.geometry.seeding import view_rotation

CONTENT = {
    "partial_points": {"num_points": 12, "cloud_image_size": 8},
    "full_points": {"num_points": 12},
    "views": {"camera_set": "icosahedron_12"},
}


@pytest.fixture(params=CONTENT)
def modality(request):
    return request.param


def render(root, modality, *, views=5, members=None, **options):
    source = FakeSource()
    items = members or source.items(source.classes)
    options = {"num_workers": 0, "image_size": 6, "renderer": FakeRenderer(), **options}
    return render_store(
        source,
        {"train": items, "test": items[:2]},
        root=root,
        views_per_instance={"train": views, "test": 2},
        modality=modality,
        **CONTENT.get(modality, {}),
        **options,
    )


@pytest.fixture
def expected(tmp_path, modality):
    render(tmp_path / "expected", modality)
    return folder_bytes(tmp_path / "expected")


def test_contents(tmp_path, modality):
    paths = render(tmp_path, modality)
    store = RenderedStore.open(paths["can", "train"])
    name, shape, dtype = {
        "partial_points": ("points", (12, 3), np.float32),
        "full_points": ("points", (12, 3), np.float32),
        "views": ("view_sets", (12, 1, 6, 6), np.uint8),
    }[modality]
    assert store.content.shape == (20, *shape)
    assert store.content.dtype == dtype
    assert isinstance(store.content, np.memmap)
    assert sorted(path.name for path in store.path.iterdir()) == sorted(
        ["card.json", f"{name}.npy", "instances.npy", "rotations.npy", "views.npy"]
    )
    assert store.card["counts"] == {"rows": 20, "items": 4, "skipped": 0}
    assert store.card["arrays"][name]["shape"] == [20, *shape]
    told = store.card["settings"]
    for key, value in CONTENT[modality].items():
        assert told.get("image_size" if key == "cloud_image_size" else key) == value
    if name == "points":
        assert store.card["unit"] == "object radii"
        assert "channels" not in store.card
    else:
        assert (store.card["channels"], store.card["background"]) == (1, 255)
    store.verify()


def test_labels_are_those_of_the_image_of_the_same_view(tmp_path, modality):
    store = RenderedStore.open(render(tmp_path, modality)["can", "train"])
    image = RenderedStore.open(render(tmp_path, "gray")["can", "train"])
    assert store.path != image.path
    for name in ("rotations", "instances", "views"):
        assert (getattr(store, name) == getattr(image, name)).all()
    row = store.rows(["can_02"], views=range(3, 4))[0]
    exact = view_rotation("fake", "train", class_name="can", instance_id="can_02", view=3, seed=0)
    assert (store.rotations[row] == exact).all()


@pytest.mark.parametrize("modality", ["partial_points", "views"], indirect=True)
def test_bytes_do_not_depend_on_the_processes(tmp_path, modality, expected):
    render(tmp_path / "now", modality, num_workers=2)
    assert folder_bytes(tmp_path / "now") == expected


def test_bytes_do_not_depend_on_the_chunks(tmp_path, modality, expected, monkeypatch):
    monkeypatch.setattr(rendering_job, "VIEWS_PER_CHUNK", 2)
    render(tmp_path / "now", modality)
    assert folder_bytes(tmp_path / "now") == expected


def test_a_chunk_bounds_the_pictures_not_the_rows(tmp_path, monkeypatch):
    """Twelve views in a row must not make a task twelve times as large."""
    monkeypatch.setattr(rendering_job, "VIEWS_PER_CHUNK", 24)
    rendered = []
    original = FakeRenderer.render
    monkeypatch.setattr(
        FakeRenderer,
        "render",
        lambda self, mesh, rotations, **options: (
            rendered.append(len(rotations)) or original(self, mesh, rotations, **options)
        ),
    )
    render(tmp_path, "views")
    assert max(rendered) == 24
    assert sum(rendered) == 12 * (9 * 5 + 2 * 2)


def test_extended_is_the_same_as_made_at_once(tmp_path, modality, expected):
    boxes = FakeSource().items(["box"])
    render(tmp_path / "now", modality, members=boxes[:3], views=2)
    assert folder_bytes(tmp_path / "now") != expected
    render(tmp_path / "now", modality)
    assert folder_bytes(tmp_path / "now") == expected


def test_continued_after_a_break_is_the_same(tmp_path, modality, expected, monkeypatch):
    root, made = tmp_path / "now", []
    original = render_worker.RenderContext.render

    def broken(self, chunk):
        if len(made) == 6:
            raise KeyboardInterrupt
        made.append(chunk.path.name)
        return original(self, chunk)

    with monkeypatch.context() as context:
        context.setattr(render_worker.RenderContext, "render", broken)
        with pytest.raises(KeyboardInterrupt):
            render(root, modality)
    [left, *_] = root.rglob("*.npz")
    left.write_bytes(left.read_bytes()[:-40])  # as if the break had come in the middle of writing
    again = []
    monkeypatch.setattr(
        render_worker.RenderContext,
        "render",
        lambda self, chunk: again.append(chunk.path.name) or original(self, chunk),
    )
    render(root, modality)
    assert folder_bytes(root) == expected
    assert set(made) & set(again) == {left.name}
    assert not list(root.rglob("*.npz"))


def test_a_second_run_makes_nothing(tmp_path, modality, monkeypatch):
    render(tmp_path, modality)
    monkeypatch.setattr(rendering_job, "_run", pytest.fail)
    render(tmp_path, modality, image_size=6 if modality == "views" else 99)


class BlindRenderer(FakeRenderer):
    """Shows nothing of the second box and the second can."""

    def depth(self, mesh, rotations, **options):
        depth = super().depth(mesh, rotations, **options)
        lengths = np.sort(np.ptp(mesh.vertices, axis=0))
        return depth * (abs((lengths[1] + lengths[2]) / lengths[0] - 6) > 0.1)  # 1 × 3 × 3


def test_an_object_that_cannot_be_seen_is_skipped_and_listed(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        paths = render(tmp_path, "partial_points", renderer=BlindRenderer())
    assert "box/box_01: no pixel" in caplog.text
    card = json.loads((paths["box", "train"] / "card.json").read_text())
    assert [entry["id"] for entry in card["items"]] == ["box_00", "box_02", "box_03", "box_04"]
    assert "no pixels of the 8 px depth image" in card["skipped"][0]["reason"]
    with pytest.raises(MeshError, match=r"box_01.*no pixel"):
        render(tmp_path, "partial_points", renderer=BlindRenderer(), strict=True)


def test_another_sampler_is_refused(tmp_path, monkeypatch):
    render(tmp_path, "full_points")
    monkeypatch.setattr("i2i.data.settings.SURFACE_SAMPLER", ("surface", "2"))
    with pytest.raises(StoreMismatchError, match=r"renderer_version='1'.*'2'"):
        render(tmp_path, "full_points")
