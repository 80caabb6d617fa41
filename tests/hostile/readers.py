"""All readers of files: their call by a command, their valid files, and checks of their results.

A reader of a new format is one more line in ``READERS``.
"""

import functools
import json
import os
import re
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gamba_warp.ablation.plan import commands, open_plan
from gamba_warp.data.dataset import open_dataset
from gamba_warp.errors import UserError
from gamba_warp.eval.compare import join, markdown_page, read_reports
from gamba_warp.eval.shapes.load import load_shape
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import default_up, load_mesh
from gamba_warp.formats.read import read_gaussians
from gamba_warp.images import load_rgba
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.encoders import read_state
from gamba_warp.model.released import convert_released
from gamba_warp.photo.cutout import CutoutOptions, cut_out
from gamba_warp.photo.matte import Matte
from gamba_warp.train.checkpoint import damage
from gamba_warp.train.data.shards import Shards
from gamba_warp.trajectories.files import load_path
from gamba_warp.viewer.page import write_viewer

from . import checks, seeds


class Reader(NamedTuple):
    """Reader of files.

    Attributes:
        read: reads a path; may write into a folder, its second argument.
        check: asserts that a result is valid, from the result, the path and the folder.
        seeds: returns the valid files.
        fraction: relative number of cases; 8 for a quick reader.
        whole: True if it reads the folder of the files instead of the first file.
    """

    read: Callable[[Path, Path], Any]
    check: Callable[[Any, Path, Path], None]
    seeds: Callable[[], seeds.Kinds]
    fraction: int = 8
    whole: bool = False


def alone(read: Callable[[Path], Any]) -> Callable[[Path, Path], Any]:
    """Wrap a reader of a path that writes nothing."""
    return lambda path, out: read(path)


def attempt(read: Callable, *arguments: Any) -> Any:
    """Return the result or the error, for readers of many files."""
    try:
        return read(*arguments)
    except UserError as error:
        return error


def _prepare(path: Path, out: Path) -> Any:
    mask = next((p for p in sorted(path.parent.iterdir()) if p.stem == "mask"), None)
    return cut_out(path, CutoutOptions(None if mask == path else mask, fetch=False)).rgba


def _view(path: Path, out: Path) -> Any:
    page = out / "page.html"
    write_viewer(page, path.name, read_gaussians(path), view=(1.5, 49.1, 0.0))
    return page.read_text(encoding="utf-8")


def _thinned(path: Path, out: Path) -> Any:
    """Gaussians without those that cannot be drawn, and the message about these."""
    left_out: list[str] = []
    return read_gaussians(path, left_out), left_out


def _cameras(path: Path, out: Path) -> Any:
    """Read cameras like ``gamba render``, in the file's size and in another."""
    load_path(path, (32, 24))
    return load_path(path)


def _mesh(path: Path, out: Path) -> Any:
    return load_mesh(path).normalized(default_up(path))[0]


def _dataset(path: Path, out: Path) -> Any:
    dataset = open_dataset(path)
    bad = dataset.check()
    return [attempt(dataset.load, uid) for uid in dataset.uids], list(bad.values())


def _shards(path: Path, out: Path) -> Any:
    dataset = Shards(str(path), "train").first(9)
    return [attempt(dataset.load, uid) for uid in dataset.uids], []


@functools.lru_cache(1)
def _run() -> Any:
    return seeds.new_run(Path(tempfile.mkdtemp(prefix="run-")))


def _training(path: Path, out: Path) -> Any:
    setup, state = _run()
    before = checks.fingerprint(state)
    damage(path)  # read by itself, so that the state behind wrong checksums is read, too
    try:
        state.restore(path, setup)
    except Exception:
        if checks.fingerprint(state) != before:
            _run.cache_clear()
            raise AssertionError("refused, but a part of it is loaded already") from None
        raise
    return state


def _plan(path: Path, out: Path) -> Any:
    """The plan of an ablation, and the commands of its rows."""
    found = open_plan(str(path), path.parent)
    return found, [commands(found, row, path.parent, out) for row in found.rows]


def _compare(path: Path, out: Path) -> Any:
    """Table of ``gamba compare`` for a report and itself."""
    joined = join(read_reports((f"a={path}", f"b={path}")), None)
    json.dumps(joined, allow_nan=False)
    return [markdown_page(joined)]


def _released(path: Path, out: Path) -> Any:
    return convert_released(read_state(path), str(path), 1)


def _matte(path: Path, out: Path) -> Any:
    return Matte(path)(seeds.rgba()[..., :3] / np.float32(255))


def _faulty(path: Path, out: Path) -> Any:
    """Fail as the file says, to test the detection of failures."""
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    what = path.read_text("latin1")
    if what == "raises" or re.match("..[^\0-\x7f]", what, re.DOTALL):
        raise KeyError("no such key")
    if what == "lines":
        raise UserError("something is wrong")
    if what == "opens":
        (out / ".." / ".." / "canary" / "kept.txt").read_text()
    if what == "starts":
        os.system("true")
    if what == "writes":
        (out.parent.parent / "new.txt").write_text("x")
    if what == "memory":
        np.ones(1 << 30)
    if what == "dies":
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "hangs":
        time.sleep(100)
    if what == "exits":
        raise SystemExit
    return what


READERS = {
    "image": Reader(alone(load_rgba), checks.image, seeds.images),
    "cut-out": Reader(_prepare, checks.cut_out, seeds.masked_images, 4),
    "gaussians": Reader(_thinned, checks.thinned, seeds.thinned_splats),
    "view": Reader(_view, checks.page, seeds.splats, 2),
    "cameras": Reader(_cameras, checks.cameras, seeds.cameras),
    "mesh": Reader(_mesh, checks.mesh, seeds.meshes),
    "shape": Reader(alone(lambda path: load_shape(path)[0]), checks.shape, seeds.shapes, 12),
    "dataset": Reader(_dataset, checks.views, seeds.datasets, 8, True),
    "shards": Reader(_shards, checks.views, seeds.shards, 6, True),
    "catalogue": Reader(alone(find_meshes), checks.catalogue, seeds.catalogues, 4, True),
    "model": Reader(alone(load_model), checks.model, seeds.models, 6),
    "training": Reader(_training, checks.training, seeds.checkpoints, 5, True),
    "plan": Reader(_plan, checks.plan, seeds.plans, 2),
    "compare": Reader(_compare, checks.pages, seeds.reports, 4),
    "released": Reader(_released, checks.released, seeds.released, 2),
    "matte": Reader(_matte, checks.alpha, seeds.networks, 3),
    "faulty": Reader(_faulty, checks.faulty, lambda: {"text": {"a.txt": b"valid text"}}, 0),
}
# Valid files that a reader rejects on purpose: EPS under another name, and stand-ins of weights.
REFUSED = {("image", "eps-as-png")}
