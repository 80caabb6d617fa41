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
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gamba_warp.ablation.plan import commands, open_plan
from gamba_warp.data import gso
from gamba_warp.data.dataset import open_dataset
from gamba_warp.data.preprocess import SamSegmenter
from gamba_warp.errors import UserError
from gamba_warp.eval.compare import join, markdown_page, read_reports
from gamba_warp.eval.shapes.load import load_shape
from gamba_warp.eval.shapes.pairs import evaluate_pairs, find_pairs
from gamba_warp.eval.shapes.protocol import PRESETS, read_protocol
from gamba_warp.eval.views.compare import ViewsProtocol, load_truth
from gamba_warp.eval.views.pictures import PicturePredictions
from gamba_warp.eval.views.predictions import open_predictions
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.gaussians.files import read_gaussians
from gamba_warp.formats.meshes import default_up, load_mesh
from gamba_warp.images import find_pictures, load_rgba
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.encoders import build_encoder, read_state
from gamba_warp.model.released import convert_released
from gamba_warp.photo.cutout import Ways, cut_out
from gamba_warp.photo.matte import Matte
from gamba_warp.train.checkpoint import find_checkpoint, load_weights
from gamba_warp.train.config import TrainConfig
from gamba_warp.train.data.furniture import get_furniture
from gamba_warp.train.data.render import Settings, render_object
from gamba_warp.train.data.shards import Shards
from gamba_warp.train.sources.gso import take_models
from gamba_warp.train.sources.objaverse_lists import Lists
from gamba_warp.train.sources.objaverse_views import find_rendered, take_views
from gamba_warp.trajectories.files import load_path
from gamba_warp.untrusted.documents import read_bytes
from gamba_warp.viewer.page import write_viewer
from gamba_warp.vision.weights import store_weights

from . import checks, seeds


class Reader(NamedTuple):
    """Reader of files.

    Attributes:
        read: reads a path; may write into a folder, its second argument.
        check: asserts that a result is valid, from the result, the path and the folder.
        seeds: returns the valid files.
        share: relative number of cases; 8 for a quick reader.
        whole: True if it reads the folder of the files instead of the first file.
    """

    read: Callable[[Path, Path], Any]
    check: Callable[[Any, Path, Path], None]
    seeds: Callable[[], seeds.Kinds]
    share: int = 8
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


def _pictures(path: Path, out: Path) -> Any:
    found, failures = find_pictures([path])
    if not found:
        raise UserError("; ".join(f"{name}: {reason}" for name, reason in failures))
    return [attempt(load_rgba, name) for name in found]


def _prepare(path: Path, out: Path) -> Any:
    mask = next((p for p in sorted(path.parent.iterdir()) if p.stem == "mask"), None)
    return cut_out(path, Ways(None if mask == path else mask, fetch=False)).rgba


def _view(path: Path, out: Path) -> Any:
    page = out / "page.html"
    write_viewer(page, path.name, read_gaussians(path), view=(1.5, 49.1, 0.0))
    return page.read_text(encoding="utf-8")


def _thinned(path: Path, out: Path) -> Any:
    """Gaussians without those that cannot be drawn, and the message about these."""
    left_out: list[str] = []
    return read_gaussians(path, left_out), left_out


def _predictions(path: Path, out: Path) -> Any:
    opened: Any = open_predictions(path, 1.5, "cpu")
    names = [p.relative_to(path).with_suffix("").as_posix() for p in sorted(path.rglob("*.ply"))]
    return [attempt(opened.gaussians, None, name, 0) for name in names]


def _cameras(path: Path, out: Path) -> Any:
    """Read cameras like ``gamba render``, in the file's size and in another."""
    load_path(path, (32, 24))
    return load_path(path)


def _mesh(path: Path, out: Path) -> Any:
    return load_mesh(path).normalized(default_up(path))[0]


def _evaluation(path: Path, out: Path) -> Any:
    truth = out / "truth.off"
    truth.write_bytes(seeds.meshes()["off"]["ball.off"])
    pairs, failures = find_pairs(path, truth)
    protocol = replace(PRESETS["default"], num_points=64, iou_voxels=8)
    return failures + evaluate_pairs(pairs, protocol, None)


def _dataset(path: Path, out: Path) -> Any:
    dataset = open_dataset(path)
    bad = dataset.check()
    return [attempt(dataset.load, uid) for uid in dataset.uids], list(bad.values())


def _shards(path: Path, out: Path) -> Any:
    dataset = Shards(str(path), "train").first(9)
    return [attempt(dataset.load, uid) for uid in dataset.uids], []


def _split(path: Path, out: Path) -> Any:
    return open_dataset(path, "train").uids + open_dataset(path, "val").uids


def _shown(path: Path, out: Path) -> Any:
    """Pictures in place of predictions, of each object of a dataset."""
    dataset, given = open_dataset(path / "data"), PicturePredictions(path / "seen", 1.5, "cpu")
    protocol = ViewsProtocol("all", 0, None, None, None, None, 1.5)
    truths = [attempt(load_truth, dataset, uid, protocol, "cpu") for uid in dataset.uids]
    good = [truth for truth in truths if not isinstance(truth, UserError)]
    return [attempt(given.pictures, dataset, truth) for truth in good]


def _render(path: Path, out: Path) -> Any:
    settings = Settings(1, 8, 49.1, 0, True, "png", "auto")
    return [attempt(render_object, mesh, out, settings) for mesh in find_meshes(path)[:2]]


def _furniture(path: Path, out: Path) -> Any:
    target = out / "inner" / "furniture"
    (out / "inner").mkdir()
    (out / "inner" / "neighbour.txt").write_text("kept", encoding="utf-8")
    return get_furniture(target, **{"tree" if path.is_dir() else "deb": path})


def _gobjaverse(path: Path, out: Path) -> Any:
    """Make a dataset of a copy of G-Objaverse, chosen by its lists; load its objects."""
    files = {name: path / name for name in ("index.json", "quality.json")}
    index, quality = (file if file.exists() else None for file in files.values())
    lists = Lists(index, tuple(sorted(path.glob("list*"))), (), quality)
    objects = find_rendered(path)
    target = out / "dataset"
    target.mkdir()
    taken, failures = take_views(objects, lists.choose(objects).names, target, 1, True)
    loaded = [open_dataset(target).load(uid) for uid in open_dataset(target).uids] if taken else []
    return loaded, list(failures.values())


def _gso(path: Path, out: Path) -> Any:
    """Take models of a copy of GSO, and read their meshes."""
    names = gso.NAMES[:2]
    failures = take_models(path, out / "gso", names)
    results: list[Any] = [UserError(reason) for reason in failures.values()]
    for mesh in find_meshes(out / "gso" / "meshes") if len(failures) < len(names) else ():
        try:
            results.append(load_mesh(mesh.path).normalized(gso.UP)[0])
        except UserError as error:
            # The file is a copy: it has the name of that in the set, but another folder.
            results.append(UserError(str(error).replace(str(out), str(path))))
    return results


@functools.lru_cache(1)
def _trainer() -> Any:
    return seeds.trainer(Path(tempfile.mkdtemp(prefix="trainer-")))


def _training(path: Path, out: Path) -> Any:
    trainer = _trainer()
    before = checks.fingerprint(trainer)
    found = find_checkpoint(trainer.config.run.out, str(path))
    try:
        trainer.restore(found)
    except Exception:
        if checks.fingerprint(trainer) != before:
            _trainer.cache_clear()
            raise AssertionError("refused, but a part of it is loaded already") from None
        raise
    return trainer


def _start_weights(path: Path, out: Path) -> Any:
    model = _trainer().model
    load_weights(path, model)
    return model


def _text(path: Path) -> str:
    return read_bytes(path).decode("utf-8", "replace")


def _config(path: Path, out: Path) -> Any:
    return GambaConfig.from_json(_text(path), str(path))


def _set(path: Path, out: Path) -> Any:
    lines = tuple(_text(path).splitlines())
    return TrainConfig(data=Path("data"), preset="tiny", set=lines).model_config()


def _protocol(path: Path, out: Path) -> Any:
    return read_protocol(str(path))


def _plan(path: Path, out: Path) -> Any:
    """The plan of an ablation, and the commands of its rows."""
    found = open_plan(str(path), path.parent)
    return found, [commands(found, row, path.parent, out, None) for row in found.rows]


def _compare(path: Path, out: Path) -> Any:
    """Table of ``gamba compare`` for a report and itself."""
    joined = join(read_reports((f"a={path}", f"b={path}"), ()), None)
    json.dumps(joined, allow_nan=False)
    return [markdown_page(joined, True)]


def _encoder(path: Path, out: Path) -> Any:
    vit = {"encoder": "vit_tiny_patch16_224", "encoder_size": 16}
    return build_encoder(replace(seeds.tiny_config(), **vit), path)


def _released(path: Path, out: Path) -> Any:
    return convert_released(read_state(path), str(path), 1)


def _matte(path: Path, out: Path) -> Any:
    return Matte(path)(seeds.rgba()[..., :3] / np.float32(255))


def _archive(path: Path, out: Path) -> Any:
    os.environ["GAMBA_CACHE"] = str(out)
    return store_weights(archive=path)


def _faulty(path: Path, out: Path) -> Any:
    """Fail as the file says, to test the detection of failures."""
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    what = path.read_text("latin1")
    if what == "raises" or re.match("..[^\0-\x7f]", what, re.DOTALL):
        raise KeyError("no such key")
    if what == "lines":
        raise UserError("something is wrong")
    if what == "tells":
        raise ValueError(f"{path} and {out} are wrong")
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
    "picture": Reader(alone(load_rgba), checks.picture, seeds.pictures),
    "picture-folder": Reader(
        _pictures, checks.each(checks.picture), seeds.picture_folders, 3, True
    ),
    "cut-out": Reader(_prepare, checks.cut_out, seeds.masked_pictures, 4),
    "gaussians": Reader(alone(read_gaussians), checks.gaussians, seeds.splats),
    "gaussians-thinned": Reader(_thinned, checks.thinned, seeds.thinned_splats, 4),
    "gaussians-folder": Reader(
        _predictions, checks.each(checks.gaussians), seeds.splat_folders, 3, True
    ),
    "view": Reader(_view, checks.page, seeds.splats, 2),
    "cameras": Reader(_cameras, checks.cameras, seeds.cameras),
    "mesh": Reader(_mesh, checks.mesh, seeds.meshes),
    "shape": Reader(alone(load_shape), checks.shape, seeds.shapes, 12),
    "evaluation": Reader(_evaluation, checks.report, seeds.compared, 1),
    "dataset": Reader(_dataset, checks.views, seeds.datasets, 8, True),
    "shards": Reader(_shards, checks.views, seeds.shards, 6, True),
    "shown": Reader(_shown, checks.each(checks.shown), seeds.shown, 3, True),
    "split": Reader(_split, checks.nothing, seeds.split, 2, True),
    "catalogue": Reader(alone(find_meshes), checks.catalogue, seeds.catalogues, 4, True),
    "render": Reader(_render, checks.rendered, seeds.catalogues, 1, True),
    "furniture": Reader(_furniture, checks.furniture, seeds.libraries, 6, True),
    "package": Reader(_furniture, checks.furniture, seeds.packages, 6),
    "gobjaverse-copy": Reader(_gobjaverse, checks.views, seeds.gobjaverse, 3, True),
    "gso-copy": Reader(_gso, checks.scans, seeds.scans, 3, True),
    "model": Reader(alone(load_model), checks.model, seeds.models, 6),
    "training": Reader(_training, checks.training, seeds.checkpoints, 5, True),
    "start-weights": Reader(_start_weights, checks.model, seeds.models, 3),
    "config": Reader(_config, checks.config, seeds.configurations),
    "set": Reader(_set, checks.config, seeds.changes, 4),
    "protocol": Reader(_protocol, checks.protocol, seeds.protocols),
    "plan": Reader(_plan, checks.plan, seeds.plans, 2),
    "compare": Reader(_compare, checks.pages, seeds.reports, 4),
    "released": Reader(_released, checks.released, seeds.released, 2),
    "encoder": Reader(_encoder, checks.nothing, seeds.weights, 1),
    "sam": Reader(alone(SamSegmenter), checks.nothing, seeds.weights, 1),
    "matte": Reader(_matte, checks.alpha, seeds.networks, 3),
    "archive": Reader(_archive, checks.nothing, seeds.archives, 2),
    "faulty": Reader(_faulty, checks.faulty, lambda: {"text": {"a.txt": b"valid text"}}, 0),
}
# Valid files that a reader rejects on purpose: EPS under another name, and stand-ins of weights.
REFUSED = {
    ("picture", "eps-as-png"),
    ("encoder", "torch"),
    ("sam", "torch"),
    ("archive", "archive"),
}
