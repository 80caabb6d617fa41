"""Placeholders for missing names of another package: importable, but they raise when used.

Programs import more than they call, so a missing name should not fail at the import.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NoReturn

from . import VERSIONS


class _Absent(type):
    """Metaclass of placeholders, which are classes so that annotations may use them."""

    def __call__(cls, *args: Any, **kwargs: Any) -> NoReturn:
        raise NotImplementedError(cls.__doc__)

    __instancecheck__ = __subclasscheck__ = __call__

    def __getattr__(cls, name: str) -> NoReturn:
        if name.startswith("_"):  # probed by Python and its tools in any class
            raise AttributeError(f"{cls.__name__} has no attribute {name!r}")
        raise NotImplementedError(cls.__doc__)


def complete(
    package: str, original: str, why: str, names: dict[str, str], found: tuple[str, ...] = ()
) -> dict[str, list[str]]:
    """Add the version, and placeholders for the names and modules that a package lacks.

    Calling or subclassing a placeholder, an instance check against it, or access to an attribute
    raises ``NotImplementedError`` with one line.

    Args:
        package: the package's ``__name__``; its own names must exist already.
        original: the name of the other package, for the line.
        why: the end of the line.
        names: by module of the original, relative to it, names separated by blanks. Missing modules
            are made; they take names that the package has from it.
        found: names of the package's ``__getattr__``.

    Returns:
        The missing names by module.
    """
    root = sys.modules[package]
    vars(root)["__version__"] = VERSIONS[package.rpartition(".")[2]]
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
    """Return the module of that name; make an empty one if it is missing."""
    parent, _, last = name.rpartition(".")
    if name not in sys.modules:
        above = _module(parent)
        if importlib.util.find_spec(name) is None:
            made = importlib.util.module_from_spec(ModuleSpec(name, None, is_package=True))
            sys.modules[name] = vars(above)[last] = made
    return importlib.import_module(name)
