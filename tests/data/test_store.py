"""The store on disk: round trip, damage, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from i2i.data.store import RenderedStore, StoredRun, StoreSettings, recover, write_store
from i2i.errors import StoreError, StoreMismatchError

SETTINGS = StoreSettings(
    source="fake",
    up_axis="z",
    renderer="fake",
    renderer_version="1",
    camera_distance=3.2,
    camera_fov_deg=45.0,
    modality="gray",
    image_size=4,
    seed=0,
)


def card(ids):
    return {
        "schema": 1,
        "channels": 1,
        "skipped": [],
        "settings": SETTINGS.__dict__,
        "items": [{"id": name} for name in ids],
    }


def runs(ids, views, seed=0):
    rng = np.random.default_rng(seed)
    for name in ids:
        images = rng.integers(0, 256, (views, 1, 4, 4), dtype=np.uint8)
        yield StoredRun(name, 0, images, rng.normal(size=(views, 3, 3)))


@pytest.fixture
def folder(tmp_path):
    path = SETTINGS.folder(tmp_path, "box", "train")
    write_store(path, card(["a", "b"]), runs(["a", "b"], 3), num_rows=6)
    return path


def test_round_trip(folder):
    store = RenderedStore.open(folder, expected=SETTINGS)
    expected = list(runs(["a", "b"], 3))
    assert (store.content == np.concatenate([run.content for run in expected])).all()
    assert (store.rotations == np.concatenate([run.rotations for run in expected])).all()
    assert store.instances.tolist() == [0, 0, 0, 1, 1, 1]
    assert store.views.tolist() == [0, 1, 2, 0, 1, 2]
    assert isinstance(store.content, np.memmap)
    assert store.card["counts"] == {"images": 6, "items": 2, "skipped": 0}
    store.verify()


def test_rows_of_objects_and_views(folder):
    store = RenderedStore.open(folder)
    assert store.rows(["b", "a"], views=range(1, 3)).tolist() == [4, 5, 1, 2]
    assert store.rows([], views=range(2)).tolist() == []
    for asked in ((["c"], range(1)), (["a"], range(4))):
        with pytest.raises(StoreError, match=r"i2i\.render"):
            store.rows(asked[0], views=asked[1])


@pytest.mark.parametrize(
    ("field", "value"),
    [("renderer_version", "2"), ("camera_distance", 3.0), ("seed", 1), ("up_axis", "y")],
)
def test_other_settings_are_refused(folder, field, value):
    with pytest.raises(StoreMismatchError) as caught:
        RenderedStore.open(folder, expected=replace(SETTINGS, **{field: value}))
    message = str(caught.value)
    there = getattr(SETTINGS, field)
    for text in (field, repr(value), repr(there), "overwrite=true", "paths.data_dir"):
        assert text in message


def test_unknown_renderer_version_is_not_compared(folder):
    RenderedStore.open(folder, expected=replace(SETTINGS, renderer_version=None))


def test_settings_have_folders_of_their_own_and_versions_do_not():
    keys = {
        replace(SETTINGS, **change).key
        for change in (
            {},
            {"seed": 1},
            {"camera_fov_deg": 40.0},
            {"image_size": 8},
            {"modality": "depth"},
            {"renderer": "other"},
            {"up_axis": "y"},
            {"renderer_version": "2"},
        )
    }
    assert len(keys) == 7
    assert SETTINGS.key.startswith("gray_4px_fake_")


def test_missing_card_means_no_store(folder):
    (folder / "card.json").unlink()
    with pytest.raises(StoreError, match="no rendered store"):
        RenderedStore.open(folder)


def test_truncated_array_is_noticed_on_opening(folder):
    file = folder / "images.npy"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(StoreError, match=r"images\.npy.*bytes"):
        RenderedStore.open(folder)


def test_swapped_array_is_noticed_on_opening(folder):
    np.save(folder / "views.npy", np.zeros(3, np.int64))  # as many bytes, another type
    with pytest.raises(StoreError, match=r"views\.npy"):
        RenderedStore.open(folder)


def test_flipped_bit_is_noticed_by_verify(folder):
    file = folder / "images.npy"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    store = RenderedStore.open(folder)
    with pytest.raises(StoreError, match=r"images\.npy is damaged"):
        store.verify()


def test_damaged_card_is_reported(folder):
    (folder / "card.json").write_text("{")
    with pytest.raises(StoreError, match="damaged"):
        RenderedStore.open(folder)


def test_other_schema_is_refused(folder):
    content = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps({**content, "schema": 99}))
    with pytest.raises(StoreMismatchError, match="schema=99"):
        RenderedStore.open(folder)


def test_failed_replacement_leaves_the_former_store(folder):
    before = (folder / "images.npy").read_bytes()

    def full_disk():
        yield from runs(["a"], 3)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_store(folder, card(["a", "b"]), full_disk(), num_rows=6)
    assert (folder / "images.npy").read_bytes() == before
    assert [path.name for path in folder.parent.iterdir()] == ["train"]


def test_replacement_cut_between_renames_is_undone(folder):
    folder.rename(folder.parent / ".train.old")
    with pytest.raises(StoreError):
        RenderedStore.open(folder)
    recover(folder)
    RenderedStore.open(folder).verify()


def test_opened_map_survives_a_replacement(folder):
    store = RenderedStore.open(folder)
    before = np.array(store.content)
    write_store(folder, card(["a", "b"]), runs(["a", "b"], 3, seed=1), num_rows=6)
    assert (store.content == before).all()
    assert (RenderedStore.open(folder).content != before).any()
