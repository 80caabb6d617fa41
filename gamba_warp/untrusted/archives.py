"""Untrusted zip, tar and ar files: bounded size, plain files only, names inside the folder."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, cast

from ..errors import UserError, first_line
from .names import inside, parts_of

MAX_MEMBERS = 50_000
MAX_BYTES = 4 << 30  # of all members, unpacked; ours take 0.4 GB
MAX_RATIO = 100  # unpacked to packed, for archives that unpack to over _SMALL bytes
_SMALL = 64 << 20
_PART = 1 << 20  # bytes copied at once
_DIRECTORY = 32 << 20  # bytes of a zip's table of contents; 50,000 members take 7 MB
_MEMORY = 256 << 20  # bytes for the xz decoder; xz -9 needs 65 MB
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # with bounded memory
_AR = struct.Struct("16s12s6s6s8s10s2s")  # name, time, user, group, mode, size, end


@contextmanager
def _as_user_error(source: object) -> Iterator[None]:
    """Convert errors of damage or of the disk to a UserError that begins with ``source``."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # the standard library raises a dozen types
        if isinstance(error, OSError) and error.strerror:  # gzip's own error lacks it
            raise UserError(f"{source}: {error.strerror}") from error
        reason = first_line(error)
        raise UserError(f"{source}: cannot be unpacked ({reason})") from error


class Zip:
    """Files of a zip archive, all checked before any is unpacked; made by ``open_zip``.

    Attributes:
        names: names of the files in the archive, unique.
    """

    def __init__(self, archive: zipfile.ZipFile, source: Path) -> None:
        """Check names, kinds, sizes and number of the members."""
        self._archive, self._source = archive, source
        self._members = _zip_members(archive, source)
        self.names = list(self._members)

    def read(self, name: str, limit: int) -> bytes:
        """Read one file.

        Raises:
            UserError: the file is missing, larger than ``limit`` bytes, or damaged.
        """
        member = self._members.get(name)
        if member is None:
            raise UserError(f"{self._source}: holds no {name!r}")
        if member.file_size > limit:
            raise UserError(f"{self._source}: {name!r} is over {limit >> 20} MB")
        with _as_user_error(f"{self._source}: {name!r}"), self._archive.open(member) as file:
            return file.read(member.file_size + 1)  # bounded, as the stated size may be false

    def unpack(self, name: str, folder: Path) -> None:
        """Write one file to ``folder``, which must only have files of this archive.

        Raises:
            UserError: the file is damaged, or cannot be written.
        """
        target = inside(folder, name, str(self._source))
        with _as_user_error(f"{self._source}: {name!r}"):
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._archive.open(self._members[name]) as file, target.open("xb") as out:
                shutil.copyfileobj(file, out, _PART)  # at most file_size bytes


@contextmanager
def open_zip(path: Path) -> Iterator[Zip]:
    """Open a zip archive of plain files and folders, bounded in number and size.

    Raises:
        UserError: it cannot be read, or a member is a link, encrypted, outside the folder, repeated
            (also if only the case differs), or too large for the archive.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with _as_user_error(path):
        _check_directory(path)
        archive = zipfile.ZipFile(path)
    with archive:
        yield Zip(archive, path)


def _check_directory(path: Path) -> None:
    """Raise for a table of contents that is too large, before zipfile reads all of it."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - (1 << 16) - 22))
        end = file.read()
    start = end.rfind(b"PK\5\6")  # end record, with the table's size at offset 12
    stated = int.from_bytes(end[start + 12 : start + 16], "little") if start >= 0 else 0
    if stated > _DIRECTORY or end.rfind(b"PK\6\7") >= 0:  # the latter means zip64
        raise UserError(f"{path}: a zip with too many members, or over 4 GB")


def _zip_members(archive: zipfile.ZipFile, source: Path) -> dict[str, zipfile.ZipInfo]:
    """Files by name, after the checks of ``open_zip``."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise UserError(f"{source}: {len(infos)} members, at most {MAX_MEMBERS} are supported")
    total = sum(info.file_size for info in infos)
    _check_total(total, source.stat().st_size, source)
    found: dict[str, zipfile.ZipInfo] = {}
    folded: set[str] = set()
    for info in infos:
        parts_of(info.filename, str(source))
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise UserError(f"{source}: {info.filename!r} is a link or a device")
        if info.flag_bits & 0x1:
            raise UserError(f"{source}: {info.filename!r} is encrypted")
        if info.compress_type not in _METHODS:
            raise UserError(f"{source}: {info.filename!r} uses an unsupported compression")
        if info.is_dir():
            continue
        # On case-insensitive file systems the second would replace the first.
        if info.filename.casefold() in folded:
            raise UserError(f"{source}: {info.filename!r} occurs twice")
        folded.add(info.filename.casefold())
        found[info.filename] = info
    return found


def _check_total(unpacked: int, packed: int, source: object) -> None:
    """Raise if the unpacked size is too large, absolutely or for the packed size."""
    if unpacked > MAX_BYTES:
        raise UserError(f"{source}: unpacks to over {MAX_BYTES >> 30} GB")
    if unpacked > max(_SMALL, MAX_RATIO * packed):
        raise UserError(f"{source}: unpacks to over {MAX_RATIO} times its size")


def read_ar(path: Path, prefix: str, out: BinaryIO) -> str:
    """Copy the first member of an ar archive (such as a .deb) with a prefix.

    Args:
        path: the archive.
        prefix: prefix of the member's name.
        out: file to write to.

    Returns:
        The member's name.

    Raises:
        UserError: not an ar archive, damaged, or without such a member.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with _as_user_error(path), path.open("rb") as file:
        left = path.stat().st_size - 8
        if file.read(8) != b"!<arch>\n":
            raise UserError(f"{path}: not a Debian package")
        for _ in range(MAX_MEMBERS):
            header = file.read(_AR.size)
            if not header.strip(b"\n"):
                break
            if len(header) < _AR.size:
                raise UserError(f"{path}: cannot be unpacked (a header is cut short)")
            fields = _AR.unpack(header)
            name, size = fields[0].decode("ascii", "replace").strip(), fields[5].strip()
            left -= _AR.size
            if fields[6] != b"`\n" or not size.isdigit() or int(size) > left:
                raise UserError(f"{path}: cannot be unpacked ({name!r} has an invalid size)")
            if name.startswith(prefix):
                for start in range(0, int(size), _PART):
                    out.write(file.read(min(_PART, int(size) - start)))
                return name
            skipped = int(size) + int(size) % 2  # members begin at even offsets
            file.seek(skipped, io.SEEK_CUR)
            left -= skipped
    raise UserError(f"{path}: holds no {prefix}")


class _Xz(io.RawIOBase):
    """Reader of xz with bounded memory; lzma.LZMAFile allocates whatever the header states."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._decoder = file, lzma.LZMADecompressor(memlimit=_MEMORY)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        data = b""
        while not data and not self._decoder.eof:
            packed = self._file.read(1 << 16) if self._decoder.needs_input else b""
            if self._decoder.needs_input and not packed:
                raise EOFError("it ends early")
            data = self._decoder.decompress(packed, len(buffer))
        buffer[: len(data)] = data
        return len(data)


def _decompressed(file: BinaryIO, source: object) -> BinaryIO:
    """Reader of the decompressed tar: gzip, bzip2, xz, or none."""
    start = file.read(6)
    file.seek(0)
    if start.startswith(b"\x28\xb5\x2f\xfd"):
        raise UserError(f"{source}: packed with zstd, which is not supported; unpack it yourself")
    readers = {
        b"\x1f\x8b": lambda: gzip.GzipFile(fileobj=file),
        b"BZh": lambda: bz2.BZ2File(file),
        b"\xfd7zXZ\0": lambda: io.BufferedReader(_Xz(file)),
    }
    made = [read() for magic, read in readers.items() if start.startswith(magic)]
    return cast(BinaryIO, made[0]) if made else file


class _ShortReads:
    """File for tarfile with bounded reads; tarfile reads headers of any stated length at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.seek, self.tell = file, file.seek, file.tell

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _PART:
            raise tarfile.ReadError(f"a header of {size} bytes")
        return self._file.read(size)


@dataclass
class Member:
    """Plain file of a tar archive.

    Attributes:
        name: its path in the archive, relative and without ``..``.
        size: bytes.
        file: its content, to be read before the next member is requested.
    """

    name: str
    size: int
    file: IO[bytes]


@contextmanager
def open_tar(file: BinaryIO, source: object, scratch: Path) -> Iterator[Iterator[Member]]:
    """Open a tar archive, compressed or not, as an iterator over its plain files.

    Args:
        file: the archive, seekable.
        source: its name for error messages.
        scratch: folder for a temporary file of the unpacked size.

    Yields:
        The members, without folders, links and devices.

    Raises:
        UserError: it is damaged or too large, or a name leaves the folder; also during the
            iteration and the reading of members.
    """
    with tempfile.TemporaryFile(dir=scratch) as plain:
        with _as_user_error(source):
            packed, total = file.seek(0, io.SEEK_END), 0
            file.seek(0)
            reader = _decompressed(file, source)
            while part := reader.read(_PART):
                total += len(part)
                _check_total(total, packed, source)
                plain.write(part)
            plain.seek(0)
            tar = tarfile.open(fileobj=cast(BinaryIO, _ShortReads(plain)), mode="r:")
        with tar:
            try:
                yield _plain_members(tar, total, source)
            except tarfile.TarError as error:  # a member ends early while it is read
                raise UserError(f"{source}: cannot be unpacked ({first_line(error)})") from error


def _plain_members(tar: tarfile.TarFile, total: int, source: object) -> Iterator[Member]:
    members = iter(tar)
    for _ in range(MAX_MEMBERS):
        with _as_user_error(source):
            member = next(members, None)
            if member is None:
                return
            # Some versions of tarfile loop forever after a negative size.
            if not 0 <= member.size <= total:
                raise UserError(f"{source}: {member.name!r} has an invalid size")
            file = tar.extractfile(member) if member.isreg() else None
        if file is not None:
            parts_of(member.name, str(source))
            yield Member(member.name, member.size, file)
    raise UserError(f"{source}: over {MAX_MEMBERS} members")
