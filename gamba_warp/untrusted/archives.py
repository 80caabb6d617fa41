"""Untrusted zip files: bounded size, plain files only, names inside the folder."""

from __future__ import annotations

import io
import shutil
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import UserError, first_line
from .names import inside, parts_of

MAX_MEMBERS = 50_000
MAX_BYTES = 4 << 30  # of all members, unpacked; ours take 0.4 GB
MAX_RATIO = 100  # unpacked to packed, for archives that unpack to over _SMALL bytes
_SMALL = 64 << 20
_PART = 1 << 20  # bytes copied at once
_DIRECTORY = 32 << 20  # bytes of a zip's table of contents; 50,000 members take 7 MB
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # with bounded memory


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
        infos = archive.infolist()
        if len(infos) > MAX_MEMBERS:
            raise UserError(f"{source}: {len(infos)} members, at most {MAX_MEMBERS} are supported")
        total = sum(info.file_size for info in infos)
        if total > MAX_BYTES:
            raise UserError(f"{source}: unpacks to over {MAX_BYTES >> 30} GB")
        if total > max(_SMALL, MAX_RATIO * source.stat().st_size):
            raise UserError(f"{source}: unpacks to over {MAX_RATIO} times its size")
        self._members: dict[str, zipfile.ZipInfo] = {}
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
            self._members[info.filename] = info
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
