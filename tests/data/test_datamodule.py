"""The data module as a trainer uses it: what is in the batches, and that nothing leaks."""

import logging
import os
import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from render_fakes import FakeRenderer, FakeSource

from i2i.data.augment import to_float
from i2i.data.datamodule import RenderedDataModule
from i2i.data.dataset import ImageBlock, RenderedDataset
from i2i.data.info import DataInfo
from i2i.data.reference import reference_meshes
from i2i.errors import MeshError, StoreError
from i2i.geometry.rotations import strip_z_symmetry


def make(tmp_path, source=None, **options):
    options = {
        "image_size": 16,
        "renderer": FakeRenderer(),
        "views_per_instance": 6,
        "store_root": tmp_path,
        "test_views_per_instance": 4,
        "batch_size": 8,
        "render_workers": 0,
        **options,
    }
    module = RenderedDataModule(source or FakeSource(), **options)
    module.prepare_data()
    module.setup()
    return module


def collect(loader):
    batches = list(loader)
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}


def views_of(module, split):
    dataset, names = module.dataset(split), module.instance_names(split)
    return {
        (names[i], v): dataset.rotation[row]
        for row, (i, v) in enumerate(zip(dataset.instance_id, dataset.view_id, strict=True))
    }


def test_batch_is_what_the_contract_says(tmp_path):
    module = make(tmp_path)
    batch = next(iter(module.train_dataloader()))
    assert {name: (tuple(v.shape), v.dtype) for name, v in batch.items()} == {
        "image": ((8, 1, 16, 16), torch.float32),
        "rotation": ((8, 3, 3), torch.float32),
        "class_id": ((8,), torch.int64),
        "instance_id": ((8,), torch.int64),
        "view_id": ((8,), torch.int64),
    }
    assert batch["image"].min() >= 0
    assert batch["image"].max() <= 1
    assert module.info == DataInfo(
        ("box", "can"), ("none", "z"), channels=1, image_size=16, modality="gray", source="fake"
    )


def test_images_belong_to_their_labels(tmp_path):
    module = make(tmp_path, shift_px=0, strip_symmetry=False)
    data, names = collect(module.test_dataloader()), module.instance_names("test")
    assert len(data["image"]) == 4 * len(names)
    assert set(zip(data["instance_id"].tolist(), data["view_id"].tolist(), strict=True)) == {
        (i, v) for i in range(len(names)) for v in range(4)
    }
    source = module.source
    for row in range(len(data["image"])):
        class_name, instance = names[data["instance_id"][row]].split("/")
        assert module.class_names[data["class_id"][row]] == class_name
        item = next(i for i in source.items([class_name]) if i.instance_id == instance)
        [mesh] = reference_meshes(source, [item]).values()
        rotation = data["rotation"][row].double().numpy()[None]
        # float32 labels give the seventh digit only, too few for the fake renderer's hash
        from i2i.geometry.seeding import view_rotation

        exact = view_rotation(
            "fake",
            "test",
            class_name=class_name,
            instance_id=instance,
            view=int(data["view_id"][row]),
            seed=0,
        )[None]
        assert np.abs(rotation - exact).max() < 1e-6
        image = FakeRenderer().render(mesh, exact, camera=None, image_size=16, modality="gray")
        assert (data["image"][row].numpy() == to_float(image)[0]).all()


@pytest.mark.parametrize("split", ["instance", "view"])
def test_splits_are_disjoint(tmp_path, split):
    module = make(tmp_path, split=split, val_fraction=0.3)
    parts = {name: views_of(module, name) for name in ("train", "val", "test")}
    rotations = np.concatenate([np.stack(list(part.values())) for part in parts.values()])
    full = make(tmp_path, split=split, val_fraction=0.3, strip_symmetry=False)
    whole = np.concatenate([np.stack([*views_of(full, name).values()]) for name in parts])
    assert len(np.unique(whole.round(6), axis=0)) == len(whole) == len(rotations)
    objects = [{name for name, _ in part} for part in parts.values()]
    if split == "instance":
        assert sum(map(len, objects)) == len(set.union(*objects)) == 9
    else:
        assert objects[0] == objects[1] == objects[2]
        assert {view for _, view in parts["train"]} == {0, 1, 2, 3}
        assert {view for _, view in parts["val"]} == {4, 5}


def test_single_mesh_is_split_by_view(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        module = make(tmp_path, FakeSource({"box": 1}), val_fraction=0.1)
    assert caplog.text.count("data.split=view") == 1
    assert [len(module.dataset(name)) for name in ("train", "val", "test")] == [5, 1, 4]


def test_fewer_views_are_the_first_of_more(tmp_path):
    many = make(tmp_path, views_per_instance=60, batch_size=8)
    few = make(tmp_path, views_per_instance=15, batch_size=8)
    alone = make(tmp_path / "alone", views_per_instance=15)
    assert len(few.dataset("train")) * 4 == len(many.dataset("train"))
    all_views = views_of(many, "train")
    for name, rotation in views_of(few, "train").items():
        assert (rotation == all_views[name]).all()
    rows = np.arange(len(few.dataset("train")))
    images = few.dataset("train").raw_images(rows)
    assert (images == alone.dataset("train").raw_images(rows)).all()
    first = np.flatnonzero(many.dataset("train").view_id < 15)
    assert (images == many.dataset("train").raw_images(first)).all()


@pytest.mark.parametrize("strip", [True, False])
def test_symmetric_labels_are_stripped(tmp_path, strip):
    dataset = make(tmp_path, strip_symmetry=strip).dataset("test")
    full = make(tmp_path, strip_symmetry=False).dataset("test").rotation
    expected = full.copy()
    can = dataset.class_id == 1
    if strip:
        expected[can] = strip_z_symmetry(torch.from_numpy(full[can]).double()).numpy()
        assert np.abs(expected[can] - full[can]).max() > 0.1
    assert np.abs(dataset.rotation - expected).max() < 1e-5


def test_symmetry_can_be_overridden(tmp_path):
    assert make(tmp_path, symmetry="none").info.symmetry == ("none", "none")
    assert make(tmp_path, symmetry={"box": "z"}).info.symmetry == ("z", "z")
    with pytest.raises(ValueError, match="'y'"):
        make(tmp_path, symmetry="y")


@pytest.mark.parametrize("epoch", [0, 3])
def test_batches_do_not_depend_on_the_workers(tmp_path, epoch):
    def epoch_of(workers):
        loader = make(tmp_path, num_workers=workers, batches_per_epoch=4).train_dataloader()
        loader.batch_sampler.sampler.set_epoch(epoch)
        return collect(loader)

    alone, parallel = epoch_of(0), epoch_of(2)
    for name, value in alone.items():
        assert torch.equal(value, parallel[name])


class Recorder(LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, batch_idx):
        self.seen.append(batch["image"].clone())
        return self.weight * batch["image"].mean()

    def validation_step(self, batch, batch_idx):
        self.validated = True

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(tmp_path, module, epochs, ckpt_path=None):
    recorder = Recorder()
    trainer = Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        default_root_dir=tmp_path,
    )
    trainer.fit(recorder, module, ckpt_path=ckpt_path, weights_only=True)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    return torch.stack(recorder.seen)


def test_resumed_training_sees_the_same_batches(tmp_path):
    unbroken = fit(tmp_path / "a", make(tmp_path), 4)
    first = fit(tmp_path / "b", make(tmp_path), 2)
    second = fit(tmp_path / "b", make(tmp_path), 4, ckpt_path=tmp_path / "b" / "last.ckpt")
    assert torch.equal(torch.cat([first, second]), unbroken)
    half = len(unbroken) // 4
    assert not torch.equal(unbroken[:half], unbroken[half : 2 * half])


def test_processes_share_batches_and_test_images(tmp_path):
    def at(rank, world_size):
        module = make(tmp_path)
        module.trainer = SimpleNamespace(global_rank=rank, world_size=world_size)
        return module

    alone = next(iter(at(0, 1).train_dataloader()))["image"]
    ranks = [next(iter(at(rank, 2).train_dataloader()))["image"] for rank in range(2)]
    assert torch.equal(torch.cat(ranks), alone)
    tests = [collect(at(rank, 3).test_dataloader()) for rank in range(3)]
    seen = [
        (int(i), int(v)) for t in tests for i, v in zip(t["instance_id"], t["view_id"], strict=True)
    ]
    assert len(seen) == len(set(seen)) == len(at(0, 1).dataset("test"))


def test_no_validation_set(tmp_path):
    assert make(tmp_path).val_dataloader() == []


def test_small_data_gives_a_smaller_batch_with_a_notice(tmp_path, caplog):
    module = make(tmp_path, FakeSource({"box": 1}), batch_size=100)
    with caplog.at_level(logging.WARNING):
        [batch] = list(module.train_dataloader())
    assert len(batch["image"]) == 6
    assert "only 6 training samples" in caplog.text


def test_test_shift_is_fixed_and_belongs_to_the_view(tmp_path):
    plain = collect(make(tmp_path).test_dataloader())
    shifted = collect(make(tmp_path, test_shift_px=20).test_dataloader())
    again = make(tmp_path, test_shift_px=20, eval_batch_size=3, sampler_seed=9)
    assert torch.equal(collect(again.test_dataloader())["image"], shifted["image"])
    assert not torch.equal(plain["image"], shifted["image"])
    # The fake renderer never draws the background value, so the filled border tells the shift.
    for name in ("instance_id", "view_id"):
        borders = shifted["image"][shifted[name] == 0][:, 0].eq(1)
        assert len({tuple(border.flatten().tolist()) for border in borders}) > 1
    # One class alone: the same pictures get the same shifts.
    can = collect(make(tmp_path, object="can", test_shift_px=20).test_dataloader())
    assert torch.equal(can["image"], shifted["image"][shifted["class_id"] == 1])


def test_depth_shift_of_depth_images_only(tmp_path):
    module = make(tmp_path, modality="depth", depth_shift=5, shift_px=0)
    dataset = module.dataset("train")
    batch = dataset.__getitems__([(0, 10), (0, 11)])["image"]
    plain = torch.from_numpy(to_float(dataset.raw_images([0, 0])))
    inside = (plain > 0.1) & (plain < 0.9)
    first, second = [(batch[k] - plain[k])[inside[k]] for k in range(2)]
    assert first.std() < 1e-6
    assert first.mean().abs() <= 0.05
    assert (first.mean() - second.mean()).abs() > 1e-4
    with pytest.raises(ValueError, match="modality=depth"):
        make(tmp_path, depth_shift=5)


def test_skipped_mesh_is_left_out_everywhere(tmp_path):
    module = make(tmp_path, FakeSource(broken=["box_01"]))
    names = module.instance_names("train") + module.instance_names("test")
    assert "box/box_01" not in names
    assert len(names) == 8
    for split in ("train", "test"):
        ids = module.dataset(split).instance_id
        assert set(ids) == set(range(len(module.instance_names(split))))
    with pytest.raises(MeshError, match="box_01"):
        make(tmp_path, FakeSource(broken=["box_01"]), strict=True)


def test_errors_say_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"no class cup; it has: box, can.*data\.object"):
        make(tmp_path, object="cup")
    with pytest.raises(ValueError, match="views_per_instance=0"):
        make(tmp_path, views_per_instance=0)
    module = RenderedDataModule(FakeSource(), renderer=FakeRenderer(), store_root=tmp_path)
    with pytest.raises(StoreError, match=r"python -m i2i\.render"):
        module.setup()


def test_dataset_pickles_without_its_images(tmp_path):
    dataset = make(tmp_path, views_per_instance=200).dataset("train")
    before = dataset[3]["image"]
    assert torch.equal(pickle.loads(pickle.dumps(dataset))[3]["image"], before)
    assert len(pickle.dumps(dataset)) < dataset.raw_images(range(len(dataset))).nbytes / 2


def private_memory():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon"))


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs Linux's /proc")
def test_memory_does_not_grow_with_the_store(tmp_path):
    rows = 4000
    size = 64
    images = np.lib.format.open_memmap(
        tmp_path / "images.npy", "w+", np.uint8, (rows, 1, size, size)
    )
    images[:] = 1
    del images
    numbers = np.arange(rows)
    block = ImageBlock(
        tmp_path / "images.npy",
        numbers,
        np.zeros((rows, 3, 3), np.float32),
        numbers,
        numbers,
        numbers,
        numbers,
    )
    dataset = RenderedDataset([block])
    dataset.__getitems__(range(64))
    before = private_memory()
    for start in range(0, rows, 50):
        dataset.__getitems__(range(start, start + 50))
    assert private_memory() - before < rows * size**2 / 4


def test_reference_mesh_is_the_median_readable_one():
    source = FakeSource({"box": 4, "can": 2}, broken=["box_00", "can_00", "can_01"])
    meshes = reference_meshes(source, source.items(["box", "can"]))
    assert list(meshes) == ["box"]
    assert len(meshes["box"].faces) == 12
