"""The folder of Warp's compiled kernels: one that can be written, and what is in it is whole.

Warp loads what it finds there unseen: a machine code file with one wrong bit ends the process, one
that was cut short raises an error at every launch. So each compiled module gets a file of SHA-256s
beside it, which is compared before the module is loaded; what is not whole is named and built
again, once.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import warp as wp

from .system import is_own, user

_SUMS = ".sha256"  # follows the name of a binary


def writable_folder(wanted: Path | None, name: str) -> Path:
    """The folder that is wanted, or a temporary one if that cannot be made and written.

    The temporary one is the user's own and is found again by later processes. That it is used is
    said on the standard error.

    Args:
        wanted: None where the system knows no home.
        name: of the temporary folder.
    """
    reason = "there is no home folder" if wanted is None else _fault(wanted)
    if wanted is not None and reason is None:
        return wanted
    number = user()  # without numbers, the folder of temporary files is the user's own
    folder = Path(tempfile.gettempdir()) / (name if number is None else f"{name}-{number}")
    if _fault(folder) is not None or not _is_private(folder):
        folder = Path(tempfile.mkdtemp(prefix=f"{name}-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    place = reason if wanted is None else f"{wanted} cannot be written ({reason})"
    print(f"gamba: {place}; what is kept there is in {folder} for now", file=sys.stderr)
    return folder


def _fault(folder: Path) -> str | None:
    """Why nothing can be written into a folder, which is made if need be; None if it can."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return error.strerror or type(error).__name__


def _is_private(folder: Path) -> bool:
    """Whether nobody else can put a file there: what is in a cache is run."""
    found = folder.lstat()
    open_to_others = user() is not None and found.st_mode & 0o022  # Windows has no such bits
    return not folder.is_symlink() and is_own(found) and not open_to_others


def prepare_cache() -> None:
    """Sets Warp's folder, if its own cannot be written, and has modules checked as they load."""
    if wp.config.kernel_cache_dir is None:
        named = os.environ.get("WARP_CACHE_PATH")
        wanted = Path(named) if named else _default_folder()
        chosen = writable_folder(wanted, "gamba-warp-kernels")
        if chosen != wanted:
            wp.config.kernel_cache_dir = str(chosen)
            if wanted is not None:
                _copy(wanted / wp.config.version, chosen / wp.config.version)
    _check_modules()


def _default_folder() -> Path | None:
    """Where Warp keeps kernels if nobody says otherwise; None where there is no home.

    Warp goes by its own copy of ``appdirs``, which knows the places of Linux, macOS and Windows.
    """
    from warp._src.thirdparty import appdirs

    found = appdirs.user_cache_dir(appname="warp", appauthor="NVIDIA")
    return None if found.startswith("~") else Path(found)


def _copy(source: Path, target: Path) -> None:
    """Copies kernels that were compiled before, so that they need not be again, all or none."""
    if target.exists() or not source.is_dir():
        return
    copied = Path(tempfile.mkdtemp(prefix=".gamba-part-", dir=target.parent))
    try:
        shutil.copytree(source, copied, dirs_exist_ok=True)
        copied.rename(target)
    except OSError:  # they are compiled again
        shutil.rmtree(copied, ignore_errors=True)


def _check_modules() -> None:
    """Wraps the method by which Warp finds or builds a module; it is not public.

    A Warp without this method loads unchecked, as ever.
    """
    module: Any = wp.Module
    build = getattr(module, "_compile", None)
    if build is None or hasattr(build, "unchecked"):
        return

    def checked(self, device, output_dir=None, output_name=None, *args, **kwargs):
        def run():
            return build(self, device, output_dir, output_name, *args, **kwargs)

        if output_dir is None or output_name is None or not _in_cache(output_dir):
            return run()
        binary = Path(output_dir) / output_name
        if binary.parent.exists() and not is_whole(binary):
            print(f"gamba: damaged kernels, built again: {binary.parent}", file=sys.stderr)
            _remove(binary.parent)
        compiled = run()
        if compiled:
            if not _is_plausible(binary):
                _remove(binary.parent)
                raise OSError(f"cannot write compiled kernels into {binary.parent}: disk full?")
            seal(binary)
        return compiled

    checked.unchecked = build  # type: ignore[attr-defined]
    module._compile = checked


def _in_cache(folder: Any) -> bool:
    cache = wp.config.kernel_cache_dir
    return folder is not None and cache is not None and Path(folder).parent == Path(cache)


def _remove(folder: Path) -> None:
    """Takes a module away by a rename, so that no other process finds half of it."""
    doomed = Path(tempfile.mkdtemp(prefix=".gamba-part-", dir=folder.parent))
    folder.rename(doomed / folder.name)  # onto an empty folder Windows renames nothing
    shutil.rmtree(doomed, ignore_errors=True)


def is_whole(binary: Path) -> bool:
    """Whether a compiled module is as it was written, or, where nobody sealed it, looks whole.

    Args:
        binary: its machine code; a folder without it is whole, since Warp will build it.
    """
    if not binary.exists():
        return True
    sums = binary.with_name(binary.name + _SUMS)
    if not sums.exists():
        if not _is_plausible(binary):
            return False
        seal(binary)
        return True
    try:
        wanted = json.loads(sums.read_bytes())
        return all(_digest(binary.parent / Path(name).name) == wanted[name] for name in wanted)
    except (OSError, ValueError, TypeError, AttributeError):
        return False


def seal(binary: Path) -> None:
    """Writes the SHA-256s of a module's files; without them it is checked less closely."""
    files = [binary, *binary.parent.glob("*.meta")]
    sums = binary.with_name(binary.name + _SUMS)
    try:
        text = json.dumps({path.name: _digest(path) for path in files})
        handle, name = tempfile.mkstemp(prefix=".gamba-part-", dir=binary.parent)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(name, sums)
    except OSError:
        return


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _is_plausible(binary: Path) -> bool:
    """Whether the description of a module is JSON, and its ELF file holds all its sections."""
    try:
        for meta in binary.parent.glob("*.meta"):
            json.loads(meta.read_bytes())
        data = binary.read_bytes()
    except (OSError, ValueError):
        return False
    if binary.suffix not in (".o", ".cubin") or sys.platform != "linux":
        return bool(data)
    if data[:5] != b"\x7fELF\x02" or len(data) < 64:
        return False
    start, size, count = (int.from_bytes(data[a:b], "little") for a, b in _ELF_SECTIONS)
    return start > 0 and start + size * count <= len(data)


_ELF_SECTIONS = ((40, 48), (58, 60), (60, 62))  # e_shoff, e_shentsize, e_shnum of 64 bits
