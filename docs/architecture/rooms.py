"""The rooms of the house, and which room may import which: the rules behind docs/architecture.md.

A room is a folder, or a few modules that belong together. Its name is that of the package without
``gamba_warp.``; four rooms have names of their own: ``words`` (the modules right in gamba_warp/,
which every room uses), ``versions``, ``public`` (gamba_warp/__init__.py) and ``cli`` (the console
script, and every ``__main__``).
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from .imports import Import


@dataclass(frozen=True)
class Room:
    """What a room may import.

    Attributes:
        holds: what is in it, in a few words.
        may: rooms that it may import at any place.
        later: rooms that it may import only when a function needs them, or by a string.
    """

    holds: str
    may: tuple[str, ...] = ()
    later: tuple[str, ...] = ()


_OPS = ("kernels.selective_scan", "kernels.causal_conv1d", "kernels.rasterize", "kernels.ssim")
_KERNELS = ("versions", "kernels.runtime", *_OPS, "kernels")
_BENCH = tuple(f"kernels.bench{part}" for part in ("", ".core", ".cases", ".static"))
_STRESS = tuple(f"kernels.stress{part}" for part in ("", ".core", ".oracles", ".cases"))
_WORDS = (*_KERNELS, "words")
_READERS = (*_WORDS, "untrusted")
_MODEL = ("model.config", "model.parts", "model")
_LIBRARY = (*_READERS, "data", "formats", "vision", *_MODEL)
_RESULTS = (
    *(*_LIBRARY, "photo", "trajectories", "surfaces", "viewer", "fitting"),
    "pages",
)
_MEASURES = (*_RESULTS, *_BENCH, *_STRESS)
_TRAIN = (*("train.config", "train.objective", "train", "train.data", "train.data.made", "train.sources"),)
_EVAL = ("eval", "eval.views", "eval.shapes")

ROOMS = {
    "versions": Room("the version, and those of the libraries"),
    "kernels.runtime": Room("views of tensors, launches, threads, lanes", ("versions",)),
    "kernels.selective_scan": Room("Mamba's scan", ("versions", "kernels.runtime")),
    "kernels.causal_conv1d": Room("the convolution before it", ("versions", "kernels.runtime")),
    "kernels.ssim": Room("1 - SSIM of pictures and its slope", ("versions", "kernels.runtime")),
    "kernels.rasterize": Room("Gaussians to pictures", ("versions", "kernels.runtime")),
    "kernels": Room("the public operators, loaded when used", ("versions",), _OPS),
    "kernels.bench.core": Room(
        "what a case is, the clock, reports", ("versions", "kernels.runtime")
    ),
    "kernels.bench": Room("other packages beside ours", (*_KERNELS, "kernels.bench.core")),
    "kernels.bench.cases": Room(
        "one file a subject", (*_KERNELS, "kernels.bench.core", "kernels.bench")
    ),
    "kernels.bench.static": Room(
        "what the CUDA kernels take, told without a GPU", (*_KERNELS, "kernels.bench.core")
    ),
    "kernels.stress.core": Room(
        "what a case is, the runner, reports", ("versions", "kernels.runtime")
    ),
    "kernels.stress.oracles": Room(
        "the formulas in float64", ("kernels.stress.core", "kernels.rasterize")
    ),
    "kernels.stress.cases": Room(
        "one file a subject", (*_KERNELS, "kernels.stress.core", "kernels.stress.oracles")
    ),
    "kernels.stress": Room("the folder of its three rooms"),
    "words": Room("Gaussians, cameras, images, rendering, files, errors", _KERNELS),
    "compat": Room("other packages' interfaces over our kernels", _WORDS),
    "untrusted": Room("what strangers' files go through first", _WORDS),
    "data": Room("datasets and preprocessing", _READERS),
    "formats": Room(".ply, .splat, .glb, meshes, their headers", _READERS),
    "vision": Room("VGG16, LPIPS, and how their weights are fetched", _READERS),
    "model.config": Room("all that decides what a network computes", _READERS),
    "model.parts": Room("tokens, blocks, decoders", (*_READERS, "model.config")),
    "model": Room(
        "the network, its encoders and its files",
        (*_READERS, "data", "formats", "vision", "model.config", "model.parts"),
        ("photo",),
    ),
    "photo": Room("any photograph to a cut-out object", (*_READERS, "data", "vision")),
    "trajectories": Room("paths of cameras, their files, movies", (*_READERS, "data")),
    "surfaces": Room("Gaussians to meshes", (*_LIBRARY, "trajectories")),
    "viewer": Room("the 3D viewer and its pages", (*_READERS, "formats")),
    "fitting": Room("one object by optimisation", (*_LIBRARY, "compat")),
    "pages": Room(
        "pages, charts, turntables",
        (*_LIBRARY, "photo", "trajectories", "surfaces", "viewer", "fitting"),
    ),
    "measure": Room("benchmark and stress cases that need the model", _MEASURES),
    "train.data.made": Room("objects without end, made of a seed", _LIBRARY),
    "train.data": Room("furniture, rendering of meshes", (*_LIBRARY, "train.data.made")),
    "train.sources": Room(
        "published datasets, packs; commands of data",
        (*_LIBRARY, "train.data", "train.data.made"),
    ),
    "train.config": Room("the options of a run", _LIBRARY),
    "train.objective": Room("the losses", (*_LIBRARY, "train.config")),
    "train": Room(
        "batches, loop, checkpoints",
        (*_LIBRARY, "train.config", "train.objective", "train.data", "train.data.made", "train.sources"),
        ("pages",),
    ),
    "eval": Room("the report that both evaluations share", _RESULTS),
    "eval.views": Room("PSNR, SSIM, LPIPS; baselines", (*_RESULTS, "eval")),
    "eval.shapes": Room("Chamfer, IoU, F-score", (*_RESULTS, "eval")),
    "gpu_check": Room("the checks on a CUDA machine", (*_MEASURES, "measure")),
    "ablation": Room(
        "rows that are trained and evaluated alike",
        _RESULTS,
        ("measure", *_TRAIN, *_EVAL),
    ),
    "commands": Room(
        "commands, by subject",
        (*_MEASURES, "measure", "ablation", "gpu_check"),
        (*_TRAIN, *_EVAL),
    ),
    "app": Room("the local web app", _RESULTS),
    "cli": Room(
        "finds the command, parses, calls",
        ("versions", "words"),
        ("commands", "app", "gpu_check", "ablation", *_TRAIN, *_EVAL),
    ),
    "public": Room("import gamba_warp: names loaded when used", ("versions", "kernels"), _RESULTS),
}

# ``gamba``, and each ``python -m`` that is the same. (gpu_check has its own: it needs no tyro.)
DOORS = ("cli", "__main__", "train.__main__", "eval.__main__", "kernels.bench.__main__")
# Every kernel knows tensors and nothing else.
KERNEL_LIBRARIES = {"numpy", "torch", "warp"}
# They need system libraries that a bare machine lacks: only the functions that use them may fail.
ONLY_INSIDE_FUNCTIONS = {"open3d", "pymeshlab"}
# An oracle shares nothing with the kernel that it judges, but constants (and the formula of the
# harmonics in torch, which is itself their kernels' oracle).
ORACLES = ("kernels.stress.oracles", "reference")
ORACLES_MAY = ("constants", "harmonics.formula", "kernels.stress.core", "kernels.stress.oracles")


def short(module: str) -> str:
    """The name of a module without ``gamba_warp.``."""
    return module.removeprefix("gamba_warp.")


def room_of(module: str) -> str:
    """The room that a module of ours lies in.

    Raises:
        KeyError: a folder that is no room yet; it belongs into ``ROOMS``.
    """
    name = short(module)
    if name == "gamba_warp":
        return "public"
    if name == "versions":
        return "versions"
    if name in DOORS:
        return "cli"
    room = name
    while room and room not in ROOMS:
        room = room.rpartition(".")[0]
    if room:
        return room
    if "." in name:
        raise KeyError(f"{module} lies in no room: add its folder to ROOMS")
    return "words"


def refused(entry: Import) -> str | None:
    """Why an import is not allowed, or None."""
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
    here, there = room_of(entry.source), room_of(target)
    if here == there or there in ROOMS[here].may or (entry.lazy and there in ROOMS[here].later):
        return None
    when = "only inside functions" if there in ROOMS[here].later else "not"
    return f"the room {here} may import {there} {when} ({entry.name})"


def edges(entries: Iterable[Import], by_room: bool) -> dict[str, set[str]]:
    """Who imports whom: rooms by any import, or modules by those that run when they are loaded."""
    found: dict[str, set[str]] = defaultdict(set)
    for entry in entries:
        if entry.target and (by_room or not entry.lazy):
            pair = (entry.source, entry.target)
            here, there = map(room_of, pair) if by_room else pair
            if here != there:
                found[here].add(there)
    return dict(found)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """A way along the arrows that ends where it began, or an empty list."""
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
