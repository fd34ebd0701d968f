import functools
import io
import os
import tarfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from i2i.data.download import download_dataset, download_modelnet40
from i2i.data.sources.modelnet40 import TRAIN_COUNTS, ModelNet40
from i2i.errors import DownloadError

TRIANGLE = b"OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


@pytest.fixture
def served(tmp_path):
    """A folder and the address under which its files can be fetched."""
    folder = tmp_path / "served"
    folder.mkdir()
    handler = functools.partial(SimpleHTTPRequestHandler, directory=folder)
    handler.log_message = lambda *args: None
    http = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=http.serve_forever, daemon=True).start()
    yield folder, f"http://127.0.0.1:{http.server_port}"
    http.shutdown()
    http.server_close()


def pack(
    path, classes, *, top="modelnet40_manually_aligned/", mesh=TRIANGLE, splits=("train", "test")
):
    with tarfile.open(path, "w") as archive:
        for name in classes:
            for split in splits:
                info = tarfile.TarInfo(f"{top}{name}/{split}/{name}_0001.off")
                info.size = len(mesh)
                archive.addfile(info, io.BytesIO(mesh))


@pytest.mark.parametrize("top", ["", "modelnet40_manually_aligned/"])
def test_modelnet40_arrives_with_its_marker(served, tmp_path, top, caplog):
    folder, url = served
    pack(folder / "modelnet40_manually_aligned.tar", TRAIN_COUNTS, top=top)
    root = tmp_path / "data" / "modelnet40"
    address = f"{url}/modelnet40_manually_aligned.tar"
    assert download_dataset("modelnet40", root, urls=[address], progress=False) == root
    assert "desk has 1 training meshes, officially 200" in caplog.text
    caplog.clear()
    assert len(ModelNet40(root).items(["desk"])) == 2
    assert "aligned" not in caplog.text  # the marker says so
    assert os.listdir(root.parent) == ["modelnet40"]
    (folder / "modelnet40_manually_aligned.tar").unlink()
    assert download_modelnet40(root, urls=[address], progress=False) == root  # nothing to do


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"classes": ["desk", "chair"]}, "no folder for 38 of the 40"),
        ({"splits": ("train",)}, "airplane"),
        ({"mesh": b"OFF\n3 1 0\n0 0 0\n"}, "damaged meshes.*truncated"),
    ],
)
def test_another_or_a_damaged_archive_is_refused(served, tmp_path, settings, message):
    folder, url = served
    pack(folder / "x.tar", settings.pop("classes", TRAIN_COUNTS), **settings)
    with pytest.raises(DownloadError, match=message):
        download_modelnet40(tmp_path / "data", urls=[f"{url}/x.tar"], progress=False)
    assert not (tmp_path / "data").exists()


def test_the_archive_that_is_not_aligned_and_foreign_folders_are_refused(tmp_path):
    with pytest.raises(DownloadError, match="not aligned"):
        download_modelnet40(tmp_path / "a", urls=["http://127.0.0.1:9/ModelNet40.zip"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(DownloadError, match=r"data\.root"):
        download_modelnet40(tmp_path / "mine")
    assert os.listdir(tmp_path / "mine") == ["thesis.tex"]


def test_what_cannot_be_downloaded_says_what_to_do(tmp_path):
    with pytest.raises(DownloadError, match=r"https://shapenet\.org"):
        download_dataset("shapenet55", tmp_path / "x")
    with pytest.raises(DownloadError, match="apt-get"):
        download_dataset("sweethome", tmp_path / "x")
    with pytest.raises(DownloadError, match="built in"):
        download_dataset("synthetic", None)
    with pytest.raises(DownloadError, match="known: modelnet40"):
        download_dataset("imagenet", tmp_path / "x")
    with pytest.raises(DownloadError, match=r"data\.root"):
        download_dataset("modelnet40", None)
