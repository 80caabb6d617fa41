"""Tars of shards: beside their index, or on a server and kept in a folder of limited size.

Those of a server need the package ``webdataset``.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from ..errors import UserError, first_line
from ..files import atomic_path, output_folder, plain_file
from ..versions import require

# Addresses that are opened; others, such as webdataset's "pipe:", would run commands of the index.
ADDRESS = r"^(https?|s3|gs)://[A-Za-z0-9][A-Za-z0-9_.:/@%~+-]{0,999}$"
CACHE = "cache"  # folder of fetched tars
TRIES = 4
_DELAY = 1.0  # seconds before the second try; doubled each time
_SILENT = 60.0  # seconds without a byte that end a try
_PART = 1 << 20  # bytes
_REST = 30.0  # seconds after a failure without another try: other threads want the same tar
_PROGRAMS = {"http": "curl", "https": "curl", "s3": "aws", "gs": "gsutil"}
_failed: dict[tuple[str, str], tuple[float, str]] = {}  # by address and name: when, and why


class Unreachable(UserError):
    """A shard cannot be fetched: no fault of its objects, so a training stops."""


class Source(NamedTuple):
    """Tar of an index.

    Attributes:
        folder: of the index.
        name: of the file.
        bytes: its size.
        sha256: of the file.
        address: address of its folder; empty for a local one.
        cache_bytes: largest size of all kept tars.
    """

    folder: Path
    name: str
    bytes: int
    sha256: str
    address: str
    cache_bytes: int

    def path(self) -> Path:
        """Return the path of the tar, which is fetched if it lies elsewhere.

        Raises:
            UserError: it is missing, or not of the size that the index states.
            Unreachable: it cannot be fetched.
        """
        if self.address:
            return _fetch(self)
        path = self.folder / self.name
        found = plain_file(path, links=False).st_size
        if found != self.bytes:
            sizes = f"{found:,} bytes, not {self.bytes:,}"
            raise UserError(f"{path}: cut short or changed ({sizes})")
        return path

    def open(self) -> BinaryIO:
        """Open the tar, unbuffered; raises as ``path``."""
        for _ in range(3):  # another process may remove it from the cache meanwhile
            path = self.path()
            try:
                return cast(BinaryIO, open(path, "rb", buffering=0))
            except FileNotFoundError:
                continue
            except OSError as error:
                raise UserError(f"{path}: {error.strerror or error}") from error
        raise UserError(f"{path}: removed as soon as it is fetched")


def _fetch(source: Source) -> Path:
    """Return the path of a tar in the cache, after fetching it if it is not there.

    Only one process of a machine fetches a tar. The ones used longest ago make room for it.
    """
    folder = source.folder / CACHE
    path = folder / source.name
    if _touched(path, source.bytes):
        return path
    require("webdataset")
    from filelock import FileLock
    from webdataset.cache import LRUCleanup

    output_folder(folder)
    with FileLock(source.folder / f".{source.name}.lock"):
        if _touched(path, source.bytes):  # by another process, meanwhile
            return path
        when, reason = _failed.get((source.address, source.name), (-_REST, ""))
        if time.monotonic() - when < _REST:
            raise Unreachable(reason)
        room = max(0, source.cache_bytes - source.bytes)
        LRUCleanup(str(folder), room, keyfn=os.path.getmtime, interval=None).cleanup()
        with atomic_path(path) as temporary:
            try:
                url = f"{source.address}/{source.name}"
                download(url, temporary, source.bytes, source.sha256)
            except Unreachable as error:
                _failed[source.address, source.name] = time.monotonic(), str(error)
                raise
    return path


def _touched(path: Path, size: int) -> bool:
    """True if the file is there and complete; it then counts as the last one used."""
    with suppress(OSError):
        if os.stat(path).st_size == size:
            os.utime(path)
            return True
    return False


def download(url: str, target: Path, most: int, sha256: str | None = None) -> None:
    """Fetch a file through ``webdataset``; a failure is tried again.

    Args:
        url: address of the file.
        target: file to write.
        most: largest size, bytes; the exact one with ``sha256``.
        sha256: of the content; None for an unknown one.

    Raises:
        Unreachable: no try succeeds, or the content is larger than ``most`` or another.
        OSError: the target cannot be written.
    """
    reason = ""
    for number in range(TRIES):
        if number:
            time.sleep(_DELAY * 2 ** (number - 1))
        try:
            found, size = _download(url, target, most)
        except (_Broken, subprocess.TimeoutExpired) as error:
            reason = first_line(error)
            continue
        if size > most or sha256 not in (None, found):
            what = "is larger than stated" if size > most else "is not the file of the index"
            raise Unreachable(f"{url}: {what}")
        return
    raise Unreachable(f"{url}: cannot be fetched, {TRIES} tries: {reason}")


class _Broken(Exception):
    """A transfer failed."""


def _download(url: str, target: Path, most: int) -> tuple[str, int]:
    """Return SHA-256 and size of one transfer, which ends after ``most`` bytes."""
    from webdataset.gopen import gopen, gopen_schemes

    gopen_schemes.setdefault("s3", _open_s3)
    digest, size = hashlib.sha256(), 0
    try:
        stream: Any = gopen(url)  # a Pipe of webdataset
    except FileNotFoundError as error:
        raise Unreachable(f"{url}: needs the program {error.filename}") from error
    last, ended = time.monotonic(), threading.Event()

    def watch() -> None:
        while not ended.wait(_SILENT / 8):
            if time.monotonic() - last > _SILENT:
                stream.proc.kill()
                return

    threading.Thread(target=watch, daemon=True).start()
    with open(target, "wb") as file:
        try:
            with stream:
                while size <= most and (part := stream.stream.read1(_PART)):
                    last = time.monotonic()
                    size += len(part)
                    digest.update(part)
                    file.write(part)
        except OSError as error:
            if error.errno is not None:  # of the target
                raise
            if time.monotonic() - last > _SILENT:
                raise _Broken(f"no byte for {_SILENT:g} s") from error
            code = re.search(r"exit (-?\d+)", str(error))
            program = _PROGRAMS[url.partition(":")[0]]
            raise _Broken(f"{program} ended with code {code[1]}" if code else "broken") from error
        finally:
            ended.set()
    return digest.hexdigest(), size


def _open_s3(url: str, mode: str, bufsize: int):
    """Open an object of S3 by the program aws, as webdataset opens gs:// by gsutil."""
    from webdataset.gopen import Pipe

    command = ["aws", "s3", "cp", "--only-show-errors", url, "-"]
    return Pipe(command, mode=mode, bufsize=bufsize, stderr=subprocess.DEVNULL)
