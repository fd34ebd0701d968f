import io
import pickle
import zipfile

import numpy as np
import pytest
import trimesh
from PIL import Image

from i2i.data.sources.mesh_files import mesh_parts
from i2i.data.sources.sweethome import DEBIAN_ROOT, SweetHome, parse_properties, read_catalogue
from i2i.data.sources.sweethome_classes import YAW_DEG, class_of
from i2i.errors import DatasetNotFoundError, MeshError

# An arrow from the origin: its tip tells where a rotation takes it.
OBJ = "mtllib a.mtl\nv 0 0 0\nv {} 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
MTL = "newmtl m\nKd 1 1 1\nmap_Kd Wood.PNG\n"


def png():
    stream = io.BytesIO()
    Image.new("RGB", (2, 2), (10, 200, 30)).save(stream, "png")
    return stream.getvalue()


def make_library(path, items, *, licence="CC BY 3.0"):
    """Write a furniture library of (name, creator, length, extra lines) items."""
    text = ["# a remark", "id=test", f"license={licence}"]
    with zipfile.ZipFile(path, "w") as archive:
        for number, (name, creator, length, *extra) in enumerate(items, 1):
            model = f"lib/item{number}/item{number}.obj"
            text += [f"name#{number}={name}", f"creator#{number}={creator}"]
            text += [f"model#{number}=/{model}", f"category#{number}=Living room"]
            text += [line.format(n=number) for line in extra]
            archive.writestr(model, OBJ.format(length))
            archive.writestr(f"lib/item{number}/a.mtl", MTL)
            archive.writestr(f"lib/item{number}/wood.png", png())
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(text).encode("iso-8859-1"))
    return path


@pytest.mark.parametrize(
    ("line", "entry"),
    [
        (b"name#1=Chair", {"name#1": "Chair"}),
        (b"  key : value ", {"key": "value"}),
        (b"key value", {"key": "value"}),
        (b"key=a=b", {"key": "a=b"}),
        (b"k\\=x=1", {"k=x": "1"}),
        (b"k=caf\xe9 \\u00e9", {"k": "café é"}),
        (b"k=one \\\r\n   two", {"k": "one two"}),
        (b"k=C:\\\\x\\ty", {"k": "C:\\x\ty"}),
        (b"# no=thing\n! no=thing\n\n", {}),
    ],
)
def test_java_properties(line, entry):
    assert parse_properties(line) == entry


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Chair", "chair"), ("Winchester armchair", "chair"), ("Deck chair", "chair"),
        ("Wheelchair", None), ("Baby high chair", None), ("Armchair ottoman", None),
        ("Table and chairs", None), ("Coffee table", "table"), ("Table fan", None),
        ("Bedside table", None), ("Table tennis bat", None), ("Tablet", None),
        ("Desk lamp", None), ("Wooden desk", "desk"), ("Corner sofa", "sofa"),
        ("Opened convertible sofa BZ", None), ("Bunk bed", "bed"), ("Mezzanine bed", None),
        ("Filing cabinet", "cabinet"), ("Upper corner cabinet", None), ("Cupboard", "cabinet"),
        ("Embedded oven", None), ("Bathtub", None),
    ],
)  # fmt: skip
def test_classes_come_from_the_words_of_the_name(name, expected):
    assert class_of("any/model", name) == expected


def test_items_carry_licence_author_and_pickle(tmp_path):
    make_library(
        tmp_path / "a.sh3f",
        [("Chair", "Ann", 1), ("Chair", "Bob", 2, "license#{n}=CC0"), ("Lamp", "Bob", 3)],
    )
    items = SweetHome(tmp_path).items(["chair"])
    assert [(i.author, i.licence) for i in items] == [("Ann", "CC BY 3.0"), ("Bob", "CC0")]
    assert [i.split for i in items] == [None, None]
    assert pickle.loads(pickle.dumps(items)) == items
    assert len(pickle.loads(pickle.dumps(SweetHome(tmp_path))).items(["chair"])) == 2


def test_near_duplicates_share_a_group(tmp_path):
    make_library(
        tmp_path / "a.sh3f",
        [
            ("Red chair 2", "Ann", 1), ("Chair", "Ann", 2),  # one author, one design
            ("Chair", "Bob", 3), ("Stacking chair", "Cid", 3),  # exactly the same geometry
            ("Stacking chair", "Dan", 4),
        ],
    )  # fmt: skip
    groups = [item.group for item in SweetHome(tmp_path).items(["chair"])]
    assert groups[0] == groups[1]
    assert groups[2] == groups[3]
    assert len(set(groups)) == 3


def test_the_catalogue_rotation_is_row_major_and_applied(tmp_path):
    turn = "modelRotation#{n}=0 0 1 0 1 0 -1 0 0"  # takes +x to −z
    make_library(tmp_path / "a.sh3f", [("Chair", "Ann", 2), ("Chair", "Bob", 2, turn)])
    source = SweetHome(tmp_path)
    plain, turned = (source.load(item) for item in source.items(["chair"]))
    np.testing.assert_allclose(plain.bounds, [[0, 0, 0], [2, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(turned.bounds, [[0, 0, -2], [0, 1, 0]], atol=1e-12)
    assert source.up_axis == "y"


def test_textures_are_found_whatever_their_case(tmp_path):
    make_library(tmp_path / "a.sh3f", [("Chair", "Ann", 2)])
    source = SweetHome(tmp_path)
    (part,) = mesh_parts(source.load(source.items(["chair"])[0]))
    assert part.visual.material.image.convert("RGB").getpixel((0, 0)) == (10, 200, 30)


def test_a_correction_turns_about_the_vertical(tmp_path, monkeypatch):
    make_library(tmp_path / "a.sh3f", [("Chair", "Ann", 2)])
    source = SweetHome(tmp_path)
    item = source.items(["chair"])[0]
    monkeypatch.setitem(YAW_DEG, "a/item1", 90.0)
    np.testing.assert_allclose(source.load(item).bounds, [[0, 0, -2], [0, 1, 0]], atol=1e-12)


def test_what_is_missing_or_broken_is_named(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="apt-get install sweethome3d-furniture"):
        SweetHome(tmp_path / "no").items(["chair"])
    with pytest.raises(ValueError, match="bed, cabinet, chair"):
        SweetHome(tmp_path).items(["spaceship"])
    (tmp_path / "b.sh3f").write_bytes(b"not a zip")
    with pytest.raises(DatasetNotFoundError, match=r"b\.sh3f is not a Sweet Home"):
        SweetHome(tmp_path).items(["chair"])
    (tmp_path / "b.sh3f").unlink()
    make_library(
        tmp_path / "a.sh3f",
        [("Chair", "Ann", "nan"), ("Chair", "Bob", 1, "modelRotation#{n}=1 0 0 0 1 0 0 0 5")],
    )
    source = SweetHome(tmp_path)
    broken, skewed = source.items(["chair"])
    with pytest.raises(MeshError, match=r"item1\.obj.*not finite"):
        source.load(broken)
    with pytest.raises(MeshError, match=r"item2\.obj.*modelRotation"):
        source.load(skewed)


@pytest.mark.skipif(not any(DEBIAN_ROOT.glob("*.sh3f")), reason="sweethome3d-furniture is missing")
class TestDebianLibraries:
    def test_counts_groups_and_authors(self):
        source = SweetHome()
        counts = {name: len(source.items([name])) for name in source.classes}
        # Read off the catalogues of version 1.8 by hand; another version may only have more.
        least = {"bed": 13, "cabinet": 20, "chair": 54, "desk": 8, "sofa": 22, "table": 36}
        assert all(counts[name] >= number for name, number in least.items())
        items = source.items(source.classes)
        assert all(item.licence and item.author for item in items)
        assert len({(item.class_name, item.instance_id) for item in items}) == len(items)
        assert len({item.group for item in source.items(["chair"])}) >= 40

    def test_the_corrected_items_exist(self):
        keys = {e.key for path in sorted(DEBIAN_ROOT.glob("*.sh3f")) for e in read_catalogue(path)}
        assert set(YAW_DEG) <= keys

    def test_backs_of_chairs_are_at_the_back(self):
        """The upper third of a chair is its back: it lies at −z, behind the seat's middle."""
        source = SweetHome()
        wrong = []
        for item in source.items(["chair"])[::3]:
            mesh = source.load(item)
            mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
            points, _ = trimesh.sample.sample_surface(mesh, 4000, seed=0)
            low, high = mesh.bounds
            depth = points[points[:, 1] > low[1] + 0.75 * (high[1] - low[1]), 2].mean()
            if depth >= 0.5 * (low[2] + high[2]):
                wrong.append(item.instance_id)
        assert not wrong
