"""Zip, tar and ar files of strangers: bounded, plain files only, each name inside the folder."""

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
MAX_BYTES = 4 << 30  # of all members together, unpacked; ours take 0.4 GB
MAX_RATIO = 100  # unpacked to packed, for archives that unpack to over _SMALL bytes
_SMALL = 64 << 20
_PART = 1 << 20  # bytes copied at once
_DIRECTORY = 32 << 20  # bytes of a zip's table of contents; 50,000 members take 7 MB
_MEMORY = 256 << 20  # bytes that xz may ask for; xz -9 asks for 65 MB
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those whose memory is bounded
_AR = struct.Struct("16s12s6s6s8s10s2s")  # name, time, user, group, mode, size, end


@contextmanager
def _one_line(source: object) -> Iterator[None]:
    """Makes every error of damage, or of the disk, a UserError that begins with ``source``."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # the standard library's are of a dozen kinds
        if isinstance(error, OSError) and error.strerror:  # gzip's own error has none
            raise UserError(f"{source}: {error.strerror}") from error
        reason = first_line(error)
        raise UserError(f"{source}: cannot be unpacked ({reason})") from error


class Zip:
    """The files of a zip archive, all checked before any is unpacked; made by ``open_zip``.

    Attributes:
        names: of the files, as the archive has them, each once.
    """

    def __init__(self, archive: zipfile.ZipFile, source: Path) -> None:
        """Checks names, kinds, sizes and number of the members."""
        self._archive, self._source = archive, source
        self._members = _zip_members(archive, source)
        self.names = list(self._members)

    def read(self, name: str, limit: int) -> bytes:
        """The bytes of one file.

        Raises:
            UserError: there is none of this name, it is larger than ``limit`` bytes, or damaged.
        """
        member = self._members.get(name)
        if member is None:
            raise UserError(f"{self._source}: holds no {name!r}")
        if member.file_size > limit:
            raise UserError(f"{self._source}: {name!r} is over {limit >> 20} MB")
        with _one_line(f"{self._source}: {name!r}"), self._archive.open(member) as file:
            return file.read(member.file_size + 1)  # without a number, a lie could fill the memory

    def unpack(self, name: str, folder: Path) -> None:
        """Writes one file to its place in ``folder``, in which nothing was before this archive.

        Raises:
            UserError: it is damaged, or cannot be written.
        """
        target = inside(folder, name, str(self._source))
        with _one_line(f"{self._source}: {name!r}"):
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._archive.open(self._members[name]) as file, target.open("xb") as out:
                shutil.copyfileobj(file, out, _PART)  # no more than file_size bytes come


@contextmanager
def open_zip(path: Path) -> Iterator[Zip]:
    """Opens a zip archive whose members are plain files and folders, bounded in number and size.

    Raises:
        UserError: it cannot be read, or a member is a link, encrypted, outside the folder, there
            twice (also but for the case of letters), or too large for the archive.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with _one_line(path):
        _check_directory(path)
        archive = zipfile.ZipFile(path)
    with archive:
        yield Zip(archive, path)


def _check_directory(path: Path) -> None:
    """Refuses a table of contents that would fill the memory, before zipfile reads all of it."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - (1 << 16) - 22))
        end = file.read()
    place = end.rfind(b"PK\5\6")  # the record of the end: at 12 the table's size
    stated = int.from_bytes(end[place + 12 : place + 16], "little") if place >= 0 else 0
    if stated > _DIRECTORY or end.rfind(b"PK\6\7") >= 0:  # the second stands for zip64
        raise UserError(f"{path}: a zip of too many members, or of over 4 GB")


def _zip_members(archive: zipfile.ZipFile, source: Path) -> dict[str, zipfile.ZipInfo]:
    """The files by name, checked as ``open_zip`` says."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise UserError(f"{source}: {len(infos)} members, at most {MAX_MEMBERS} are unpacked")
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
            raise UserError(f"{source}: {info.filename!r} is packed in a way that is not read")
        if info.is_dir():
            continue
        # Some file systems know no case: the second would replace the first.
        if info.filename.casefold() in folded:
            raise UserError(f"{source}: {info.filename!r} is there twice")
        folded.add(info.filename.casefold())
        found[info.filename] = info
    return found


def _check_total(unpacked: int, packed: int, source: object) -> None:
    """Refuses what unpacks to too much, or to far too much for its size."""
    if unpacked > MAX_BYTES:
        raise UserError(f"{source}: unpacks to over {MAX_BYTES >> 30} GB")
    if unpacked > max(_SMALL, MAX_RATIO * packed):
        raise UserError(f"{source}: unpacks to over {MAX_RATIO} times its size")


def read_ar(path: Path, prefix: str, out: BinaryIO) -> str:
    """Copies the first member of an ar archive (as a .deb is one) whose name begins so.

    Args:
        path: the archive.
        prefix: what the member's name begins with.
        out: file that its bytes are written to.

    Returns:
        The member's name.

    Raises:
        UserError: no ar archive, damaged, or without such a member.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with _one_line(path), path.open("rb") as file:
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
                raise UserError(f"{path}: cannot be unpacked ({name!r} has no sound size)")
            if name.startswith(prefix):
                for start in range(0, int(size), _PART):
                    out.write(file.read(min(_PART, int(size) - start)))
                return name
            skipped = int(size) + int(size) % 2  # members begin at even places
            file.seek(skipped, io.SEEK_CUR)
            left -= skipped
    raise UserError(f"{path}: holds no {prefix}")


class _Xz(io.RawIOBase):
    """A reader of xz that bounds the memory: lzma.LZMAFile takes what the header asks for."""

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


def _unpacked(file: BinaryIO, source: object) -> BinaryIO:
    """A reader of what a tar is packed in: gzip, bzip2, xz, or nothing."""
    start = file.read(6)
    file.seek(0)
    if start.startswith(b"\x28\xb5\x2f\xfd"):
        raise UserError(f"{source}: packed with zstd, which is not read; unpack it yourself")
    readers = {
        b"\x1f\x8b": lambda: gzip.GzipFile(fileobj=file),
        b"BZh": lambda: bz2.BZ2File(file),
        b"\xfd7zXZ\0": lambda: io.BufferedReader(_Xz(file)),
    }
    made = [read() for magic, read in readers.items() if start.startswith(magic)]
    return cast(BinaryIO, made[0]) if made else file


class _ShortReads:
    """A file for tarfile, which reads headers of any stated length at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.seek, self.tell = file, file.seek, file.tell

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _PART:
            raise tarfile.ReadError(f"a header of {size} bytes")
        return self._file.read(size)


@dataclass
class Member:
    """A plain file of a tar archive.

    Attributes:
        name: its path in the archive, relative and without ``..``.
        size: bytes.
        file: its bytes, to be read before the next member is taken.
    """

    name: str
    size: int
    file: IO[bytes]


@contextmanager
def open_tar(file: BinaryIO, source: object, scratch: Path) -> Iterator[Iterator[Member]]:
    """Opens a tar archive, packed or not, and gives its plain files one after the other.

    Args:
        file: the archive, which can seek.
        source: what to call it in an error.
        scratch: folder for a temporary file of the unpacked size.

    Yields:
        The members. Folders, links and devices are passed over.

    Raises:
        UserError: it is damaged or too large, or a name leaves the folder; also while the members
            are walked through and read.
    """
    with tempfile.TemporaryFile(dir=scratch) as plain:
        with _one_line(source):
            packed, total = file.seek(0, io.SEEK_END), 0
            file.seek(0)
            reader = _unpacked(file, source)
            while part := reader.read(_PART):
                total += len(part)
                _check_total(total, packed, source)
                plain.write(part)
            plain.seek(0)
            tar = tarfile.open(fileobj=cast(BinaryIO, _ShortReads(plain)), mode="r:")
        with tar:
            try:
                yield _walk(tar, total, source)
            except tarfile.TarError as error:  # a member ends early, when it is read
                raise UserError(f"{source}: cannot be unpacked ({first_line(error)})") from error


def _walk(tar: tarfile.TarFile, total: int, source: object) -> Iterator[Member]:
    members = iter(tar)
    for _ in range(MAX_MEMBERS):
        with _one_line(source):
            member = next(members, None)
            if member is None:
                return
            # Some versions of tarfile go round in circles after a negative size.
            if not 0 <= member.size <= total:
                raise UserError(f"{source}: {member.name!r} has no sound size")
            file = tar.extractfile(member) if member.isreg() else None
        if file is not None:
            parts_of(member.name, str(source))
            yield Member(member.name, member.size, file)
    raise UserError(f"{source}: over {MAX_MEMBERS} members")
