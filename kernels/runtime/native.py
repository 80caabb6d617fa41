"""C++ of the kernels: whole ``.inl`` files beside an operator, as text for ``wp.func_native``."""

from __future__ import annotations

import re
from pathlib import Path

_INCLUDE = re.compile(r'^[ \t]*#include "(.+)"[ \t]*\n', re.MULTILINE)


def native(path: Path, **defines: object) -> str:
    """The text of a C++ file whose parameters are macros, defined before it and undefined after it.

    Files that it includes stand in their place, so that the text holds all that is compiled: the
    hash of a Warp module, by which compiled kernels are kept, follows every file's contents.

    Args:
        path: of the file; an ``#include "..."`` in it is relative to it.
        **defines: macros; a bool is ``true`` or ``false``, a float has all its digits and an f.

    Raises:
        OSError: a file cannot be read.
    """

    def value(x: object) -> str:
        if isinstance(x, bool):
            return str(x).lower()
        return f"{x!r}f" if isinstance(x, float) else str(x)

    before = "".join(f"#define {name} {value(x)}\n" for name, x in defines.items())
    after = "".join(f"#undef {name}\n" for name in defines)
    return f"\n{before}{_read(path)}{after}"


def _read(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda found: _read(path.parent / found[1]), text)
