"""Packages of the project and the imports that each may have, for docs/architecture.md.

A name is the Python package's without ``gamba_warp.``. Four groups of modules have other names:
``core`` (the modules directly in gamba_warp/), ``versions``, ``public`` (gamba_warp/__init__.py)
and ``cli`` (the console script, and every ``__main__``).
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from .imports import Import


@dataclass(frozen=True)
class Package:
    """Contents and allowed imports of a package.

    Attributes:
        holds: its contents, in a few words.
        may: packages that it may import anywhere.
        later: packages that it may import only inside functions or by a string.
    """

    holds: str
    may: tuple[str, ...] = ()
    later: tuple[str, ...] = ()


_OPS = (
    *("kernels.selective_scan", "kernels.causal_conv1d", "kernels.rasterize", "kernels.ssim"),
    "kernels.triangles",
)
_KERNELS = ("versions", "kernels.runtime", *_OPS, "kernels")
_BENCH = tuple(f"kernels.bench{part}" for part in ("", ".core", ".cases", ".static"))
_STRESS = tuple(f"kernels.stress{part}" for part in ("", ".core", ".oracles", ".cases"))
_CORE = (*_KERNELS, "core")
_READERS = (*_CORE, "untrusted")
_MODEL = ("model.config", "model.parts", "model")
_LIBRARY = (*_READERS, "data", "formats", "vision", *_MODEL)
_RESULTS = (
    *(*_LIBRARY, "photo", "trajectories", "surfaces", "viewer", "fitting"),
    "pages",
)
_MEASURES = (*_RESULTS, *_BENCH, *_STRESS)
_TRAIN_DATA = ("train.data", "train.data.made", "train.sources")
_TRAIN = ("train.config", "train.objective", "train", *_TRAIN_DATA)
_EVAL = ("eval", "eval.views", "eval.shapes")

PACKAGES = {
    "versions": Package("versions of this package and the libraries"),
    "kernels.runtime": Package("views of tensors, launches, threads, lanes", ("versions",)),
    "kernels.selective_scan": Package("Mamba's scan", ("versions", "kernels.runtime")),
    "kernels.causal_conv1d": Package(
        "the convolution before the scan", ("versions", "kernels.runtime")
    ),
    "kernels.ssim": Package(
        "1 - SSIM of pictures and its gradient", ("versions", "kernels.runtime")
    ),
    "kernels.triangles": Package("intersecting faces", ("versions", "kernels.runtime")),
    "kernels.rasterize": Package("Gaussians to pictures", ("versions", "kernels.runtime")),
    "kernels": Package("the public operators, loaded when used", ("versions",), _OPS),
    "kernels.bench.core": Package(
        "definition of a case, the clock, reports", ("versions", "kernels.runtime")
    ),
    "kernels.bench": Package("comparisons with other packages", (*_KERNELS, "kernels.bench.core")),
    "kernels.bench.cases": Package(
        "one file per subject", (*_KERNELS, "kernels.bench.core", "kernels.bench")
    ),
    "kernels.bench.static": Package(
        "registers and stack of the CUDA kernels, without a GPU", (*_KERNELS, "kernels.bench.core")
    ),
    "kernels.stress.core": Package(
        "definition of a case, the runner, reports", ("versions", "kernels.runtime")
    ),
    "kernels.stress.oracles": Package(
        "the formulas in float64", ("kernels.stress.core", "kernels.rasterize")
    ),
    "kernels.stress.cases": Package(
        "one file per subject", (*_KERNELS, "kernels.stress.core", "kernels.stress.oracles")
    ),
    "kernels.stress": Package("parent of its three packages"),
    "core": Package("Gaussians, cameras, images, rendering, files, errors", _KERNELS),
    "compat": Package("other packages' interfaces over our kernels", _CORE),
    "untrusted": Package("validation of untrusted files", _CORE),
    "data": Package("datasets and preprocessing", _READERS),
    "formats": Package(".ply, .splat, .glb, meshes, their headers", _READERS),
    "vision": Package("VGG16, LPIPS, and the download of their weights", _READERS),
    "model.config": Package("every option of the network", _READERS),
    "model.parts": Package("tokens, blocks, decoders", (*_READERS, "model.config")),
    "model": Package(
        "the network, its encoders and its files",
        (*_READERS, "data", "formats", "vision", "model.config", "model.parts"),
        ("photo",),
    ),
    "photo": Package("cut-outs of photographs", (*_READERS, "data", "vision")),
    "trajectories": Package("camera paths, their files, movies", (*_READERS, "data")),
    "surfaces": Package("Gaussians to meshes", (*_LIBRARY, "trajectories")),
    "viewer": Package("the 3D viewer and its pages", (*_READERS, "formats")),
    "fitting": Package("one object by optimisation", (*_LIBRARY, "compat")),
    "pages": Package(
        "pages, charts, turntables",
        (*_LIBRARY, "photo", "trajectories", "surfaces", "viewer", "fitting"),
    ),
    "measure": Package("benchmark and stress cases that need the model", _MEASURES),
    "train.data.made": Package("procedural objects, made from a seed", _LIBRARY),
    "train.data": Package("furniture, rendering of meshes", (*_LIBRARY, "train.data.made")),
    "train.sources": Package(
        "published datasets, packs; commands of data",
        (*_LIBRARY, "train.data", "train.data.made"),
    ),
    "train.config": Package("the options of a run", _LIBRARY),
    "train.objective": Package("the losses", (*_LIBRARY, "train.config")),
    "train": Package(
        "batches, loop, checkpoints",
        (*_LIBRARY, "train.config", "train.objective", *_TRAIN_DATA),
        ("pages",),
    ),
    "eval": Package("the report that both evaluations share", _RESULTS),
    "eval.views": Package("PSNR, SSIM, LPIPS; baselines", (*_RESULTS, "eval")),
    "eval.shapes": Package("Chamfer, IoU, F-score", (*_RESULTS, "eval")),
    "gpu_check": Package("the checks on a CUDA machine", (*_MEASURES, "measure")),
    "ablation": Package(
        "rows trained and evaluated alike",
        _RESULTS,
        ("measure", *_TRAIN, *_EVAL),
    ),
    "commands": Package(
        "commands, by subject",
        (*_MEASURES, "measure", "ablation", "gpu_check"),
        (*_TRAIN, *_EVAL),
    ),
    "app": Package("the local web app", _RESULTS),
    "cli": Package(
        "finds the command, parses, calls",
        ("versions", "core"),
        ("commands", "app", "gpu_check", "ablation", *_TRAIN, *_EVAL),
    ),
    "public": Package(
        "import gamba_warp: names loaded when used", ("versions", "kernels"), _RESULTS
    ),
}

# ``gamba`` and the equivalent ``python -m`` commands. (gpu_check has its own: it needs no tyro.)
ENTRY_POINTS = ("cli", "__main__", "train.__main__", "eval.__main__", "kernels.bench.__main__")
# Every kernel knows tensors and nothing else.
KERNEL_LIBRARIES = {"numpy", "torch", "warp"}
# These need system libraries that a minimal machine lacks: only functions that use them may fail.
ONLY_INSIDE_FUNCTIONS = {"open3d", "pymeshlab"}
# An oracle shares only constants with its kernel (and the torch formula of the harmonics, which is
# itself an oracle).
ORACLES = ("kernels.stress.oracles", "reference")
ORACLES_MAY = ("constants", "harmonics.formula", "kernels.stress.core", "kernels.stress.oracles")


def short(module: str) -> str:
    """The name of a module without ``gamba_warp.``."""
    return module.removeprefix("gamba_warp.")


def package_of(module: str) -> str:
    """Return the package of a module.

    Raises:
        KeyError: the folder is not in ``PACKAGES`` yet.
    """
    name = short(module)
    if name == "gamba_warp":
        return "public"
    if name == "versions":
        return "versions"
    if name in ENTRY_POINTS:
        return "cli"
    package = name
    while package and package not in PACKAGES:
        package = package.rpartition(".")[0]
    if package:
        return package
    if "." in name:
        raise KeyError(f"{module} is in no package: add its folder to PACKAGES")
    return "core"


def refused(entry: Import) -> str | None:
    """Return the reason why an import is not allowed, or None."""
    reason = _library(entry) if entry.target is None else _ours(entry, entry.target)
    return reason and f"{entry.source}, line {entry.line}: {reason}"


def _library(entry: Import) -> str | None:
    root = entry.name.split(".")[0]
    if root in ("kernels", "train", "eval"):
        return f"write gamba_warp.{entry.name}: by its folder's name it would be loaded twice"
    if root in ONLY_INSIDE_FUNCTIONS and not entry.lazy:
        return f"{root} may be imported only inside functions"
    known = root in KERNEL_LIBRARIES or root in sys.stdlib_module_names
    if short(entry.source).startswith("kernels") and not known:
        return f"kernels import only {', '.join(sorted(KERNEL_LIBRARIES))}, not {root}"
    return None


def _ours(entry: Import, target: str) -> str | None:
    last = entry.name.rpartition(".")[2]
    if last.startswith("_") and not last.startswith("__") and entry.source != target:
        return f"{last} is private to {target}"
    devices = {"cpu", "cuda"}
    mine, theirs = (devices & set(name.split(".")) for name in (entry.source, target))
    if mine and theirs and mine != theirs:
        return f"code of one device imports {target}, of the other"
    source = short(entry.source)
    if source.startswith(ORACLES[0]) or source.endswith(ORACLES[1]):
        if not any(part in short(entry.name) for part in ORACLES_MAY):
            return f"an oracle shares only constants with its kernel, not {entry.name}"
    here, there = package_of(entry.source), package_of(target)
    if (
        here == there
        or there in PACKAGES[here].may
        or (entry.lazy and there in PACKAGES[here].later)
    ):
        return None
    when = "only inside functions" if there in PACKAGES[here].later else "not"
    return f"the package {here} may import {there} {when} ({entry.name})"


def edges(entries: Iterable[Import], by_package: bool) -> dict[str, set[str]]:
    """Return the import graph: packages by any import, or modules by their load-time imports."""
    found: dict[str, set[str]] = defaultdict(set)
    for entry in entries:
        if entry.target and (by_package or not entry.lazy):
            pair = (entry.source, entry.target)
            here, there = map(package_of, pair) if by_package else pair
            if here != there:
                found[here].add(there)
    return dict(found)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Return a cycle of the graph, or an empty list."""
    done: set[str] = set()

    def walk(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node in done:
            return []
        for following in sorted(graph.get(node, ())):
            found = walk(following, [*path, node])
            if found:
                return found
        done.add(node)
        return []

    return next(filter(None, (walk(node, []) for node in sorted(graph))), [])
