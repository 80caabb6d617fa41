"""Names of another package that we lack: they can be imported, and say so when they are used.

A program imports more than it calls, and its import line should not end it.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NoReturn


class _Absent(type):
    """The kind of such a name, which is a class, so that an annotation may hold it."""

    def __call__(cls, *args: Any, **kwargs: Any) -> NoReturn:
        raise NotImplementedError(cls.__doc__)

    __instancecheck__ = __subclasscheck__ = __call__

    def __getattr__(cls, name: str) -> NoReturn:
        if name.startswith("_"):  # what Python and its tools look for in any class
            raise AttributeError(f"{cls.__name__} has no attribute {name!r}")
        raise NotImplementedError(cls.__doc__)


def complete(
    package: str, original: str, why: str, names: dict[str, str], found: tuple[str, ...] = ()
) -> dict[str, list[str]]:
    """Gives a package those names and modules of the original that it lacks.

    Calling such a name, subclassing it, asking for its instances or for an attribute of it raises
    ``NotImplementedError`` with one line.

    Args:
        package: the package's ``__name__``; its own names must be there already.
        original: the name of the other package, for the line.
        why: the end of the line.
        names: by module of the original, relative to it, names with blanks between them. A module
            that is not here is made; of its names those that the package has are the package's.
        found: what the package's ``__getattr__`` finds.

    Returns:
        By module the names that are not here.
    """
    root = sys.modules[package]
    own = {name for name, value in vars(root).items() if not isinstance(value, _Absent)} | {*found}
    missing = {}
    for path, text in names.items():
        module, listed = _module(f"{package}.{path}".rstrip(".")), set(text.split())
        if listed & own:
            vars(module)["__getattr__"] = _of_root(root, listed & own)
        missing[path] = sorted(listed - own)
        for name in missing[path]:
            vars(module)[name] = _absent(name, module, f"{original}'s {name} is not here: {why}")
    return {path: lacking for path, lacking in missing.items() if lacking}


def _absent(name: str, module: ModuleType, line: str) -> _Absent:
    def refuse(cls: type) -> NoReturn:
        raise NotImplementedError(line)

    members = {"__module__": module.__name__, "__init_subclass__": classmethod(refuse)}
    return _Absent(name, (), {"__doc__": line, **members})


def _of_root(root: ModuleType, names: set[str]) -> Any:
    def get(name: str) -> Any:
        if name in names:
            return getattr(root, name)
        raise AttributeError(f"no attribute {name!r}")

    return get


def _module(name: str) -> ModuleType:
    """The module of that name; where there is none an empty one is made."""
    parent, _, last = name.rpartition(".")
    if name not in sys.modules:
        above = _module(parent)
        if importlib.util.find_spec(name) is None:
            made = importlib.util.module_from_spec(ModuleSpec(name, None, is_package=True))
            sys.modules[name] = vars(above)[last] = made
    return importlib.import_module(name)
