import hashlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import namedtuple
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

import i2i.data.transfer
from i2i.data.transfer import fetch
from i2i.errors import DownloadError

BODY = np.random.default_rng(0).integers(0, 256, 1_500_000, dtype=np.uint8).tobytes()
SHA = "sha256:" + hashlib.sha256(BODY).hexdigest()


class Server:
    """A loopback server whose behaviour is a set of switches; it notes what it was asked."""

    def __init__(self):
        self.body, self.etag, self.content_type = BODY, '"v1"', "application/x-tar"
        self.ignore_range = False
        self.cut_after = []  # bytes after which the next answers break off
        self.status = []  # the next answers' status instead of the file
        self.claimed_length = None
        self.go_on = threading.Event()  # until it is set, answers stop after 600,000 bytes
        self.go_on.set()
        self.ranges = []
        owner = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                owner.answer(self)

            def log_message(self, *args):
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.http.server_port}/set.tar"
        threading.Thread(target=self.http.serve_forever, daemon=True).start()

    def answer(self, request):
        asked = request.headers.get("Range")
        self.ranges.append(asked)
        if self.status:
            request.send_error(self.status.pop(0))
            return
        start = 0
        fits = request.headers.get("If-Range") in (None, self.etag)
        if asked and not self.ignore_range and fits:
            start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1])
            if start >= len(self.body):
                request.send_response(416)
                request.send_header("Content-Range", f"bytes */{len(self.body)}")
                request.send_header("Content-Length", "0")
                request.end_headers()
                return
        data = self.body[start:]
        request.send_response(206 if start else 200)
        if start:
            end = len(self.body)
            request.send_header("Content-Range", f"bytes {start}-{end - 1}/{end}")
        request.send_header("Content-Type", self.content_type)
        request.send_header("Content-Length", str(self.claimed_length or len(data)))
        if self.etag:
            request.send_header("ETag", self.etag)
        request.end_headers()
        if self.cut_after:
            data = data[: self.cut_after.pop(0)]
        try:
            for piece in range(0, len(data), 100_000):
                if piece >= 600_000:
                    self.go_on.wait()
                request.wfile.write(data[piece : piece + 100_000])
        except OSError:
            pass
        request.close_connection = True


@pytest.fixture
def server():
    server = Server()
    yield server
    server.http.shutdown()
    server.http.server_close()


def get(server, path, **settings):
    urls = settings.pop("urls", [server.url])
    return fetch(
        urls, path, **{"retry_wait_s": 0.0, "progress": False, "timeout_s": 10, **settings}
    )


def test_a_plain_transfer_leaves_only_the_file(server, tmp_path):
    path = get(server, tmp_path / "new" / "set.tar", size=len(BODY), checksum=SHA)
    assert path.read_bytes() == BODY
    assert os.listdir(tmp_path / "new") == ["set.tar"]
    get(server, path, checksum=SHA)
    assert len(server.ranges) == 1  # a whole file is not asked for again


def test_a_broken_transfer_is_continued_where_it_broke(server, tmp_path):
    server.cut_after = [400_000, 300_000]
    assert get(server, tmp_path / "set.tar").read_bytes() == BODY
    assert server.ranges == [None, "bytes=400000-", "bytes=700000-"]


def test_a_server_that_ignores_ranges_is_started_again(server, tmp_path):
    server.cut_after, server.ignore_range = [400_000], True
    assert get(server, tmp_path / "set.tar").read_bytes() == BODY


def test_a_file_that_changed_meanwhile_is_not_mixed(server, tmp_path):
    server.cut_after = [400_000]
    with pytest.raises(DownloadError):
        get(server, tmp_path / "set.tar", retries=0)
    assert (tmp_path / "set.tar.part").stat().st_size == 400_000
    server.body, server.etag = BODY[::-1], '"v2"'
    assert get(server, tmp_path / "set.tar").read_bytes() == BODY[::-1]


@pytest.mark.parametrize("new", [BODY[::-1] + b"x", BODY[::-1]])
def test_without_a_validator_size_or_checksum_guards(server, tmp_path, new):
    server.cut_after, server.etag = [400_000], ""
    with pytest.raises(DownloadError):
        get(server, tmp_path / "set.tar", retries=0)
    server.body = new
    checksum = "md5:" + hashlib.md5(new).hexdigest()
    assert get(server, tmp_path / "set.tar", checksum=checksum).read_bytes() == new


def test_a_part_of_unknown_origin_is_not_trusted(server, tmp_path):
    (tmp_path / "set.tar.part").write_bytes(b"rubbish" * 1000)
    assert get(server, tmp_path / "set.tar").read_bytes() == BODY
    assert server.ranges == [None]


def test_a_part_that_was_already_whole_is_taken(server, tmp_path):
    server.cut_after = [400_000]
    with pytest.raises(DownloadError):
        get(server, tmp_path / "set.tar", retries=0)
    (tmp_path / "set.tar.part").write_bytes(BODY)
    assert get(server, tmp_path / "set.tar").read_bytes() == BODY
    assert server.ranges[-1] == f"bytes={len(BODY)}-"


@pytest.mark.parametrize("declared", ["text/html; charset=utf-8", "application/octet-stream"])
def test_a_web_page_is_refused(server, tmp_path, declared):
    server.content_type = declared
    server.body = b"\n<!DOCTYPE html><html><body>Please log in</body></html>"
    with pytest.raises(DownloadError, match="web page"):
        get(server, tmp_path / "set.tar")
    assert not (tmp_path / "set.tar").exists()


def test_wrong_sizes_and_checksums_are_refused(server, tmp_path):
    with pytest.raises(DownloadError, match=f"has {len(BODY)} bytes, 5 were expected"):
        get(server, tmp_path / "set.tar", size=5)
    wrong = "sha256:" + "0" * 64
    with pytest.raises(DownloadError, match=SHA.partition(":")[2]):
        get(server, tmp_path / "set.tar", checksum=wrong)
    server.claimed_length = len(BODY) + 10
    with pytest.raises(DownloadError, match="broke after"):
        get(server, tmp_path / "set.tar", retries=0)
    assert not (tmp_path / "set.tar").exists()


def test_a_damaged_part_is_fetched_once_more(server, tmp_path):
    server.cut_after = [400_000]
    with pytest.raises(DownloadError):
        get(server, tmp_path / "set.tar", retries=0)
    (tmp_path / "set.tar.part").write_bytes(bytes(400_000))
    assert get(server, tmp_path / "set.tar", checksum=SHA).read_bytes() == BODY


def test_busy_servers_are_asked_again_and_gone_files_are_not(server, tmp_path):
    server.status = [503, 500]
    assert get(server, tmp_path / "a.tar").read_bytes() == BODY
    server.status, server.ranges = [404, 404], []
    with pytest.raises(DownloadError, match="404") as error:
        get(server, tmp_path / "b.tar")
    assert str(tmp_path / "b.tar") in str(error.value)  # says where to put it by hand
    assert len(server.ranges) == 1


def test_the_next_mirror_is_used(server, tmp_path):
    other = Server()
    try:
        other.status = [404]
        assert get(server, tmp_path / "a.tar", urls=[other.url, server.url]).read_bytes() == BODY
        closed = "http://127.0.0.1:9/none"
        path = get(server, tmp_path / "b.tar", urls=[closed, server.url], retries=1)
        assert path.read_bytes() == BODY
    finally:
        other.http.shutdown()
        other.http.server_close()


def test_a_full_disk_is_told_before_and_during(server, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(
        i2i.data.transfer.shutil, "disk_usage", lambda path: usage(10**9, 10**9, 1000)
    )
    with pytest.raises(DownloadError, match="GB free"):
        get(server, tmp_path / "set.tar")
    monkeypatch.undo()

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(i2i.data.transfer, "_check_space", full)
    with pytest.raises(DownloadError, match=r"full.*continue"):
        get(server, tmp_path / "set.tar")


def test_addresses_and_checksums_of_unknown_kinds(tmp_path):
    with pytest.raises(ValueError, match="http"):
        fetch(["file:///etc/passwd"], tmp_path / "x")
    with pytest.raises(ValueError, match="sha256"):
        fetch(["http://x/y"], tmp_path / "x", checksum="crc32:1")
    with pytest.raises(ValueError, match="address"):
        fetch([], tmp_path / "x")


def test_a_killed_process_is_continued_to_the_same_bytes(server, tmp_path):
    server.go_on.clear()
    target = tmp_path / "set.tar"
    call = f"fetch([{server.url!r}], {str(target)!r}, progress=False)"
    code = f"from i2i.data.transfer import fetch; {call}"
    process = subprocess.Popen([sys.executable, "-c", code])
    part = tmp_path / "set.tar.part"
    while process.poll() is None and not (part.is_file() and part.stat().st_size > 0):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not target.exists()
    left = part.stat().st_size
    assert 0 < left < len(BODY)
    server.go_on.set()
    server.ranges = []
    assert get(server, target).read_bytes() == BODY
    assert server.ranges == [f"bytes={left}-"]
