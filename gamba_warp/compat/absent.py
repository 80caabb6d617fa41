"""Placeholders for missing names of another package: importable, but they raise when used.

Most programs import more than they call, so a missing name does not fail at the import. Only inside
a ``try`` that catches ImportError it does: there the program has another way.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import linecache
import sys
from importlib.machinery import ModuleSpec
from types import FrameType, ModuleType
from typing import Any, NoReturn

from . import VERSIONS

_CATCHES = {"ImportError", "ModuleNotFoundError", "Exception", "BaseException"}


class _Absent(type):
    """Metaclass of placeholders, which are classes so that annotations may use them."""

    def __call__(cls, *args: Any, **kwargs: Any) -> NoReturn:
        raise NotImplementedError(cls.__doc__)

    __instancecheck__ = __subclasscheck__ = __call__

    def __getattr__(cls, name: str) -> NoReturn:
        if name.startswith("_"):  # probed by Python and its tools in any class
            raise AttributeError(f"{cls.__name__} has no attribute {name!r}")
        raise NotImplementedError(cls.__doc__)


class _Module(ModuleType):
    """Module with placeholders, found after its own names and its ``__getattr__``'s."""

    _absent: dict[str, _Absent]

    def __getattr__(self, name: str) -> Any:
        if name not in self._absent:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        if _caught(sys._getframe(1)):
            raise ModuleNotFoundError(self._absent[name].__doc__, name=self.__name__)
        return self._absent[name]


def _caught(frame: FrameType | None) -> bool:
    """Return whether a frame's import is in a ``try`` that catches ImportError.

    That may be around the import of the frame's module, or of one that imports it.
    """
    while frame and frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    if frame is None:
        return False
    back, imported = frame.f_back, frame.f_code.co_name == "<module>"
    if imported and back and back.f_code.co_filename.startswith("<frozen importlib"):
        return _in_try(frame) or _caught(back)
    return _in_try(frame)


def _in_try(frame: FrameType) -> bool:
    """Return whether the line of a frame is in a ``try`` that catches ImportError."""
    try:
        tree = ast.parse("".join(linecache.getlines(frame.f_code.co_filename, frame.f_globals)))
    except SyntaxError:  # the file has changed
        return False
    for node in ast.walk(tree):
        if isinstance(node, ast.Try):
            inside = node.body[0].lineno <= frame.f_lineno <= (node.body[-1].end_lineno or 0)
            types = [
                x.type and {getattr(y, "id", "") for y in ast.walk(x.type)} for x in node.handlers
            ]
            if inside and any(names is None or names & _CATCHES for names in types):
                return True
    return False


def complete(
    package: str, original: str, why: str, names: dict[str, str], dynamic: tuple[str, ...] = ()
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
        dynamic: names of the package's ``__getattr__``.

    Returns:
        The missing names by module.
    """
    root = sys.modules[package]
    vars(root)["__version__"] = VERSIONS[package.rpartition(".")[2]]
    defined = {*vars(root), *dynamic}
    missing = {}
    for path, text in names.items():
        module, listed = _module(f"{package}.{path}".rstrip(".")), set(text.split())
        if listed & defined:
            vars(module)["__getattr__"] = _of_root(root, listed & defined)
        missing[path] = sorted(listed - defined - {*vars(module)})
        lines = {name: f"{original}'s {name} is not here: {why}" for name in missing[path]}
        vars(module)["_absent"] = {x: _absent(x, module, line) for x, line in lines.items()}
        module.__class__ = _Module
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
            module = importlib.util.module_from_spec(ModuleSpec(name, None, is_package=True))
            sys.modules[name] = vars(above)[last] = module
    return importlib.import_module(name)
