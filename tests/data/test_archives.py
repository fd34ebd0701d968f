import io
import os
import tarfile
import zipfile

import pytest

from i2i.data.archives import unpack
from i2i.errors import DownloadError

FILES = {"a/one.off": b"1" * 5000, "a/b/two.off": b"", "three.txt": b"three"}


def make_tar(path, files=FILES, *, mode="w", extra=()):
    with tarfile.open(path, mode) as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
        for info in extra:
            archive.addfile(info)
    return path


def make_zip(path, files=FILES):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def content(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", ["w", "w:gz", "w:xz", "zip"])
def test_everything_arrives(tmp_path, kind):
    archive = tmp_path / "x"
    make_zip(archive) if kind == "zip" else make_tar(archive, mode=kind)
    folder = unpack(archive, tmp_path / "out", progress=False)
    assert content(folder) == FILES
    assert sorted(os.listdir(tmp_path)) == ["out", "x"]


def link(name, target, kind=tarfile.SYMTYPE):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


@pytest.mark.parametrize(
    "member",
    [
        link("a/link", "../../outside"),
        link("a/hard", "/etc/passwd", tarfile.LNKTYPE),
        link("pipe", "", tarfile.FIFOTYPE),
        link("device", "", tarfile.CHRTYPE),
    ],
)
def test_links_and_devices_of_a_tar_are_refused(tmp_path, member):
    make_tar(tmp_path / "x.tar", extra=[member])
    with pytest.raises(DownloadError, match=f"{member.name}.*nothing was unpacked"):
        unpack(tmp_path / "x.tar", tmp_path / "out", progress=False)
    assert os.listdir(tmp_path) == ["x.tar"]


@pytest.mark.parametrize("name", ["../evil", "a/../../evil", "/evil", "C:\\evil", "..\\evil"])
@pytest.mark.parametrize("make", [make_tar, make_zip])
def test_paths_that_lead_out_are_refused(tmp_path, name, make):
    inner = tmp_path / "inner"
    inner.mkdir()
    make(inner / "x", {"fine": b"1", name: b"2"})
    with pytest.raises(DownloadError, match="leads out"):
        unpack(inner / "x", inner / "out", progress=False)
    assert [p.name for p in tmp_path.rglob("*")] == ["inner", "x"]


def test_a_link_in_a_zip_is_refused(tmp_path):
    info = zipfile.ZipInfo("link")
    info.create_system, info.external_attr = 3, 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(DownloadError, match="link"):
        unpack(tmp_path / "x.zip", tmp_path / "out", progress=False)


@pytest.mark.parametrize("kind", ["w", "w:gz", "zip"])
def test_damaged_archives_leave_nothing(tmp_path, kind):
    archive = tmp_path / "x"
    files = {"big.off": os.urandom(200_000), "other.off": os.urandom(200_000)}
    make_zip(archive, files) if kind == "zip" else make_tar(archive, files, mode=kind)
    archive.write_bytes(archive.read_bytes()[:250_000])
    with pytest.raises(DownloadError, match="x "):
        unpack(archive, tmp_path / "out", progress=False)
    assert os.listdir(tmp_path) == ["x"]


def test_what_is_no_archive_or_already_there(tmp_path):
    (tmp_path / "x").write_text("hello")
    with pytest.raises(DownloadError, match="neither a tar nor a zip"):
        unpack(tmp_path / "x", tmp_path / "out", progress=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(DownloadError, match="already there"):
        unpack(make_tar(tmp_path / "t"), tmp_path / "full", progress=False)
    assert os.listdir(tmp_path / "full") == ["mine"]


def test_the_rest_of_an_interrupted_call_is_replaced_and_a_check_decides(tmp_path):
    (tmp_path / "out.part" / "old").mkdir(parents=True)
    make_tar(tmp_path / "t")

    def refuse(folder):
        raise DownloadError("not what was wanted")

    with pytest.raises(DownloadError, match="wanted"):
        unpack(tmp_path / "t", tmp_path / "out", check=refuse, progress=False)
    assert os.listdir(tmp_path) == ["t"]
    folder = unpack(tmp_path / "t", tmp_path / "out", check=lambda f: f / "a", progress=False)
    assert content(folder) == {"one.off": FILES["a/one.off"], "b/two.off": b""}
