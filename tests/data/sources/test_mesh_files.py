import numpy as np
import pytest
import trimesh

from i2i.data.sources.mesh_files import MESH_SUFFIXES, mesh_parts, read_mesh
from i2i.errors import MeshError

TETRAHEDRON = "OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"


def write(path, text):
    path.write_text(text)
    return path


def test_a_header_without_its_line_break_gives_the_same_mesh(tmp_path):
    plain = read_mesh(write(tmp_path / "a.off", TETRAHEDRON))
    joined = read_mesh(write(tmp_path / "b.off", TETRAHEDRON.replace("OFF\n", "OFF")))
    np.testing.assert_array_equal(plain.vertices, joined.vertices)
    np.testing.assert_array_equal(plain.faces, joined.faces)
    assert plain.volume == pytest.approx(1 / 6) or abs(plain.volume) < 1


def test_comments_blank_lines_and_polygons_are_read(tmp_path):
    text = "OFF # cube side\n# a remark\n\n4 1 0\n0 0 0\n2 0 0\n\n2 2 0\n0 2 0\n4 0 1 2 3\n"
    assert read_mesh(write(tmp_path / "quad.off", text)).area == pytest.approx(4.0)


@pytest.mark.parametrize("keep_lines", [3, 5, 7, 9])
def test_a_truncated_off_is_refused_by_name(tmp_path, keep_lines):
    cut = "\n".join(TETRAHEDRON.splitlines()[:keep_lines]) + "\n"
    with pytest.raises(MeshError, match=r"cut\.off.*truncated"):
        read_mesh(write(tmp_path / "cut.off", cut))


def test_an_off_that_ends_within_a_face_is_refused(tmp_path):
    with pytest.raises(MeshError, match="incomplete"):
        read_mesh(write(tmp_path / "cut.off", TETRAHEDRON.rstrip()[:-2]))


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, word):
    with pytest.raises(MeshError, match=r"bad\.off.*not finite"):
        read_mesh(write(tmp_path / "bad.off", TETRAHEDRON.replace("0 0 1\n", f"0 0 {word}\n", 1)))


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_empty_and_foreign_files_are_refused_in_every_format(tmp_path, suffix):
    with pytest.raises(MeshError, match="empty"):
        read_mesh(write(tmp_path / f"none{suffix}", "  \n"))
    with pytest.raises(MeshError, match=f"letter{suffix}"):
        read_mesh(write(tmp_path / f"letter{suffix}", "Dear reader,\nthis is no mesh.\n"))


@pytest.mark.parametrize("suffix", [s for s in MESH_SUFFIXES if s != ".gltf"])
def test_every_format_is_read_and_its_half_refused(tmp_path, suffix):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path / f"sphere{suffix}"
    sphere.export(path)
    loaded = read_mesh(path)
    assert sum(part.area for part in mesh_parts(loaded)) == pytest.approx(sphere.area, rel=1e-5)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    if suffix == ".obj":  # a third of it is vertices only
        with pytest.raises(MeshError, match="no faces"):
            read_mesh(path)
    else:
        with pytest.raises(MeshError, match="sphere"):
            read_mesh(path)


def test_missing_files_points_only_and_other_suffixes(tmp_path):
    with pytest.raises(MeshError, match="cannot be read"):
        read_mesh(tmp_path / "gone.off")
    with pytest.raises(MeshError, match=r"\.off, \.obj"):
        read_mesh(write(tmp_path / "picture.png", "x"))
    with pytest.raises(MeshError, match="no faces"):
        read_mesh(write(tmp_path / "points.off", "OFF\n2 0 0\n0 0 0\n1 1 1\n"))
    with pytest.raises(MeshError, match=r"wild\.off"):
        read_mesh(write(tmp_path / "wild.off", TETRAHEDRON.replace("3 1 2 3", "3 1 2 9")))
