"""Meshes that the renderers are held to: primitives always, real furniture if installed."""

from __future__ import annotations

import tempfile
import zipfile
from pathlib import Path

import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2i.rendering import RenderMesh, get_renderer, prepare_mesh

FURNITURE = Path("/usr/share/sweethome3d/furniture")
# Library and model, with thin legs, slats, textures, several materials, few and many faces.
REAL_MODELS = (
    ("BlendSwap-CC-0", "blendswap-cc-0/antiqueChair/antiqueChair.obj"),
    ("BlendSwap-CC-BY", "blendswap-cc-by/officeTable/officeTable.obj"),
    ("BlendSwap-CC-BY", "blendswap-cc-by/chair_deck/chair_deck.obj"),
    ("KatorLegaz", "katorlegaz/mid-century-chair/mid-century-chair.obj"),
    ("KatorLegaz", "katorlegaz/cafe-chair/cafe-chair.obj"),
    ("KatorLegaz", "katorlegaz/cafe-table/cafe-table.obj"),
    ("Scopia", "scopia/chair4/chair4.obj"),
    ("Scopia", "scopia/armchair1/armchair1.obj"),
    ("Scopia", "scopia/table3/table3.obj"),
)


@pytest.fixture(scope="session")
def embree():
    return get_renderer("embree")


@pytest.fixture(params=["embree", "pyrender"])
def renderer(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def rotations():
    return Rotation.random(4, random_state=7).as_matrix()


@pytest.fixture(scope="session")
def wedge() -> RenderMesh:
    """No symmetry at all: a slab, a tall post in one corner, a ball in another."""
    slab = trimesh.creation.box(extents=(2.0, 1.2, 0.3))
    post = trimesh.creation.box(extents=(0.3, 0.3, 1.4))
    post.apply_translation((-0.8, -0.4, 0.7))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    ball.apply_translation((0.6, 0.2, 0.4))
    return prepare_mesh(trimesh.util.concatenate([slab, post, ball]))


@pytest.fixture(scope="session", params=REAL_MODELS, ids=lambda model: Path(model[1]).stem)
def real_mesh(request) -> RenderMesh:
    library, member = request.param
    archive = FURNITURE / f"{library}.sh3f"
    if not archive.is_file():
        pytest.skip(f"{archive} is missing: apt-get install sweethome3d-furniture")
    folder = member.rsplit("/", 1)[0] + "/"
    with zipfile.ZipFile(archive) as bundle, tempfile.TemporaryDirectory() as target:
        bundle.extractall(target, [n for n in bundle.namelist() if n.startswith(folder)])
        return prepare_mesh(trimesh.load(Path(target) / member), up_axis="y")
