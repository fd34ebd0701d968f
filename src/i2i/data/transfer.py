"""Fetching one large file over HTTP: continues broken transfers, refuses what is not the file."""

from __future__ import annotations

import errno
import hashlib
import http.client
import json
import logging
import os
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from i2i.errors import DownloadError

log = logging.getLogger(__name__)

_CHUNK = 1 << 18  # bytes between two looks at the progress bar
_SPARE = 64 << 20  # bytes of disk that a transfer leaves free
_RETRIED_STATUS = (408, 425, 429, 500, 502, 503, 504)


@dataclass(frozen=True)
class _PartInfo:
    """What is known about a part on disk: enough to ask the server for the rest of the same file.

    Attributes:
        url: Where the part came from.
        validator: Strong ETag, or date of the last change, or empty.
        total: Size of the whole file in bytes, if the server told it.
    """

    url: str
    validator: str
    total: int | None


class _WrongContentError(DownloadError):
    """This address does not have the file; another one may."""


def fetch(
    urls: Sequence[str],
    target: str | Path,
    *,
    size: int | None = None,
    checksum: str | None = None,
    retries: int = 5,
    retry_wait_s: float = 1.0,
    timeout_s: float = 30.0,
    progress: bool = True,
) -> Path:
    """Fetch a file from the first address that has it.

    Bytes go to ``<target>.part``; only a whole and verified file gets the name ``target``. A part
    left by an earlier call, even a killed one, is continued where the server allows it.

    Args:
        urls: Mirrors, best first; http or https.
        target: Where the file goes.
        size: Expected size in bytes, if known.
        checksum: ``"sha256:<hex>"`` or ``"md5:<hex>"``, if known.
        retries: Attempts in a row, without a new byte, that may fail on one mirror.
        retry_wait_s: Seconds before the first retry; doubled each time.
        timeout_s: Seconds without an answer after which an attempt has failed.
        progress: Draw a progress bar with the remaining time.

    Returns:
        ``target``.

    Raises:
        DownloadError: No mirror has the file, or the disk is full.
        ValueError: An address or a checksum of an unknown kind.
    """
    target = Path(target)
    _check_arguments(urls, checksum)
    if target.is_file() and _is_whole(target, size, checksum):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    reasons = []
    with _progress_bar(progress) as bar:
        for url in urls:
            try:
                attempt = _Attempt(url, target, size, checksum, timeout_s, bar)
                _fetch_with_retries(attempt, retries, retry_wait_s)
                return target
            except _WrongContentError as error:
                reasons.append(f"{url}: {error}")
                log.warning("%s: %s", url, error)
    raise DownloadError(
        f"{target.name} could not be downloaded.\n  " + "\n  ".join(reasons) + "\n"
        f"Run the command again to continue, set another address, or put the file at {target} "
        "by hand."
    )


def file_digest(path: Path, algorithm: str) -> str:
    """Return the hexadecimal digest of a file, read in pieces."""
    digest = hashlib.new(algorithm)
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _fetch_with_retries(attempt: _Attempt, retries: int, retry_wait_s: float) -> None:
    """Repeat an attempt while the connection fails; new bytes reset the count."""
    failures = 0
    while True:
        before = attempt.bytes_on_disk()
        try:
            attempt.run()
            return
        except _WrongContentError:
            raise
        except (OSError, http.client.HTTPException) as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise DownloadError(
                    f"the disk of {attempt.part.parent} is full; free some space and run the "
                    "command again, it will continue."
                ) from error
            failures = 1 if attempt.bytes_on_disk() > before else failures + 1
            if failures > retries:
                raise _WrongContentError(f"gave up after {failures} attempts ({error})") from error
            log.warning("%s: %s; trying again", attempt.url, error)
            time.sleep(retry_wait_s * 2 ** (failures - 1))


class _Attempt:
    """Attempts to bring one part to its full size from one address."""

    def __init__(
        self,
        url: str,
        target: Path,
        size: int | None,
        checksum: str | None,
        timeout_s: float,
        bar: Progress,
    ) -> None:
        self.url = url
        self.target = target
        self.part = target.with_name(target.name + ".part")
        self.info_file = target.with_name(target.name + ".part.json")
        self.size = size
        self.checksum = checksum
        self.timeout_s = timeout_s
        self.bar = bar
        self.task = bar.add_task(target.name, total=size)

    def bytes_on_disk(self) -> int:
        """Return the size of the part."""
        return self.part.stat().st_size if self.part.is_file() else 0

    def run(self) -> None:
        """Ask for what is missing, store it, verify the whole, and give it its name."""
        resumed_at, info = self._resume_point()
        request = urllib.request.Request(self.url, headers={"Accept-Encoding": "identity"})
        if resumed_at:
            request.add_header("Range", f"bytes={resumed_at}-")
            if info is not None and info.validator:
                request.add_header("If-Range", info.validator)
        try:
            response = urllib.request.urlopen(request, timeout=self.timeout_s)
        except urllib.error.HTTPError as error:
            self._on_status(error)
            return
        with response:
            total = self._store(response, resumed_at, info)
        self._finish(total, resumed=resumed_at > 0)

    def _resume_point(self) -> tuple[int, _PartInfo | None]:
        """Return how many bytes of the part can be trusted to belong to this address' file."""
        try:
            info = _PartInfo(**json.loads(self.info_file.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return 0, None
        same_file = info.url == self.url and (bool(info.validator) or info.total is not None)
        # A checksum decides at the end, so that with one a part of another mirror may be used.
        return (self.bytes_on_disk(), info) if same_file or self.checksum else (0, None)

    def _on_status(self, error: urllib.error.HTTPError) -> None:
        if error.code == 416:  # nothing beyond the part: it is whole, or of another file
            total = _total_of(error.headers.get("Content-Range"))
            if total is not None and total == self.bytes_on_disk():
                self._finish(total, resumed=True)
                return
            self.part.unlink(missing_ok=True)
            raise ConnectionError("the part on disk does not fit the server's file") from error
        if error.code in _RETRIED_STATUS:
            raise ConnectionError(f"the server answered {error.code} {error.reason}") from error
        raise _WrongContentError(f"the server answered {error.code} {error.reason}") from error

    def _store(
        self, response: http.client.HTTPResponse, resumed_at: int, info: _PartInfo | None
    ) -> int | None:
        """Write the answer behind the part, or over it; return the whole file's size if known."""
        start, total = 0, _int_or_none(response.headers.get("Content-Length"))
        if response.status == 206:
            content_range = response.headers.get("Content-Range")
            start, total = resumed_at, _total_of(content_range)
            changed = info is not None and info.total is not None and info.total != total
            if changed or not (content_range or "").startswith(f"bytes {resumed_at}-"):
                self.part.unlink(missing_ok=True)
                raise ConnectionError("the server's file has changed; starting again")
        first = response.read(_CHUNK)
        _refuse_page(response.headers.get("Content-Type", ""), first if start == 0 else b"")
        if self.size is not None and total is not None and total != self.size:
            raise _WrongContentError(
                f"the server's file has {total} bytes, {self.size} were expected"
            )
        _check_space(self.part.parent, None if total is None else total - start)
        validator = _validator_of(response.headers)
        text = json.dumps(asdict(_PartInfo(self.url, validator, total)))
        if start == 0:
            self.part.unlink(missing_ok=True)  # before the note: it must not describe old bytes
        self.info_file.write_text(text, encoding="utf-8")
        self.bar.update(self.task, total=total, completed=start)
        with self.part.open("ab") as stream:
            while first:
                stream.write(first)
                self.bar.advance(self.task, len(first))
                first = response.read(_CHUNK)
        return total

    def _finish(self, total: int | None, *, resumed: bool) -> None:
        """Compare size and checksum, then rename.

        Raises:
            ConnectionError: The transfer ended early; the part is continued.
        """
        have = self.bytes_on_disk()
        expected = self.size if self.size is not None else total
        if expected is not None and have < expected:
            raise ConnectionError(f"the connection broke after {have} of {expected} bytes")
        reason = ""
        if expected is not None and have > expected:
            reason = f"{have} bytes came, {expected} were expected"
        elif self.checksum is not None:
            algorithm, _, wanted = self.checksum.partition(":")
            found = file_digest(self.part, algorithm)
            if found != wanted.lower():
                reason = f"the {algorithm} is {found}, {wanted.lower()} was expected"
        if not reason:
            os.replace(self.part, self.target)
            self.info_file.unlink(missing_ok=True)
            return
        self.part.unlink()
        self.info_file.unlink(missing_ok=True)
        if resumed:  # the old part may have been the damaged one: once more, from the beginning
            raise ConnectionError(reason)
        raise _WrongContentError(f"{reason}; the file on the server is damaged or was replaced")


def _check_arguments(urls: Sequence[str], checksum: str | None) -> None:
    if not urls:
        raise ValueError("no address to download from; set urls=[https://...].")
    for url in urls:
        if urlsplit(url).scheme not in ("http", "https"):
            raise ValueError(f"{url} is not an http or https address.")
    if checksum is not None and checksum.partition(":")[0] not in ("sha256", "md5"):
        raise ValueError(f"checksum {checksum!r} must be sha256:<hex> or md5:<hex>.")


def _is_whole(path: Path, size: int | None, checksum: str | None) -> bool:
    if size is not None and path.stat().st_size != size:
        return False
    if checksum is None:
        return True
    algorithm, _, wanted = checksum.partition(":")
    return file_digest(path, algorithm) == wanted.lower()


def _refuse_page(content_type: str, first: bytes) -> None:
    """Tell a web page (a login, a warning, an error) from a file."""
    start = first[:512].lstrip().lower()
    if content_type.lower().startswith("text/html") or start.startswith((b"<!doctype", b"<html")):
        raise _WrongContentError("the server sent a web page instead of the file")


def _check_space(folder: Path, needed: int | None) -> None:
    free = shutil.disk_usage(folder).free
    if needed is not None and needed + _SPARE > free:
        raise DownloadError(
            f"{folder} has {free / 1e9:.1f} GB free, {(needed + _SPARE) / 1e9:.1f} GB are needed: "
            "free some space, or set data.root to another disk."
        )


def _validator_of(headers: http.client.HTTPMessage) -> str:
    etag = headers.get("ETag", "")
    # A weak ETag does not promise the same bytes, and If-Range must not carry one.
    return headers.get("Last-Modified", "") if not etag or etag.startswith("W/") else etag


def _total_of(content_range: str | None) -> int | None:
    """Read 1000 out of ``bytes 200-999/1000`` or ``bytes */1000``."""
    return _int_or_none((content_range or "").rpartition("/")[2])


def _int_or_none(text: str | None) -> int | None:
    return int(text) if text and text.isdigit() else None


def _progress_bar(enabled: bool) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, disable=not enabled, transient=True)
