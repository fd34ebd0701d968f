import json

import numpy as np
import pytest
from PIL import Image

from i2i.data.sources.mesh_files import mesh_parts
from i2i.data.sources.shapenet55 import PAPER_CLASSES, ShapeNet55
from i2i.data.sources.shapenet_synsets import SYNSETS
from i2i.errors import DatasetNotFoundError, MeshError

OBJ = (
    "mtllib model_normalized.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    "vt 0 0\nvt 1 0\nvt 0 1\nusemtl red\nf 1 2 3\nusemtl paper\nf 1/1 2/2 4/3\n"
)
MTL = "newmtl red\nKd 1 0 0\nnewmtl paper\nKd 1 1 1\nmap_Kd ../images/texture0.png\n"


def make(root, synset, count):
    for number in range(count):
        model = root / synset / f"{number:04x}ab"
        (model / "models").mkdir(parents=True)
        (model / "images").mkdir()
        (model / "models" / "model_normalized.obj").write_text(OBJ)
        (model / "models" / "model_normalized.mtl").write_text(MTL)
        pixels = np.zeros((4, 4, 3), np.uint8)
        pixels[..., 2] = 200
        Image.fromarray(pixels).save(model / "images" / "texture0.png")
    return root


def test_the_table_has_the_synsets_that_the_paper_needs():
    assert len(SYNSETS) == 55
    assert len(set(SYNSETS.values())) == 55
    # Written down independently from the specification of the data.
    needed = {
        "airplane": "02691156", "bed": "02818832", "bottle": "02876657", "bowl": "02880940",
        "chair": "03001627", "clock": "03046257", "file_cabinet": "03337140", "guitar": "03467517",
    }  # fmt: skip
    assert set(needed) == set(PAPER_CLASSES)
    assert needed.items() <= SYNSETS.items()


def test_items_have_no_split_and_the_frame_is_y_up(tmp_path):
    make(tmp_path, SYNSETS["bed"], 3)
    source = ShapeNet55(tmp_path)
    items = source.items(["bed"])
    assert [item.split for item in items] == [None] * 3
    assert len({item.group for item in items}) == 3
    assert source.up_axis == "y"
    assert items == ShapeNet55(tmp_path).items(["02818832"])


def test_materials_and_textures_in_the_images_folder_are_read(tmp_path):
    make(tmp_path, SYNSETS["bed"], 1)
    source = ShapeNet55(tmp_path)
    parts = mesh_parts(source.load(source.items(["bed"])[0]))
    assert len(parts) == 2
    colours = {tuple(part.visual.material.diffuse[:3]) for part in parts}
    assert (255, 0, 0) in colours
    pictures = [p.visual.material.image for p in parts if p.visual.material.image is not None]
    assert [picture.convert("RGB").getpixel((0, 0)) for picture in pictures] == [(0, 0, 200)]


def test_the_cap_is_random_reproducible_and_only_where_asked(tmp_path):
    make(tmp_path, SYNSETS["chair"], 12)
    make(tmp_path, SYNSETS["bed"], 12)

    def chosen(**settings):
        return [i.instance_id for i in ShapeNet55(tmp_path, **settings).items(["chair"])]

    everything = chosen()
    assert len(everything) == 12
    kept = chosen(max_instances={"chair": 5}, seed=1)
    assert kept == chosen(max_instances={"chair": 5}, seed=1)
    assert len(kept) == 5
    assert set(kept) < set(everything)
    assert kept != everything[:5]
    assert kept != chosen(max_instances={"chair": 5}, seed=2)
    assert set(kept) < set(chosen(max_instances={"chair": 6}, seed=1))
    assert len(ShapeNet55(tmp_path, max_instances={"chair": 5}).items(["bed"])) == 12
    assert ShapeNet55().max_instances == {"chair": 1000, "airplane": 1000}


def test_taxonomy_adds_synonyms_and_further_synsets(tmp_path):
    make(tmp_path, SYNSETS["airplane"], 1)
    make(tmp_path, "02858304", 1)
    make(tmp_path, "01234567", 1)
    entries = [
        {"synsetId": "02691156", "name": "airplane,aeroplane,plane", "children": []},
        {"synsetId": "02858304", "name": "boat,small boat", "children": []},
    ]
    (tmp_path / "taxonomy.json").write_text(json.dumps(entries))
    source = ShapeNet55(tmp_path)
    assert len(source.classes) == 57
    assert source.items(["aeroplane"])[0].class_name == "airplane"
    assert source.items(["small boat"])[0].class_name == "boat"
    assert source.items(["01234567"])[0].class_name == "01234567"
    (tmp_path / "taxonomy.json").write_text("{broken")
    with pytest.raises(DatasetNotFoundError, match="taxonomy"):
        ShapeNet55(tmp_path)


def test_what_is_missing_is_explained_and_nothing_pretends_to_download(tmp_path):
    for root in (None, tmp_path / "no", tmp_path):
        with pytest.raises(DatasetNotFoundError, match=r"register at https://shapenet\.org") as e:
            ShapeNet55(root).items(["bed"])
        assert "huggingface.co/ShapeNet" in str(e.value)
        assert "i2i.download" not in str(e.value)
    make(tmp_path / "ShapeNetCore.v2", SYNSETS["bed"], 1)
    with pytest.raises(DatasetNotFoundError, match=r"deeper: data\.root=.*ShapeNetCore\.v2"):
        ShapeNet55(tmp_path).items(["bed"])
    with pytest.raises(DatasetNotFoundError, match="03467517"):
        ShapeNet55(tmp_path / "ShapeNetCore.v2").items(["guitar"])
    with pytest.raises(ValueError, match="file_cabinet"):
        ShapeNet55(tmp_path).items(["spaceship"])


def test_a_broken_model_is_named(tmp_path):
    make(tmp_path, SYNSETS["bed"], 1)
    source = ShapeNet55(tmp_path)
    item = source.items(["bed"])[0]
    with open(item.ref, "w") as stream:
        stream.write("v 0 0 0\n")
    with pytest.raises(MeshError, match="0000ab"):
        source.load(item)
