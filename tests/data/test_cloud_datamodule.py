"""Clouds and view sets as a trainer gets them."""

import numpy as np
import pytest
import torch
from mesh_distance import distance_to
from render_fakes import FakeRenderer, FakeSource

from i2i.data.datamodule import RenderedDataModule
from i2i.data.info import DataInfo
from i2i.data.loaders import LoaderSettings
from i2i.data.reference import reference_meshes
from i2i.data.sources.synthetic import SyntheticSource
from i2i.data.store import RenderedStore
from i2i.geometry.view_sets import camera_rotations
from i2i.rendering import get_renderer

CONTENT = {
    "gray": {},
    "partial_points": {"num_points": 32, "cloud_image_size": 48},
    "full_points": {"num_points": 32},
    "views": {"camera_set": "icosahedron_12"},
}


def make(tmp_path, modality, source=None, **options):
    options = {
        "modality": modality,
        "image_size": 12,
        "views_per_instance": 4,
        "test_views_per_instance": 3,
        "batch_size": 4,
        "render_workers": 0,
        "store_root": tmp_path,
        "object": "chair",
        **CONTENT[modality],
        **options,
    }
    source = source or SyntheticSource(instances_per_class=3, test_instances_per_class=1)
    module = RenderedDataModule(source, **options)
    module.prepare_data()
    module.setup()
    return module


def make_fake(tmp_path, modality, **options):
    options = {"object": "all", "renderer": FakeRenderer(), **options}
    return make(tmp_path, modality, FakeSource(), **options)


def collect(loader):
    batches = list(loader)
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}


def epoch_of(module, epoch):
    loader = module.train_dataloader()
    loader.batch_sampler.sampler.set_epoch(epoch)
    return collect(loader)


@pytest.mark.parametrize(
    ("modality", "name", "shape"),
    [
        ("gray", "image", (1, 12, 12)),
        ("partial_points", "points", (32, 3)),
        ("full_points", "points", (32, 3)),
        ("views", "views", (12, 1, 12, 12)),
    ],
)
def test_batch_is_what_the_contract_says(tmp_path, modality, name, shape):
    module = make(tmp_path, modality)
    for loader, size in ((module.train_dataloader(), 4), (module.test_dataloader(), 3)):
        batch = next(iter(loader))
        assert {key: (tuple(v.shape), v.dtype) for key, v in batch.items()} == {
            name: ((size, *shape), torch.float32),
            "rotation": ((size, 3, 3), torch.float32),
            "class_id": ((size,), torch.int64),
            "instance_id": ((size,), torch.int64),
            "view_id": ((size,), torch.int64),
        }
        if name == "points":
            assert batch[name].mean(dim=1).abs().max() < 1e-6
            assert (batch[name].norm(dim=2).amax(dim=1) - 1).abs().max() < 1e-6
        else:
            assert 0 <= batch[name].min() < 0.9
            assert batch[name].max() == 1
    one = module.dataset("test")[1]
    assert tuple(one[name].shape) == shape


def test_info_says_what_a_network_needs(tmp_path):
    info = {name: make(tmp_path, name).info for name in CONTENT}
    classes = {"num_classes": 1}
    assert info["gray"].network_arguments() == {"channels": 1, "image_size": 12, **classes}
    for name in ("partial_points", "full_points"):
        assert info[name].network_arguments() == {"num_points": 32, **classes}
        assert (info[name].num_views, info[name].camera_set) == (None, None)
    assert info["views"].network_arguments() == {
        "channels": 1,
        "image_size": 12,
        "num_views": 12,
        **classes,
    }
    assert (info["views"].camera_set, info["views"].num_points) == ("icosahedron_12", None)
    assert info["partial_points"].image_size == 48  # of the pictures behind the points
    for told in info.values():
        assert DataInfo.from_dict(told.to_dict()) == told


def assert_on_the_mesh(module, split, batch, row):
    """The cloud of a row, turned back by its label, lies on the mesh, but for size and place."""
    name = module.instance_names(split)[batch["instance_id"][row]]
    item = next(i for i in module.items[split] if f"chair/{i.instance_id}" == name)
    [mesh] = reference_meshes(module.source, [item]).values()
    folder = module.settings.folder(
        module.store_root, "chair", "test" if split == "test" else "train"
    )
    store = RenderedStore.open(folder)
    view = int(batch["view_id"][row])
    [stored] = store.rows([item.instance_id], views=range(view, view + 1))
    raw = store.content[stored].astype(np.float64)
    centre, size = raw.mean(axis=0), np.linalg.norm(raw - raw.mean(axis=0), axis=1).max()
    label, points = batch["rotation"][row].double().numpy(), batch["points"][row].double().numpy()
    mean = store.rotations[stored].T @ centre  # in the object frame, however the cloud is turned
    assert distance_to(mesh, size * points @ label + mean).max() < 1e-3
    assert distance_to(mesh, size * points @ label.T + mean).max() > 0.02


@pytest.mark.parametrize("modality", ["partial_points", "full_points"])
def test_points_lie_on_the_mesh_turned_by_the_label(tmp_path, modality):
    module = make(tmp_path, modality)
    test, train = collect(module.test_dataloader()), epoch_of(module, 2)
    for row in range(3):
        assert_on_the_mesh(module, "test", test, row)
        assert_on_the_mesh(module, "train", train, row)


def by_view(batch, name):
    keys = zip(batch["instance_id"].tolist(), batch["view_id"].tolist(), strict=True)
    return dict(zip(keys, batch[name], strict=True))


@pytest.mark.parametrize(
    ("modality", "options", "fresh"),
    [
        ("full_points", {}, True),
        ("full_points", {"rotate_points": False}, False),
        ("partial_points", {}, False),
        ("partial_points", {"rotate_points": True}, True),
        ("views", {}, False),
    ],
)
def test_training_rotations_are_fresh_where_asked_and_test_ones_never(
    tmp_path, modality, options, fresh
):
    module = make_fake(tmp_path, modality, val_fraction=0.4, **options)
    first, second = (by_view(epoch_of(module, epoch), "rotation") for epoch in (0, 1))
    shared = first.keys() & second.keys()
    assert len(shared) >= 4
    changed = [not torch.equal(first[key], second[key]) for key in shared]
    assert all(changed) if fresh else not any(changed)
    again = make_fake(tmp_path, modality, val_fraction=0.4, **options)
    assert torch.equal(epoch_of(again, 1)["rotation"], epoch_of(module, 1)["rotation"])
    other = make_fake(tmp_path, modality, val_fraction=0.4, sampler_seed=1, **options)
    images = make_fake(tmp_path, "gray", val_fraction=0.4)
    for split in ("val", "test"):
        loaders = [getattr(m, f"{split}_dataloader")() for m in (module, module, other, images)]
        rotations = [collect(loader)["rotation"] for loader in loaders]
        assert all(torch.equal(rotation, rotations[0]) for rotation in rotations)


def test_labels_of_symmetric_classes_stay_stripped(tmp_path):
    """A can's label has one form for all of its turns, in training too."""
    batch = epoch_of(make_fake(tmp_path, "full_points"), 0)
    full = epoch_of(make_fake(tmp_path, "full_points", strip_symmetry=False), 0)
    assert torch.equal(batch["points"], full["points"])
    assert torch.allclose(batch["rotation"][:, :, 2], full["rotation"][:, :, 2], atol=1e-6)
    can = batch["class_id"] == 1
    assert torch.allclose(batch["rotation"][~can], full["rotation"][~can], atol=1e-6)
    assert (batch["rotation"] - full["rotation"])[can].abs().amax(dim=(1, 2)).median() > 0.1


@pytest.mark.parametrize("modality", ["partial_points", "full_points"])
@pytest.mark.parametrize("epoch", [0, 3])
def test_batches_do_not_depend_on_the_workers(tmp_path, modality, epoch):
    options = {"point_dropout": 0.3, "point_scale": 0.1, "point_shift": 0.1, "point_noise": 0.01}
    alone = epoch_of(make_fake(tmp_path, modality, **options), epoch)
    parallel = epoch_of(make_fake(tmp_path, modality, num_workers=2, **options), epoch)
    for name, value in alone.items():
        assert torch.equal(value, parallel[name])


def test_disturbances_are_for_training_only(tmp_path):
    options = {"point_dropout": 0.3, "point_scale": 0.1, "point_shift": 0.1, "point_noise": 0.01}
    plain = make_fake(tmp_path, "partial_points")
    disturbed = make_fake(tmp_path, "partial_points", **options)
    for name, value in collect(plain.test_dataloader()).items():
        assert torch.equal(value, collect(disturbed.test_dataloader())[name])
    a, b = epoch_of(plain, 0), epoch_of(disturbed, 0)
    assert torch.equal(a["rotation"], b["rotation"])
    assert ((a["points"] - b["points"]).abs().amax(dim=(1, 2)) > 1e-3).all()


def test_views_are_those_of_the_cameras_around_the_rotated_object(tmp_path):
    module = make(tmp_path, "views", strip_symmetry=False)
    batch = collect(module.test_dataloader())
    [item] = module.items["test"]
    [mesh] = reference_meshes(module.source, [item]).values()
    turned = camera_rotations("icosahedron_12") @ batch["rotation"][2].double().numpy()
    expected = get_renderer("embree").render(mesh, turned, image_size=12) / 255
    assert np.abs(batch["views"][2].numpy() - expected).max() < 0.02


def test_the_default_pixel_shift_does_not_touch_clouds_and_views(tmp_path):
    for modality, name in (("partial_points", "points"), ("views", "views")):
        shifted = epoch_of(make_fake(tmp_path, modality, shift_px=20), 0)
        plain = epoch_of(make_fake(tmp_path, modality, shift_px=0), 0)
        assert torch.equal(shifted[name], plain[name])


@pytest.mark.parametrize(
    ("modality", "options", "message"),
    [
        ("views", {"test_shift_px": 3}, r"test_shift_px=3.*gray, depth, rgb.*is views"),
        ("partial_points", {"test_shift_px": 3}, r"test_shift_px=3.*is partial_points"),
        ("full_points", {"depth_shift": 2}, r"depth_shift=2.*modality=depth.*is full_points"),
        ("views", {"test_depth_shift": 2}, r"test_depth_shift=2.*modality=depth.*is views"),
        ("gray", {"rotate_points": True}, r"rotate_points=True.*full_points.*is gray"),
        ("views", {"point_noise": 0.1}, r"point_noise=0\.1.*partial_points or full_points"),
        ("full_points", {"point_dropout": 1}, r"point_dropout=1 is not allowed.*\[0, 1\)"),
        ("full_points", {"point_scale": -0.1}, r"point_scale=-0\.1 is not allowed"),
        ("partial_points", {"point_shift": -1}, r"point_shift=-1.*0 or more"),
        ("partial_points", {"point_noise": float("nan")}, r"point_noise=nan.*0 or more"),
    ],
)
def test_settings_that_do_not_fit_are_refused(modality, options, message):
    with pytest.raises(ValueError, match=message):
        LoaderSettings(**options).check(modality)


def test_settings_are_refused_before_anything_is_made(tmp_path):
    for options, message in (
        ({"modality": "views"}, "camera_set=None is missing"),
        ({"modality": "full_points", "num_points": 3}, "num_points=3"),
    ):
        with pytest.raises(ValueError, match=message):
            RenderedDataModule(FakeSource(), store_root=tmp_path, **options)
    assert not list(tmp_path.iterdir())
