"""Other packages' interfaces over our kernels, under their names or ours."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

# Versions of the interfaces.
VERSIONS = {
    "mamba_ssm": "2.3.2",
    "causal_conv1d": "1.7.0",
    "gsplat": "1.5.3",
    "diff_gaussian_rasterization": "0.0.0",
    "simple_knn": "0.0.0",
}
# Modules replaced in an installed gsplat; the others need only torch.
_OF_GSPLAT = (
    *("gsplat", "gsplat.cuda._wrapper", "gsplat.relocation", "gsplat.rendering"),
    *("gsplat.cuda_legacy", "gsplat.cuda_legacy._torch_impl", "gsplat.cuda_legacy._wrapper"),
)
_HERE = __name__
__all__ = ["take_names"]


def take_names(*packages: str) -> None:
    """Make ``import mamba_ssm`` and so on load the modules of this folder.

    They are the packages of ``VERSIONS``, and extension modules, which suffice for forks.

    Call it once, before the first of these imports; it holds for the whole process.
    ``importlib.metadata`` reports their versions. An installed gsplat keeps its parts without CUDA
    (strategies, exporters, helpers), which then call our functions.

    Args:
        packages: some of ``VERSIONS`` and ``extensions.EXTENSIONS``; all by default.

    Raises:
        ImportError: a package of that name has been imported already.
        ValueError: another name.
    """
    from .extensions import EXTENSIONS, extension

    known = *VERSIONS, *EXTENSIONS
    for name in packages or known:
        if name not in known:
            raise ValueError(f"package must be one of {', '.join(known)}, got {name!r}")
        if name in sys.modules:
            raise ImportError(f"{name} is already imported: call this before importing it")
    for name in packages or known:
        if name in EXTENSIONS:
            sys.modules[name] = extension(name)
            continue
        ours = importlib.import_module(f"{_HERE}.{name}")
        theirs = importlib.util.find_spec(name) if name == "gsplat" else None
        folders = getattr(ours, "__path__", ())  # none of a single module
        for _, path, _ in pkgutil.walk_packages(folders, f"{ours.__name__}."):
            if not path.endswith("gsplat.strategy"):  # it is gsplat's own and loads gsplat
                importlib.import_module(path)
        for path, module in list(sys.modules.items()):
            under = path.removeprefix(f"{_HERE}.")
            if under.partition(".")[0] == name and (theirs is None or under in _OF_GSPLAT):
                sys.modules[under] = module
        if theirs is not None:
            sys.modules[name] = _overlay(ours, name, theirs.submodule_search_locations)
    if not any(isinstance(finder, _Versions) for finder in sys.meta_path):
        sys.meta_path.append(_Versions())


def _overlay(ours: ModuleType, name: str, folders: Any) -> ModuleType:
    """Make a package with our names that finds its other modules in the given folders."""
    package = type(ours)(name, ours.__doc__)
    identity = {"__name__", "__package__", "__loader__", "__spec__"}
    vars(package).update({key: value for key, value in vars(ours).items() if key not in identity})
    package.__path__ = list(folders)
    package.__spec__ = importlib.util.spec_from_loader(name, None, is_package=True)
    return package


class _Versions(importlib.metadata.DistributionFinder):
    """Finder of the versions of replaced packages, after the installed ones."""

    def find_spec(self, *_: Any) -> None:
        """Find no module: all are imported already."""

    def find_distributions(
        self, context: importlib.metadata.DistributionFinder.Context | None = None
    ) -> Iterator[importlib.metadata.Distribution]:
        asked = getattr(context, "name", None)
        for name, version in VERSIONS.items():
            if asked and asked.lower().replace("-", "_") == name and name in sys.modules:
                yield _Distribution(name, version)


class _Distribution(importlib.metadata.Distribution):
    def __init__(self, name: str, version: str):
        self._text = f"Name: {name}\nVersion: {version}\n"

    def read_text(self, filename: str) -> str | None:
        return self._text if filename == "METADATA" else None

    def locate_file(self, path: Any) -> Any:
        return path
