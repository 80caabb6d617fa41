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
from graphlib import CycleError, TopologicalSorter

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
    may: tuple[str, ...]
    later: tuple[str, ...]


# Names for several packages in the table below.
_GROUPS = {
    "OPS": "kernels.selective_scan kernels.causal_conv1d kernels.rasterize "
    "kernels.ssim kernels.triangles",
    "KERNELS": "versions kernels.runtime OPS kernels",
    "BENCH": "kernels.cases kernels.bench",
    "READERS": "KERNELS core untrusted",
    "MODEL": "model.config model.parts",
    "LIBRARY": "READERS data formats vision MODEL model",
    "RESULTS": "LIBRARY photo trajectories surfaces viewer fitting pages",
    "MEASURES": "RESULTS BENCH kernels.stress",
    "TRAIN_DATA": "train.data train.data.made train.sources",
    "TRAIN": "train.config train.objective train TRAIN_DATA",
    "EVAL": "eval eval.views eval.shapes",
}
# package | holds | may import | may import inside functions
_TABLE = """
versions | versions of this package and the libraries | |
kernels.runtime | views of tensors, launches, threads, lanes | versions |
kernels.selective_scan | Mamba's scan | versions kernels.runtime |
kernels.causal_conv1d | the convolution before the scan | versions kernels.runtime |
kernels.ssim | 1 - SSIM of pictures and its gradient | versions kernels.runtime |
kernels.triangles | intersecting faces | versions kernels.runtime |
kernels.rasterize | Gaussians to pictures | versions kernels.runtime |
kernels | the public operators, loaded when used | versions | OPS
kernels.bench | the clock, suites, reports, other packages | KERNELS kernels.cases |
kernels.cases | inputs by name and seed, formulas in float64, limits | KERNELS |
kernels.stress | the runner of random cases | versions kernels.runtime kernels.cases |
core | Gaussians, cameras, images, rendering, files, errors | KERNELS |
compat | other packages' interfaces over our kernels | READERS |
untrusted | validation of untrusted files | KERNELS core |
data | datasets and preprocessing | READERS |
formats | .ply, .splat, .glb, meshes, their headers | READERS |
vision | VGG16, LPIPS, and the download of their weights | READERS |
model.config | every option of the network | READERS |
model.parts | tokens, blocks, decoders | READERS model.config |
model | the network, its encoders and its files | READERS data formats vision MODEL | photo
photo | cut-outs of photographs | READERS data vision |
trajectories | camera paths, their files, movies | READERS data |
surfaces | Gaussians to meshes | LIBRARY trajectories |
viewer | the 3D viewer and its pages | READERS formats |
fitting | one object by optimisation | LIBRARY compat |
pages | pages, charts, turntables | LIBRARY photo trajectories surfaces viewer fitting |
measure | benchmark and stress cases that need the model | MEASURES |
train.data.made | procedural objects, made from a seed | LIBRARY |
train.data | furniture, rendering of meshes | LIBRARY train.data.made |
train.sources | published datasets, shards; commands of data | LIBRARY train.data train.data.made |
train.config | the options of a run | LIBRARY |
train.objective | the losses | LIBRARY train.config |
train | batches, loop, checkpoints | LIBRARY BENCH train.config train.objective TRAIN_DATA | pages
eval | the report that both evaluations share | RESULTS |
eval.views | PSNR, SSIM, LPIPS; baselines | RESULTS eval |
eval.shapes | Chamfer, IoU, F-score | RESULTS eval |
gpu_check | the tests and the benchmark on a GPU | KERNELS BENCH core measure |
ablation | rows trained and evaluated alike | RESULTS | measure TRAIN EVAL
commands | commands, by subject | MEASURES measure ablation | TRAIN EVAL
app | the local web app | RESULTS |
cli | parses and calls | versions core untrusted | commands app ablation TRAIN EVAL
public | import gamba_warp: names loaded when used | versions kernels | RESULTS
"""


def _names(text: str) -> tuple[str, ...]:
    """Return the packages of a cell, its groups resolved."""
    names = text.split()
    return tuple(p for n in names for p in (_names(_GROUPS[n]) if n in _GROUPS else (n,)))


def _package(row: str) -> tuple[str, Package]:
    name, holds, may, later = (cell.strip() for cell in row.split("|"))
    return name, Package(holds, _names(may), _names(later))


PACKAGES = dict(map(_package, _TABLE.strip().split("\n")))

# ``gamba`` and the equivalent ``python -m`` commands. (gpu_check has its own: it needs no tyro.)
ENTRY_POINTS = ("cli", "__main__", "train.__main__", "eval.__main__", "kernels.bench.__main__")
# Every kernel knows tensors and nothing else.
KERNEL_LIBRARIES = {"numpy", "torch", "warp"}
# These need system libraries that a minimal machine lacks: only functions that use them may fail.
ONLY_INSIDE_FUNCTIONS = {"open3d", "pymeshlab"}
# An oracle shares only constants with its kernel (and the torch formula of the harmonics, which is
# itself an oracle).
ORACLES = ("_oracle", "reference")
ORACLES_MAY = ("constants", "harmonics.formula", "kernels.cases")


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
    if name in (*ENTRY_POINTS, "usage"):
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
    source = short(entry.source)
    known = root in KERNEL_LIBRARIES or root in sys.stdlib_module_names
    known |= root == "hypothesis" and source.startswith("kernels.stress")
    if source.startswith("kernels") and not known:
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
    if source.endswith(ORACLES):
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
    """Return the graph of imports of packages, or of files, inside functions too.

    Strings count for packages alone: a suffix such as ``.gltf`` looks like a module. A package's
    ``__init__`` loads its public names on demand, so no file depends on it.
    """
    found: dict[str, set[str]] = defaultdict(set)
    entries = list(entries)
    parents = {entry.source.rpartition(".")[0] for entry in entries}
    for entry in entries:
        if entry.target and (by_package or not (entry.text or entry.target in parents)):
            pair = (entry.source, entry.target)
            here, there = map(package_of, pair) if by_package else pair
            if here != there:
                found[here].add(there)
    return dict(found)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Return a cycle of the graph, or an empty list."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []
