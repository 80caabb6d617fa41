"""Torch's files of strangers: plain values and tensors that the file really holds, or one line."""

from __future__ import annotations

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

from ..errors import UserError

MAX_VALUES = 1_000_000  # in all lists and dictionaries together; ours have some thousands
MAX_DEPTH = 16  # levels of lists and dictionaries; ours have up to 6
_OLD = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # how files begin that are no zip


def read_torch(path: str | Path, advice: str = "damaged, or not torch's") -> Any:
    """Reads a file of ``torch.save`` onto the CPU; nothing in it is run.

    Args:
        path: the file.
        advice: what the error says about a file that cannot be read.

    Returns:
        Dictionaries, lists and tuples of numbers, texts, None and dense tensors. All of the
        tensors together take at most twice the file's size (two names may share one).

    Raises:
        UserError: no plain file, damaged (each byte is checked where the file has checksums, as
            zip files have), or something else is in it.
    """
    import torch

    path = Path(path)
    try:
        if not path.is_file():
            raise UserError(f"{path}: {'not a plain file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        zipped = zipfile.is_zipfile(path)
        if zipped:
            _check_zip(path, size)
        else:
            with open(path, "rb") as file:
                if file.read(len(_OLD)) != _OLD:  # torch would ask for what any bytes say
                    raise ValueError("it does not begin as torch's files do")
        # Read as a map, a tensor cannot reach beyond the file; torch's other reader believes what
        # the file says of the size of a tensor. Only old files, which are no zip, need that one.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's are many lines long
            value = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
        return _Copy(size).of(value)
    except UserError:
        raise
    except Exception as error:  # pickle, zip and torch raise errors of a dozen classes
        refused = re.search(r"GLOBAL (\S+)", str(error))
        if refused:  # torch says it behind lines that advise to let the file run
            named = f"it holds {refused[1][:100]!r}, of which torch reads none"
            raise UserError(f"{path}: {advice} ({named})") from error
        lines = str(error).strip().splitlines()
        reason = lines[0][:200] if lines else type(error).__name__
        raise UserError(f"{path}: {advice} ({reason})") from error


def _check_zip(path: Path, size: int) -> None:
    """Refuses packed members, members that overlap, and any whose checksum is wrong."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("its members are packed, which torch never does")
        if sum(member.file_size for member in members) > size:
            raise ValueError("its members are larger than the file")
        wrong = archive.testzip()
    if wrong is not None:
        raise ValueError(f"the checksum of {wrong[:80]} is wrong")


class _Copy:
    """Copies values out of a file, up to limits: a value may be shared, or hold itself."""

    def __init__(self, size: int) -> None:
        self.bytes, self.values = 2 * size, MAX_VALUES

    def of(self, value: Any, depth: int = 0) -> Any:
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
                raise ValueError("a key is neither a text nor a number")
            return {k: self.of(v, depth + 1) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            items = [self.of(item, depth + 1) for item in value]
            return items if isinstance(value, list) else tuple(items)
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        raise ValueError(f"it holds a {type(value).__name__}")
