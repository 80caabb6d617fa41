"""Untrusted files of ``torch.save``: plain values and tensors within the size of the file."""

from __future__ import annotations

import re
import tarfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

from ..errors import UserError, first_line

MAX_VALUES = 1_000_000  # in all lists and dictionaries; ours have some thousands
MAX_DEPTH = 16  # levels of lists and dictionaries; ours have up to 6
_OLD = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # start of files that are not zip


def read_torch(path: str | Path, advice: str = "damaged, or not torch's") -> Any:
    """Read a file of ``torch.save`` onto the CPU without running any code of it.

    Args:
        path: the file.
        advice: text of the error for an unreadable file.

    Returns:
        Dictionaries, lists and tuples of numbers, texts, None and dense tensors. All tensors take
        at most twice the file's size (two names may share one).

    Raises:
        UserError: it is not a plain file, damaged (zip files have checksums, which are verified),
            or has values of other types.
    """
    import torch

    path = Path(path)
    try:
        if not path.is_file():
            raise UserError(f"{path}: {'not a plain file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        if tarfile.is_tarfile(path):  # which may hold a zip
            raise ValueError("a tar archive; unpack it first")
        zipped = zipfile.is_zipfile(path)
        if zipped:
            _check_zip(path, size)
        else:
            with open(path, "rb") as file:
                if file.read(len(_OLD)) != _OLD:  # else torch would allocate arbitrary sizes
                    raise ValueError("it does not begin like a torch file")
        # Memory-mapped, a tensor cannot reach beyond the file; torch's other reader trusts the
        # stated size of a tensor. Only old files, which are not zip, need that one.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's warnings have many lines
            value = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
        return _Copier(size).copy(value)
    except UserError:
        raise
    except Exception as error:  # pickle, zip and torch raise a dozen types
        refused = re.search(r"GLOBAL (\S+)", str(error))
        if refused:  # torch's message advises to run the file
            named = f"it holds {refused[1][:100]!r}, which torch does not load"
            raise UserError(f"{path}: {advice} ({named})") from error
        raise UserError(f"{path}: {advice} ({first_line(error)[:200]})") from error


def _check_zip(path: Path, size: int) -> None:
    """Raise for compressed or overlapping members, and for wrong checksums."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if not any(member.filename.endswith("data.pkl") for member in members):
            names = ", ".join(member.filename for member in members[:3])
            raise ValueError(f"a zip archive of {names[:200]}; unpack it first")
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("its members are compressed, which torch never does")
        if sum(member.file_size for member in members) > size:
            raise ValueError("its members are larger than the file")
        wrong = archive.testzip()
    if wrong is not None:
        raise ValueError(f"the checksum of {wrong[:80]} is wrong")


class _Copier:
    """Copy of a file's values within limits: a value may be shared, or contain itself."""

    def __init__(self, size: int) -> None:
        self.bytes, self.values = 2 * size, MAX_VALUES

    def copy(self, value: Any, depth: int = 0) -> Any:
        import torch

        self.values -= 1
        if self.values < 0:
            raise ValueError(f"it holds over {MAX_VALUES:,} values")
        if depth > MAX_DEPTH:
            raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")
        if isinstance(value, torch.Tensor):
            if value.layout != torch.strided or value.is_quantized or value.device.type != "cpu":
                raise ValueError("it holds a tensor that is not dense")
            self.bytes -= value.numel() * value.element_size()
            if self.bytes < 0:
                raise ValueError("its tensors are larger than the file")
            return value.detach().clone(memory_format=torch.contiguous_format)
        if isinstance(value, dict):
            if not all(isinstance(key, (str, int)) for key in value):
                raise ValueError("a key is neither text nor a number")
            return {k: self.copy(v, depth + 1) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            items = [self.copy(item, depth + 1) for item in value]
            return items if isinstance(value, list) else tuple(items)
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        raise ValueError(f"it holds a {type(value).__name__}")
