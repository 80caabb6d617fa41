"""Atomic writes: a file or folder is either whole or not there; what is unfinished has a name."""

import errno
import fnmatch
import hashlib
import json
import os
import re
import secrets
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from .errors import UserError
from .kernels.runtime.system import is_own

PACKAGE = Path(__file__).resolve().parent
# The folder of a checkout: of this package, of tests/ and of starter/.
CHECKOUT = PACKAGE.parent
# The shipped model and pictures to try it on: two in an installed package, more in a checkout,
# where the starter set's data lie beside them.
STARTER = PACKAGE / "starter" if (PACKAGE / "starter").is_dir() else CHECKOUT / "starter"
# What is not finished has a name that begins so. No command takes names with a dot for inputs.
PART = ".gamba-part-"
_PART_NAME = re.compile(re.escape(PART) + "[a-z0-9_]{8}")
_DAY = 24 * 3600.0  # seconds; no command writes one file for so long
_READ = 1 << 20  # bytes read at once of a file that may be larger than the memory
# Reasons of a failed write that are the disk's, even where the error names no file.
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}


def reason_of(error: BaseException) -> str:
    """What an error says, in one line; its type where it says nothing."""
    text = getattr(error, "strerror", None) or str(error)
    return " ".join(text.split()) or type(error).__name__


def why_not_written(error: BaseException) -> str | None:
    """Why a file could not be written, in one line; None if the error says something else.

    safetensors has an error type of its own, also for a full disk.
    """
    text = reason_of(error)
    if isinstance(error, OSError):
        return text
    if type(error).__name__ == "SafetensorError" and "I/O error" in text:
        return re.sub(r"^.*I/O error: | \(os error \d+\)$", "", text)
    return None


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yields a path of the same name in a new folder beside; on success the file moves to ``path``.

    Many writers go by the suffix, and safetensors makes a temporary file of its own beside what it
    writes: in a folder of ours both are right, and what a killed process leaves can be told. The
    file is on the disk before it has its name, so a power cut leaves it whole or not there.

    Raises:
        UserError: the folder or the file cannot be written, or the disk is full.
    """
    path = Path(path)
    # What lies in a folder that is unfinished itself goes to the disk with it, all at once.
    alone = not any(_PART_NAME.fullmatch(parent.name) for parent in path.parents)
    with _unfinished(path) as folder:
        temporary = folder / path.name
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())  # safetensors makes 0600
        if alone:
            _sync(temporary)
        os.replace(temporary, path)
        if alone:
            _sync(path.parent)


@contextmanager
def _unfinished(path: Path) -> Iterator[Path]:
    """Yields a new folder beside ``path`` that goes in the end; what the disk raises names it."""
    folder = None
    try:
        folder = Path(tempfile.mkdtemp(prefix=PART, dir=path.parent))
        yield folder
    except Exception as error:
        reason = why_not_written(error)
        if reason is None:
            raise
        raise UserError(f"cannot write {path}: {reason}") from error
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


@contextmanager
def atomic_folder(path: str | Path, replace: bool = False) -> Iterator[Path]:
    """Yields a temporary folder beside ``path``; on success it takes that name, else it goes.

    Args:
        path: the folder that is to be.
        replace: whether a folder of that name, if there is one, goes; else it is an error.

    Raises:
        UserError: the folder or a file in it cannot be written, or the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
    with _unfinished(path) as temporary:
        yield temporary
        for part in [*temporary.rglob("*"), temporary]:
            _sync(part)
        temporary.chmod(0o777 & ~_umask())  # mkdtemp makes 0700
        with _set_aside(path) if replace else nullcontext():
            if sys.platform == "win32" and path.is_dir():
                path.rmdir()  # there a rename does not replace an empty folder
            temporary.rename(path)  # an empty folder may be there
        _sync(path.parent)


@contextmanager
def _set_aside(folder: Path) -> Iterator[None]:
    """Gives a folder, if it is there, an unfinished name; it goes if all is well, else it is back.

    Half of a folder must not look like a whole one while it is removed.
    """
    doomed = folder.with_name(PART + secrets.token_hex(4))
    there = folder.exists()
    if there:
        folder.rename(doomed)
    try:
        yield
    except BaseException:
        if there:
            doomed.rename(folder)
        raise
    shutil.rmtree(doomed, ignore_errors=True)


def remove_folder(folder: Path) -> None:
    """Removes a folder that is ours; at no time half of it has its name.

    Raises:
        OSError: it cannot be renamed.
    """
    with _set_aside(folder):
        pass


def _sync(path: Path) -> None:
    """Waits until a file or a folder is on the disk, where the system can do that.

    Windows opens no folders for it, and drives of other machines may refuse it.
    """
    # Windows syncs only what can be written.
    mode = os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
    try:
        handle = os.open(path, mode)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise


def sweep(folder: str | Path, age: float = _DAY) -> None:
    """Removes what killed processes left in a folder: names of ``PART``, ours, of a certain age.

    Args:
        folder: what lies in deeper folders stays.
        age: seconds since anything in it was last written; 0 where nobody else writes there.
    """
    try:
        found = [e for e in os.scandir(folder) if _PART_NAME.fullmatch(e.name)]
    except OSError:
        return
    for entry in found:
        try:
            if not is_own(entry.stat(follow_symlinks=False)) or entry.is_symlink():
                continue
            if time.time() - _last_written(entry) < age:
                continue
            if entry.is_dir():
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.is_file():
                os.unlink(entry.path)
        except OSError:  # it has gone meanwhile
            continue


def _last_written(entry: os.DirEntry) -> float:
    """When a file, or a folder and what is right in it, was last written, Unix seconds."""
    inner = os.scandir(entry.path) if entry.is_dir(follow_symlinks=False) else ()
    return max(e.stat(follow_symlinks=False).st_mtime for e in (entry, *inner))


def walk(root: str | Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yields what ``os.walk`` does, for linked folders too; nothing whose name begins with a dot.

    A folder comes once, under the name without a link if it has one: links come after all else. A
    link to a folder that ``root`` lies in is passed over. The caller may remove subfolders from
    the list, which are then not entered; both lists are sorted.
    """

    def place(folder: str | Path) -> tuple[int, int] | None:
        try:
            status = os.stat(folder)
        except OSError:  # it has gone meanwhile
            return None
        return status.st_dev, status.st_ino

    seen = {None, *map(place, Path(os.path.realpath(root)).parents)}
    waiting = [os.fspath(root)]
    for start in waiting:  # which grows by the links that are found
        for folder, subfolders, files in os.walk(start):
            if (here := place(folder)) in seen:
                subfolders.clear()
                continue
            seen.add(here)
            subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
            yield folder, subfolders, sorted(name for name in files if not name.startswith("."))
            inner = [os.path.join(folder, name) for name in subfolders]
            waiting += [path for path in inner if os.path.islink(path)]  # os.walk enters none


def visible(folder: Path, pattern: str) -> Iterator[Path]:
    """Yields the files whose names match, at any depth (``walk``)."""
    for inner, _, files in walk(folder):
        for name in fnmatch.filter(files, pattern):
            yield Path(inner, name)


def write_json(path: str | Path, value: object) -> None:
    """Writes ``value`` as indented JSON, atomically; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Writes UTF-8 text, atomically; what of a file's name is not UTF-8 is written with escapes.

    Raises:
        UserError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))


def output_folder(path: str | Path) -> Path:
    """Makes the folder, parents included, checks that files can be made in it, and sweeps it.

    Raises:
        UserError: it is a file, or cannot be made or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path, prefix=PART):
            pass
    except OSError as error:
        raise UserError(f"cannot write into {path}: {error.strerror}") from error
    sweep(path)
    return path


@contextmanager
def only_process(folder: Path, what: str) -> Iterator[None]:
    """Holds a folder for this process alone; the system lets go of it when the process ends.

    The file ``.lock`` in the folder stays; it holds the number of the process that had it last.

    Args:
        folder: it is there.
        what: what the process does with it, for the message: "trains", "runs".

    Raises:
        UserError: another process holds it, or the lock cannot be made.
    """
    from filelock import FileLock, Timeout

    path = folder / ".lock"
    if path.is_symlink():  # its target would be emptied
        raise UserError(f"cannot lock {folder}: .lock is a link")
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        try:
            number = path.read_text(encoding="utf-8").strip()[:20] or "unknown"
        except OSError:
            number = "unknown"
        message = f"{folder}: another process {what} here (pid {number})"
        raise UserError(message) from error
    except (OSError, NotImplementedError) as error:
        raise UserError(f"cannot lock {folder}: {why_not_written(error) or error}") from error
    try:
        with suppress(OSError):  # a full disk: the lock holds all the same
            path.write_text(f"{os.getpid()}\n", encoding="utf-8")
        yield
    finally:
        lock.release()


def sha256_of_all(paths: Iterable[Path], folder: Path) -> str:
    """The SHA-256 of the names of files in a folder and of their own SHA-256s, sorted by path.

    A file that cannot be read counts as that: it stops none of the others.
    """
    digest = hashlib.sha256()
    for path in sorted(paths):
        try:
            content = sha256(path)
        except UserError:
            content = "unreadable"
        digest.update(os.fsencode(f"{path.relative_to(folder).as_posix()} {content}\n"))
    return digest.hexdigest()


def sha256(path: str | Path) -> str:
    """The SHA-256 of a file, 64 hexadecimal digits.

    Raises:
        UserError: the file cannot be read, or is no plain file.
    """
    digest = hashlib.sha256()
    if Path(path).exists() and not Path(path).is_file():  # a pipe or a device has no end
        raise UserError(f"{path}: not a plain file")
    try:
        with open(path, "rb") as file:
            while part := file.read(_READ):
                digest.update(part)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    return digest.hexdigest()


def check_sha256(path: str | Path, want: str) -> None:
    """Compares a file's SHA-256, or as many of its leading digits as ``want`` has.

    Raises:
        UserError: the file cannot be read or has another content.
    """
    got = sha256(path)
    if not got.startswith(want):
        raise UserError(f"{path}: SHA-256 is {got[: len(want)]}, expected {want}")
