"""Pairs of predicted and true files: search, evaluation and report.

Pairs are evaluated in child processes, so that a crash fails only one pair. Functions that run
there import slow modules themselves.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Container, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from gamba_warp.batch import progress_bar
from gamba_warp.data import gso
from gamba_warp.devices import quiet_warp
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, sha256, visible, warn_of_others, write_text
from gamba_warp.formats.catalogue import CATALOGUE, find_meshes, object_names
from gamba_warp.formats.names import SHAPE_SUFFIXES
from gamba_warp.untrusted.children import Failed, run_each
from gamba_warp.untrusted.documents import read_lines
from gamba_warp.versions import __version__, installed

from ..report import (
    OK,
    Stopwatch,
    check_finite,
    failure,
    finite_or_none,
    make_report,
    save_report,
    stdout_to_stderr,
)
from .options import ShapesOptions
from .protocol import GeometryProtocol
from .shape import Mesh, Points, Similarity, positions_of
from .sheet import save_sheet
from .table import page, summaries

if TYPE_CHECKING:
    from gamba_warp.data.dataset import ViewDataset
    from gamba_warp.data.layouts import Placement

PAIR_SECONDS = 3600.0  # time limit; a pair takes seconds, at worst minutes
PACKAGES = ("open3d-cpu", "open3d", "pymeshlab", "scikit-image", "trimesh", "numpy", "torch")
# Entries of the records without a meaningful mean.
_NO_MEAN = (
    *("alignment", "gt_normalization", "iou_voxel", "pred_closed", "gt_closed", "chamfer_turned"),
    "gt_symmetry",
)


class Pair(NamedTuple):
    """Two files of one object.

    Attributes:
        name: of the object: its uid in the dataset if there is one, else by ``object_names``.
        pred: the predicted shape.
        gt: the true shape.
        rotation: ``[3, 3]`` from the catalogue, which turns the true shape upright first; or None.
        placement: of the dataset's source mesh, or None.
    """

    name: str
    pred: Path
    gt: Path
    rotation: list[list[float]] | None = None
    placement: Placement | None = None


class Objects(NamedTuple):
    """Objects of a dataset.

    Attributes:
        uids: by the names of their files (``object_names``).
        splits: by uid.
    """

    uids: dict[str, str]
    splits: dict[str, str]


def open_objects(data: Path | None) -> tuple[ViewDataset, Objects] | tuple[None, None]:
    """Open the dataset of ``--data``; return it and its objects.

    Raises:
        UserError: it cannot be opened, two objects have one name, or its splits are invalid.
    """
    if data is None:
        return None, None
    from gamba_warp.data.dataset import open_dataset, splits_of

    dataset = open_dataset(data)
    return dataset, Objects(_by_name(dataset.uids, data), splits_of(data, dataset.uids))


def _by_name(uids: Iterable[str], folder: Path) -> dict[str, str]:
    """Return uids by the names of their files. Raises UserError if two have one name."""
    uids, by_name = list(uids), dict[str, str]()
    for name, uid in zip(object_names([PurePosixPath(uid) for uid in uids]), uids):
        if by_name.setdefault(name, uid) != uid:
            raise UserError(f"{folder}: '{uid}' and '{by_name[name]}' have the same name, '{name}'")
    return by_name


def evaluate_shapes(options: ShapesOptions, protocol: GeometryProtocol) -> dict[str, Any]:
    """Evaluate the files that the options name, and write the report's files.

    Args:
        options: with the files to compare and the folder of the report.
        protocol: of the comparison; see ``chosen_protocol``.

    Returns:
        The report of ``make_report``, with ``inputs``, ``flags``, ``axes`` and ``warnings``.

    Raises:
        UserError: something cannot be opened or written.
    """
    listed = gso.names_of(options.objects) if protocol.name == "gso" else ()
    if options.objects is not None and not listed:
        raise UserError("--objects: needs --protocol gso")
    if options.limit is not None and listed:
        raise UserError("--limit: --protocol gso has its own objects; select others with --objects")
    dataset, pairs, failures = open_pairs(options, protocol, listed)
    folder = output_folder(options.out) if options.out is not None else None
    cache = RecordCache(folder, protocol, options.data)
    with stdout_to_stderr():
        objects = failures + evaluate_pairs(
            pairs, protocol, dataset, cache=cache, workers=options.workers
        )
    named = {"pred": options.pred, "gt": options.gt, "data": options.data}
    versions = {"gamba_warp": __version__} | installed(*PACKAGES)
    inputs = {side: path.name if path else None for side, path in named.items()}
    report = make_report(
        protocol.to_json(),
        objects,
        versions,
        left_out=_NO_MEAN,
        inputs=inputs,
        **summaries(objects),
    )
    if listed:
        done = [record["name"] for record in report["objects"] if record["status"] == OK]
        report["evaluation"] = gso.protocol_of(done, listed)
    if folder is not None:
        save_report(report, folder)
        write_text(folder / "table.md", page(report))
        if options.sheet and any(record["status"] == OK for record in objects):
            with stdout_to_stderr():
                again = partial(evaluate_pairs, protocol=protocol, dataset=dataset)
                save_sheet(folder / "sheet.png", objects, pairs, again)
        cache.end()
    return report


class _CacheLine(msgspec.Struct):
    """A line of the cache file."""

    key: str
    record: dict[str, Any]


class RecordCache:
    """File of finished records, by which an interrupted evaluation resumes.

    Each line has a pair's record with a hash of its inputs: the protocol, this program's version
    and both files.
    """

    def __init__(self, folder: Path | None, protocol: GeometryProtocol, data: Path | None) -> None:
        self._file = None if folder is None else folder / "objects.jsonl"
        self._context = [protocol.to_json(), __version__, str(data and data.resolve())]
        self._known: dict[str, dict[str, Any]] = {}
        if self._file is not None and self._file.is_file():
            for line in read_lines(self._file, _CacheLine):
                self._known[line.key] = line.record

    def key(self, pair: Pair) -> str:
        """Return the hash of the pair's inputs."""
        with suppress(UserError):
            files = [sha256(pair.pred), sha256(pair.gt), pair.name, pair.rotation]
            return hashlib.sha256(json.dumps([*self._context, *files]).encode()).hexdigest()
        return ""  # matches no entry; the pair will fail

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the cached record, or None."""
        return self._known.get(key)

    def add(self, key: str, record: dict[str, Any]) -> None:
        """Store a record; failures are not stored, so that they are tried again."""
        if self._file is not None and record["status"] == OK:
            with open(self._file, "a", encoding="utf-8") as file:
                file.write(json.dumps(finite_or_none({"key": key, "record": record})) + "\n")

    def end(self) -> None:
        """Remove the file, once the report is written."""
        if self._file is not None:
            self._file.unlink(missing_ok=True)


def open_pairs(
    options: ShapesOptions, protocol: GeometryProtocol, expected: Iterable[str] = ()
) -> tuple[ViewDataset | None, list[Pair], list[dict[str, str]]]:
    """Open the dataset and pair the files that the options name.

    Args:
        options: with the files, the dataset and the number of objects.
        protocol: of the comparison.
        expected: names that must have a prediction.

    Returns:
        The dataset; and the pairs and failures of ``find_pairs``, of at most ``limit`` objects.

    Raises:
        UserError: as for ``open_objects`` and ``find_pairs``, or only one of frame "reference" and
            dataset is given.
    """
    if (protocol.frame == "reference") != (options.data is not None):
        raise UserError("--frame reference and --data: give both or neither")
    assert options.pred is not None and options.gt is not None  # checked by the command
    dataset, known = open_objects(options.data)
    pairs, failures = find_pairs(options.pred, options.gt, expected, known)
    if options.limit is not None:
        from gamba_warp.data.dataset import evenly

        names = {pair.name for pair in pairs} | {each["name"] for each in failures}
        chosen = {*evenly(sorted(names), options.limit)}
        pairs = [pair for pair in pairs if pair.name in chosen]
        failures = [each for each in failures if each["name"] in chosen]
    return dataset, pairs, failures


def find_pairs(
    pred: Path, gt: Path, expected: Iterable[str] = (), known: Objects | None = None
) -> tuple[list[Pair], list[dict[str, str]]]:
    """Pair two files, or the files of two folders by name (``object_names``).

    A ``catalogue.json`` in the folder of ground truths names its files; of such a library only
    predicted or expected objects are used. With a dataset, all objects of each split that has a
    prediction are expected.

    Args:
        pred: predicted shapes.
        gt: true shapes.
        expected: names that must have a prediction.
        known: objects of the dataset, or None.

    Returns:
        The pairs, sorted by name, and a failure record of each name with no or several partners.

    Raises:
        UserError: a path is missing or empty, or one is a file and the other a folder.
    """
    for path in (pred, gt):
        if not path.exists():
            raise UserError(f"{path}: no such file or folder")
    if pred.is_file() and gt.is_file():
        return [Pair(pred.stem, pred, gt)], []
    if pred.is_file() or gt.is_file():
        raise UserError(f"{pred} and {gt}: give two files or two folders")
    predicted, rotations = _shapes_in(pred), {}
    uids, splits = known or Objects({}, {})
    wanted = {*predicted, *expected}
    if (gt / CATALOGUE).is_file():
        meshes = {mesh.uid: mesh for mesh in find_meshes(gt)}
        library = _by_name(meshes, gt)
        true = {name: [meshes[library[name]].path] for name in wanted & library.keys()}
        rotations = {name: meshes[library[name]].rotation for name in true}
        uids = library | uids
    else:
        true = _shapes_in(gt, uids)
        if known is not None:
            parts = {splits[uids[name]] for name in wanted & uids.keys()}
            wanted |= {name for name, uid in uids.items() if splits[uid] in parts}
            true = {name: true[name] for name in wanted & true.keys()}
    pairs, failures = [], []
    for name in sorted({*predicted, *true, *expected}):
        ours, theirs, uid = predicted.get(name, []), true.get(name, []), uids.get(name, name)
        if len(ours) == len(theirs) == 1:
            pairs.append(Pair(uid, ours[0], theirs[0], rotations.get(name)))
        elif not (ours and theirs):
            failures.append(failure(uid, "no ground truth" if ours else "no prediction"))
        else:
            files = ", ".join(path.name for path in (ours if len(ours) > 1 else theirs))
            failures.append(failure(uid, f"more than one file: {files}"))
    return pairs, failures


def _shapes_in(folder: Path, rendered: Container[str] = ()) -> dict[str, list[Path]]:
    """Return the shape files in a folder by ``object_names``. Raises UserError if it has none.

    A further file of the same name is another object if it was rendered as one (``find_meshes``).
    """
    files = [path for path in visible(folder, "*") if path.is_file()]
    warn_of_others(folder, files, SHAPE_SUFFIXES)
    paths = sorted(path for path in files if path.suffix.lower() in SHAPE_SUFFIXES)
    names = object_names([path.relative_to(folder).with_suffix("") for path in paths])
    shapes: dict[str, list[Path]] = {}
    for name, path in zip(names, paths):
        other = f"{name}-{path.suffix[1:].lower()}"
        shapes.setdefault(other if name in shapes and other in rendered else name, []).append(path)
    if not shapes:
        raise UserError(f"{folder}: contains no files of type {', '.join(SHAPE_SUFFIXES)}")
    return shapes


def out_of_reference(dataset: ViewDataset, uid: str, reference: int, distance: float) -> Similarity:
    """Return the transform from the input camera's world, the model's, to the dataset's.

    Args:
        dataset: that the object belongs to.
        uid: the object.
        reference: index of the input view.
        distance: of the input camera in its world.

    Raises:
        UserError: the view cannot be read.
    """
    from gamba_warp.cameras import relative_to_reference

    viewmat = dataset.load(uid, views=[reference]).cameras.viewmats[0].double()
    _, scale = relative_to_reference(viewmat[None], viewmat, distance)
    return Similarity(viewmat[:3, :3].T.numpy(), np.zeros(3), float(1 / scale))


def evaluate_pair(
    pair: Pair, protocol: GeometryProtocol, transform: Similarity | None
) -> dict[str, Any]:
    """Load and compare one pair.

    Args:
        pair: the files.
        protocol: of the comparison.
        transform: of the prediction into the ground truth's unit frame; None: the same as the
            ground truth's.

    Returns:
        The object's record.

    Raises:
        UserError: a file cannot be read or has no surface, or a number is not finite.
    """
    from .load import FRAME_AXES, load_gt, load_prediction
    from .metrics import chamfer_by_transform, compare

    stages = Stopwatch(3)
    with stages("load"):
        gt = load_gt(pair.gt, protocol, pair.rotation, pair.placement)
        into, frame_axes = transform or gt.transform, FRAME_AXES.get(protocol.frame, gt.axes)
        predicted = load_prediction(pair.pred, into, frame_axes, protocol)
    with stages("compare"):
        if note := scale_note(predicted.shape, protocol):
            predicted.warnings.append(note)
        metrics = compare(predicted.shape, gt.shape, protocol)
        check_finite(metrics)
        turned = check_finite(chamfer_by_transform(predicted, gt, protocol))
    return {
        "name": pair.name,
        "status": OK,
        **metrics,
        "kind": predicted.kind,
        "pred_closed": predicted.is_closed(),
        "gt_closed": gt.is_closed(),
        "pred_flags": predicted.flags,
        "gt_flags": gt.flags,
        "pred_axes": predicted.axes,
        "gt_axes": gt.axes,
        **({"pred_warnings": predicted.warnings} if predicted.warnings else {}),
        **({"gt_warnings": gt.warnings} if gt.warnings else {}),
        "chamfer_turned": turned,
        "pred_sha256": sha256(pair.pred),
        "gt_sha256": sha256(pair.gt),
        "gt_normalization": gt.transform.record(),
        "seconds": stages.seconds,
    }


def scale_note(shape: Mesh | Points, protocol: GeometryProtocol) -> str:
    """Return a warning if a prediction's size is far from 1, the ground truth's; else ""."""
    side = float(np.ptp(positions_of(shape), axis=0).max())
    if {"box", "scale", "icp"} & {*protocol.align} or 0.1 <= side <= 10:
        return ""
    return f"its side is {side:.3g} times the ground truth's: other units? --align scale fits them"


def evaluate_pairs(
    pairs: list[Pair],
    protocol: GeometryProtocol,
    dataset: ViewDataset | None,
    evaluate: Callable[..., dict[str, Any]] = evaluate_pair,
    cache: RecordCache | None = None,
    workers: int = 1,
) -> list[dict[str, Any]]:
    """Evaluate every pair; a failure is recorded and stops no other.

    That includes crashes, because the pairs are evaluated in child processes (``run_each``).

    Args:
        pairs: the files.
        protocol: of the comparison.
        dataset: with the objects of the pairs, for the frame "reference".
        evaluate: makes the record of one pair, like ``evaluate_pair``; must be picklable.
        cache: of finished records; or None.
        workers: pairs evaluated at the same time.

    Returns:
        One record for each pair.
    """
    # Without torch loaded, both processes would start with the same number of threads.
    threads = sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None
    attempt = partial(
        _attempt, protocol=protocol, dataset=dataset, evaluate=evaluate, threads=threads
    )
    cache = cache or RecordCache(None, protocol, None)
    keys = [cache.key(pair) for pair in pairs]
    objects = [record for key in keys if (record := cache.get(key))]
    left = [at for at, key in enumerate(keys) if cache.get(key) is None]
    waiting = [pairs[at] for at in left]
    results = run_each(attempt, waiting, workers=workers, seconds=PAIR_SECONDS)
    for index, result in progress_bar(results, total=len(waiting), unit="object"):
        if isinstance(result, Failed):
            result = failure(waiting[index].name, result.reason)
        cache.add(keys[left[index]], result)
        objects.append(result)
    return objects


def _attempt(
    pair: Pair,
    protocol: GeometryProtocol,
    dataset: ViewDataset | None,
    evaluate: Callable[..., dict[str, Any]],
    threads: int | None,
) -> dict[str, Any]:
    """Return one pair's record, or the ``failure`` of an error; runs in the child."""
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
    quiet_warp()  # the child runs nothing else
    try:
        transform = None
        if protocol.frame == "unit":
            transform = Similarity(np.eye(3), np.zeros(3))
        elif dataset is not None:
            transform = out_of_reference(dataset, pair.name, protocol.reference, protocol.distance)
            pair = pair._replace(placement=dataset.files(pair.name).placement)
        return evaluate(pair, protocol, transform)
    except UserError as error:
        return failure(pair.name, error)
    except Exception as error:  # of any library; the other pairs continue
        return failure(pair.name, f"{type(error).__name__}: {error}")
