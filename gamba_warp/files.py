"""Atomic writes: a file or folder is either complete or absent. Unfinished ones have a prefix."""

import errno
import fnmatch
import hashlib
import json
import mimetypes
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from .errors import FileWarning, UserError

PACKAGE = Path(__file__).resolve().parent
# The folder of a checkout: of this package, of tests/ and of starter/.
CHECKOUT = PACKAGE.parent
# The shipped model and example images: two in an installed package, more in a checkout, which
# also has the starter set's data.
STARTER = PACKAGE / "starter" if (PACKAGE / "starter").is_dir() else CHECKOUT / "starter"
# Prefix of unfinished files. Commands ignore inputs whose names begin with a dot.
PART = ".gamba-part-"
_PART_NAME = re.compile(re.escape(PART) + "[a-z0-9_]{8}")
_DAY = 24 * 3600.0  # seconds; no command writes one file for so long
_READ = 1 << 20  # bytes read at once; a file may be larger than the memory
# File suffixes that every Python knows, without the system's, and ours.
_FILE_NAMES = mimetypes.MimeTypes()
_FILE_SUFFIXES = {*".ply .splat .spz .glb .gltf .obj .stl .off .safetensors .npz".split()}
# Codes of a failed write that blame the disk, even if the error names no file.
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}


def reason_of(error: BaseException) -> str:
    """Return the message of an error in one line; its type if the message is empty."""
    text = getattr(error, "strerror", None) or str(error)
    return " ".join(text.split()) or type(error).__name__


def write_error(error: BaseException) -> str | None:
    """Return why a file could not be written, in one line; None for an unrelated error.

    safetensors has its own error type, also for a full disk.
    """
    text = reason_of(error)
    if isinstance(error, OSError):
        return text
    if type(error).__name__ == "SafetensorError" and "I/O error" in text:
        return re.sub(r"^.*I/O error: | \(os error \d+\)$", "", text)
    return None


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path of the same name; on success the file moves to ``path``.

    The name keeps its suffix, by which many writers choose the format. The folder also holds the
    temporary file that safetensors makes, and marks the leftovers of a killed process. The file is
    synced before it is renamed, so a power cut leaves it complete or absent.

    Raises:
        UserError: the folder or the file cannot be written, or the disk is full.
    """
    path = Path(path)
    # A file inside an unfinished folder is synced with that folder.
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
    """Yield a temporary folder next to ``path``; errors of the disk name ``path``."""
    folder = None
    try:
        folder = Path(tempfile.mkdtemp(prefix=PART, dir=path.parent))
        yield folder
    except Exception as error:
        reason = write_error(error)
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
    """Yield a temporary folder next to ``path``; it is renamed on success, else removed.

    Args:
        path: the final folder.
        replace: replace an existing folder of that name; else it is an error.

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
            temporary.rename(path)  # replaces an empty folder
        _sync(path.parent)


@contextmanager
def _set_aside(folder: Path) -> Iterator[None]:
    """Rename a folder, if it exists, to an unfinished name; remove it on success, else restore it.

    A partly removed folder must not look complete.
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
    """Remove a folder; it is never partly there under its name.

    Raises:
        OSError: it cannot be renamed.
    """
    with _set_aside(folder):
        pass


def _sync(path: Path) -> None:
    """Wait until a file or folder is on the disk; network drives may refuse."""
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise


def sweep(folder: str | Path, age: float = _DAY) -> None:
    """Remove leftovers of killed processes: the user's own files named ``PART``, of a certain age.

    Args:
        folder: deeper folders are not searched.
        age: seconds since the last write; 0 if no other process writes there.
    """
    try:
        entries = [e for e in os.scandir(folder) if _PART_NAME.fullmatch(e.name)]
    except OSError:
        return
    for entry in entries:
        try:
            if entry.stat(follow_symlinks=False).st_uid != os.geteuid() or entry.is_symlink():
                continue
            # The last write to a file, or to a folder and its direct entries.
            inner = os.scandir(entry.path) if entry.is_dir(follow_symlinks=False) else ()
            last = max(e.stat(follow_symlinks=False).st_mtime for e in (entry, *inner))
            if time.time() - last < age:
                continue
            if entry.is_dir():
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.is_file():
                os.unlink(entry.path)
        except OSError:  # removed meanwhile
            continue


def identity(path: str | Path) -> tuple[int, int] | None:
    """Return the device and inode of a file or folder, links followed; None if it is missing."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def walk(root: str | Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield like ``os.walk``, also into linked folders, without names that begin with a dot.

    A folder comes once; links come last, so that a name without a link is preferred. A link to a
    parent of ``root`` is skipped. The caller may remove subfolders from the list, which are then
    not entered. Both lists are sorted.
    """
    seen = {None, *map(identity, Path(os.path.realpath(root)).parents)}
    waiting = [os.fspath(root)]
    for start in waiting:  # grows by the links that are found
        for folder, subfolders, files in os.walk(start):
            if (here := identity(folder)) in seen:
                subfolders.clear()
                continue
            seen.add(here)
            subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
            yield folder, subfolders, sorted(name for name in files if not name.startswith("."))
            inner = [os.path.join(folder, name) for name in subfolders]
            waiting += [path for path in inner if os.path.islink(path)]  # os.walk enters none


def visible(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield the files whose names match, at any depth (``walk``)."""
    for inner, _, files in walk(folder):
        for name in fnmatch.filter(files, pattern):
            yield Path(inner, name)


_BESIDE = {".bin", ".csv", ".json", ".md", ".mtl", ".tga", ".txt", ".png", ".jpg", ".jpeg", ".webp"}


def warn_of_others(folder: Path, files: Iterable[Path], known: Container[str]) -> None:
    """Warn of the files of a folder that are not read because of their suffixes.

    Files that often accompany others, such as textures, count as known.
    """
    if others := other_kinds((f for f in files if f.suffix.lower() not in _BESIDE), known):
        warnings.warn(f"{folder}: {others} skipped", FileWarning, stacklevel=2)


def other_kinds(files: Iterable[Path], known: Container[str]) -> str:
    """Return the count and the suffixes of files without a known one; nothing if there are none.

    Hidden files do not count.
    """
    suffixes = [path.suffix.lower() for path in files if not path.name.startswith(".")]
    others = [suffix for suffix in suffixes if suffix not in known]
    if not others:
        return ""
    kinds = sorted({suffix or "no suffix" for suffix in others})
    shown = ", ".join(kinds[:9]) + ", ..." * (len(kinds) > 9)
    return f"{len(others)} file{'s' * (len(others) > 1)} of other kinds ({shown})"


def plain_file(path: str | Path) -> os.stat_result:
    """Return the status of a plain file, at the end of links.

    Raises:
        UserError: it is missing or another kind of file.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}") from error
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"{path}: not a plain file")
    return status


def write_json(path: str | Path, value: object) -> None:
    """Write ``value`` as indented JSON, atomically; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, atomically; surrogates, as of file names, are escaped.

    Raises:
        UserError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))


def check_folder_name(path: Path) -> None:
    """Refuse a new folder with the name of a file, such as ``model.glb``.

    Raises:
        UserError: the name has such an ending, and there is no folder of that name.
    """
    kind, coding = _FILE_NAMES.guess_type(path.name)
    if (kind or coding or path.suffix.lower() in _FILE_SUFFIXES) and not path.exists():
        raise UserError(f"{path}: looks like a file, but the results need a folder; give one")


def output_folder(path: str | Path) -> Path:
    """Make a folder with its parents, check that it is writable, and sweep it.

    Raises:
        UserError: it is a file or has a file's name, or cannot be created or written.
    """
    path = Path(path)
    check_folder_name(path)
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
    """Lock a folder for this process; the system releases the lock when the process ends.

    The file ``.lock`` in the folder stays, with the pid of its last owner.

    Args:
        folder: exists.
        what: verb for the message: "trains", "runs".

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
        raise UserError(f"cannot lock {folder}: {write_error(error) or error}") from error
    try:
        with suppress(OSError):  # a full disk: the lock holds all the same
            path.write_text(f"{os.getpid()}\n", encoding="utf-8")
        yield
    finally:
        lock.release()


def sha256_of_all(paths: Iterable[Path], folder: Path) -> str:
    """Return the SHA-256 of the names of files in a folder and their SHA-256s, sorted by path.

    An unreadable file counts as "unreadable" and does not stop the others.
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
    """Return the SHA-256 of a file, 64 hexadecimal digits.

    Raises:
        UserError: the file cannot be read, or is not a plain file.
    """
    digest = hashlib.sha256()
    plain_file(path)  # a pipe or a device has no end
    try:
        with open(path, "rb") as file:
            while part := file.read(_READ):
                digest.update(part)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    return digest.hexdigest()


def check_sha256(path: str | Path, want: str) -> None:
    """Compare a file's SHA-256 with ``want``, 64 hexadecimal digits.

    Raises:
        UserError: the file cannot be read or has another content.
    """
    got = sha256(path)
    if got != want:
        raise UserError(f"{path}: SHA-256 is {got}, expected {want}")
