"""Public names of a package that are loaded when they are used, so that importing it is quick."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType


def load_when_used(package: str, sources: dict[str, str]) -> None:
    """Gives a package names that are imported from its modules when they are first used.

    The names become properties of the package's class. A module's ``__getattr__`` (PEP 562) would
    not do, because it is asked only where there is no attribute: importing the module
    ``gamba_warp.render`` would set the attribute ``render`` to the module, and the function of
    that name could not be reached any more. A property is unchanged.

    Args:
        package: the package's ``__name__``.
        sources: by name, the module that defines it, relative to the package.
    """
    members: dict[str, object] = {name: _loaded(name, sources[name], package) for name in sources}
    members["__dir__"] = lambda self: sorted({*ModuleType.__dir__(self), *sources})
    sys.modules[package].__class__ = type("LazyPackage", (ModuleType,), members)


def _loaded(name: str, source: str, package: str) -> property:
    def get(self: ModuleType) -> object:
        found = vars(self).get(name)
        return getattr(importlib.import_module(source, package), name) if found is None else found

    def put(self: ModuleType, value: object) -> None:
        if not isinstance(value, ModuleType):  # Python sets a submodule's name to the module
            vars(self)[name] = value

    return property(get, put)
