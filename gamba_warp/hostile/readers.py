"""Every reader of files: how a command calls it, what its sound files are, what a sound result is.

A reader of a new format is one more line in ``READERS``.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from . import comparing, published, sound
from .seeds import cameras, datasets, models, networks, pictures, shapes
from .seeds.pictures import Files

Seeds = Callable[[], dict[str, Files]]


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        name: name of the reader.
        read: reads what lies at a path; it may write into a folder, its second argument.
        sound: says what is unsound in a result, from the result, the path and the folder; or None.
        seeds: gives the sound files.
        share: how often it is tried; a quick reader has 8.
        whole: whether it is pointed at the folder of the files, and not at the first of them.
    """

    name: str
    read: Callable[[Path, Path], Any]
    sound: Callable[[Any, Path, Path], str | None]
    seeds: Seeds
    share: int = 8
    whole: bool = False


def _picture(path: Path, out: Path) -> Any:
    from ..images import load_rgba

    return load_rgba(path)


def _pictures(path: Path, out: Path) -> Any:
    from ..images import find_pictures, load_rgba

    found, failures = find_pictures([path])
    if not found:
        raise UserError("; ".join(f"{name}: {reason}" for name, reason in failures))
    return [comparing.attempt(load_rgba, name) for name in found]


def _prepare(path: Path, out: Path) -> Any:
    from ..data.preprocess import prepare

    mask = next((p for p in sorted(path.parent.iterdir()) if p.stem == "mask"), None)
    return prepare(path, mask=None if mask == path else mask)


def _gaussians(path: Path, out: Path) -> Any:
    from ..formats.gaussians.files import read_gaussians

    return read_gaussians(path)


def _view(path: Path, out: Path) -> Any:
    from ..formats.gaussians.files import read_gaussians
    from ..viewer.page import write_viewer

    page = out / "page.html"
    write_viewer(page, path.name, read_gaussians(path), view=(1.5, 49.1, 0.0))
    return page.read_text(encoding="utf-8")


def _predictions(path: Path, out: Path) -> Any:
    from gamba_warp.eval.views.predictions import open_predictions

    opened: Any = open_predictions(path, 1.5, "cpu")
    names = [p.relative_to(path).with_suffix("").as_posix() for p in sorted(path.rglob("*.ply"))]
    return [comparing.attempt(opened.gaussians, None, name, 0) for name in names]


def _mesh(path: Path, out: Path) -> Any:
    from ..formats.meshes import default_up, load_mesh

    return load_mesh(path).normalized(default_up(path))[0]


def _shape(path: Path, out: Path) -> Any:
    from gamba_warp.eval.shapes.load import load_shape

    return load_shape(path)


def _evaluation(path: Path, out: Path) -> Any:
    from dataclasses import replace

    from gamba_warp.eval.shapes.pairs import evaluate_pairs, find_pairs
    from gamba_warp.eval.shapes.protocol import PRESETS

    truth = out / "truth.off"
    truth.write_bytes(shapes.meshes()["off"]["ball.off"])
    pairs, failures = find_pairs(path, truth)
    protocol = replace(PRESETS["default"], num_points=64, iou_voxels=8)
    return failures + evaluate_pairs(pairs, protocol, None)


def _dataset(path: Path, out: Path) -> Any:
    from ..data.dataset import open_dataset

    dataset = open_dataset(path)
    bad = dataset.check()
    return [comparing.attempt(dataset.load, uid) for uid in dataset.uids], list(bad.values())


def _split(path: Path, out: Path) -> Any:
    from ..data.dataset import open_dataset

    return open_dataset(path, "train").uids + open_dataset(path, "val").uids


def _catalogue(path: Path, out: Path) -> Any:
    from ..formats.catalogue import find_meshes

    return find_meshes(path)


def _render(path: Path, out: Path) -> Any:
    from gamba_warp.train.data.render import Settings, render_object

    from ..formats.catalogue import find_meshes

    settings = Settings(1, 8, 49.1, 0, True, "png", "auto")
    return [comparing.attempt(render_object, mesh, out, settings) for mesh in find_meshes(path)[:2]]


def _furniture(path: Path, out: Path) -> Any:
    from gamba_warp.train.data.furniture import get_furniture

    target = out / "inner" / "furniture"
    (out / "inner").mkdir()
    (out / "inner" / "neighbour.txt").write_text("kept", encoding="utf-8")
    if path.is_dir():
        return get_furniture(target, tree=path)
    return get_furniture(target, deb=path)


def _model(path: Path, out: Path) -> Any:
    from ..model.checkpoint import load_model

    return load_model(path)


@functools.lru_cache(1)
def _trainer() -> Any:
    folder = tempfile.mkdtemp(prefix="trainer-")
    return models.trainer(Path(folder))


def _training(path: Path, out: Path) -> Any:
    from gamba_warp.train.checkpoint import find_checkpoint

    trainer = _trainer()
    before = sound.fingerprint(trainer)
    found = find_checkpoint(trainer.config.run.out, str(path))
    try:
        trainer.restore(found)
    except Exception:
        if sound.fingerprint(trainer) != before:
            _trainer.cache_clear()
            raise AssertionError("refused, but a part of it is loaded already") from None
        raise
    return trainer


def _start_weights(path: Path, out: Path) -> Any:
    from gamba_warp.train.checkpoint import load_weights

    model = _trainer().model
    load_weights(path, model)
    return model


def _text(path: Path) -> str:
    from ..untrusted.documents import read_bytes

    return read_bytes(path).decode("utf-8", "replace")


def _config(path: Path, out: Path) -> Any:
    from ..model.config import GambaConfig

    return GambaConfig.from_json(_text(path), str(path))


def _set(path: Path, out: Path) -> Any:
    from gamba_warp.train.config import TrainConfig

    lines = tuple(_text(path).splitlines())
    return TrainConfig(data=Path("data"), preset="tiny", set=lines).model_config()


def _protocol(path: Path, out: Path) -> Any:
    from gamba_warp.eval.shapes.protocol import checked, read_protocol

    return checked(read_protocol(str(path)), str(path))


def _bench(path: Path, out: Path) -> Any:
    from ..measure.suites import read_document, write_pages

    return [page.read_text(encoding="utf-8") for page in write_pages([read_document(path)], out)]


def _numeric(path: Path, out: Path) -> Any:
    import torch

    from ..measure.stress_run import replay

    return list(replay([path], torch.device("cpu")))


def _hostile(path: Path, out: Path) -> Any:
    from .case import read_case

    return read_case(path, READERS)


def _encoder(path: Path, out: Path) -> Any:
    from dataclasses import replace

    from ..model.encoders import build_encoder

    vit = {"encoder": "vit_tiny_patch16_224", "encoder_size": 16}
    return build_encoder(replace(models.tiny_config(), **vit), path)


def _released(path: Path, out: Path) -> Any:
    from ..model.encoders import read_state
    from ..model.released import convert_released

    return convert_released(read_state(path), str(path), 1)


def _sam(path: Path, out: Path) -> Any:
    from ..data.preprocess import SamSegmenter

    return SamSegmenter(path)


def _matte(path: Path, out: Path) -> Any:
    from ..photo.matte import Matte

    return Matte(path)(pictures.rgba()[..., :3] / np.float32(255))


def _pickle(path: Path, out: Path) -> Any:
    from ..vision.fetch import load_numpy_pickle

    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with path.open("rb") as file:
        return load_numpy_pickle(file, str(path))


def _archive(path: Path, out: Path) -> Any:
    import os

    from ..vision.weights import store_weights

    os.environ["GAMBA_CACHE"] = str(out)
    return store_weights(archive=path)


def _only(seeds: Seeds, *names: str) -> Seeds:
    return lambda: {name: files for name, files in seeds().items() if name in names}


def _folder_of_gaussians() -> dict[str, Files]:
    data = shapes.gaussians()
    return {"gaussians": {"a.ply": data, "b/c.ply": data}}


def _folder_of_pictures() -> dict[str, Files]:
    made = pictures.pictures()
    return {"mixed": {"a.png": made["png-rgba"]["photo.png"], "b.gif": made["gif"]["photo.gif"]}}


def _shapes() -> dict[str, Files]:
    made = {**shapes.clouds(), **shapes.meshes(), **shapes.splats()}
    return {name: {file: data} for name, files in made.items() for file, data in _first(files)}


def _first(files: Files) -> list[tuple[str, bytes]]:
    """The first file; a mesh needs no side files for its triangles, but for a .gltf's numbers."""
    name = next(iter(files))
    return [(name, files[name])] if "ball.bin" not in files else []


def _catalogued() -> dict[str, Files]:
    return datasets.mesh_folders()


READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        Reader("picture", _picture, sound.picture, pictures.pictures),
        Reader("picture-folder", _pictures, sound.each(sound.picture), _folder_of_pictures, 3,
               True),
        Reader("cut-out", _prepare, sound.cut_out, pictures.masked_pictures, 4),
        Reader("gaussians", _gaussians, sound.gaussians, shapes.splats),
        Reader("gaussians-folder", _predictions, sound.each(sound.gaussians), _folder_of_gaussians,
               3, True),
        Reader("view", _view, sound.page, shapes.splats, 2),
        Reader("cameras", cameras.read, cameras.sound, cameras.camera_files),
        Reader("mesh", _mesh, sound.mesh, shapes.meshes),
        Reader("shape", _shape, sound.shape, _shapes, 12),
        Reader("evaluation", _evaluation, sound.report, _shapes, 1),
        Reader("dataset", _dataset, sound.views, datasets.datasets, 8, True),
        Reader("pack", _dataset, sound.views, datasets.packs, 6, True),
        Reader("shown", comparing.shown, sound.each(comparing.seen), datasets.shown, 3, True),
        Reader("split", _split, sound.nothing, _only(datasets.datasets, "transforms"), 2, True),
        Reader("catalogue", _catalogue, sound.catalogue, _catalogued, 4, True),
        Reader("render", _render, sound.rendered, _catalogued, 1, True),
        Reader("furniture", _furniture, sound.furniture, _only(datasets.furniture, "libraries"),
               6, True),
        Reader("package", _furniture, sound.furniture, _only(datasets.furniture, "package"), 6),
        Reader("gobjaverse-copy", published.copy_of_gobjaverse, sound.views, datasets.gobjaverse, 3,
               True),
        Reader("gso-copy", published.copy_of_gso, published.meshes, datasets.scanned, 3, True),
        Reader("model", _model, sound.model, models.models, 6),
        Reader("training", _training, sound.training, models.checkpoints, 5, True),
        Reader("start-weights", _start_weights, sound.model, models.models, 3),
        Reader("config", _config, sound.config, _only(models.configurations, "config")),
        Reader("set", _set, sound.config, _only(models.configurations, "set"), 4),
        Reader("protocol", _protocol, sound.protocol, models.protocols),
        Reader("plan", comparing.plan, comparing.sound_plan, models.plans, 2),
        Reader("compare", comparing.reports, sound.pages, models.reports, 4),
        Reader("bench", _bench, sound.pages, models.results, 4),
        Reader("stress", _numeric, sound.nothing, _only(models.stress_cases, "numeric"), 2),
        Reader("stress-files", _hostile, sound.hostile_case, _only(models.stress_cases, "files"),
               4),
        Reader("released", _released, sound.released, models.released, 2),
        Reader("encoder", _encoder, sound.nothing, _only(models.weights, "torch"), 1),
        Reader("sam", _sam, sound.nothing, _only(models.weights, "torch"), 1),
        Reader("matte", _matte, sound.alpha, networks.networks, 3),
        Reader("pickle", _pickle, sound.arrays, _only(models.weights, "pickle"), 4),
        Reader("archive", _archive, sound.nothing, _only(models.weights, "archive"), 2),
    )
}  # fmt: skip
# Sound files that a reader refuses for a reason: EPS under another name, and stand-ins of weights.
REFUSED = {
    ("picture", "eps-as-png"),
    ("encoder", "torch"),
    ("sam", "torch"),
    ("archive", "archive"),
}
