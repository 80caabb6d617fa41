"""Commands ``gamba data furniture``, ``procedural``, ``render`` and the others.

They parse, call and print. Existing results are skipped, so a stopped command can be continued.
Failures are printed to stderr, and the exit code is then 1.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro
from msgspec import Meta

from gamba_warp.batch import counted, say
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.untrusted.ranges import Seed, ranged, shard_numbers

from ..data.settings import Settings

Item = TypeVar("Item")

# Consequence of an empty part of a split.
_WITHOUT = {
    "train": "there is nothing to train on",
    "val": "training does not validate",
    "test": "eval-views needs --split",
}
_MAX_SHOWN = 20  # damaged objects that are printed; the list has all


@dataclass(frozen=True)
class Selection:
    """Selection of objects for a command.

    Attributes:
        shard: Take every n-th object from the i-th, i/n, for n machines.
        limit: Stop after this many objects.
    """

    shard: str = "0/1"
    limit: Annotated[int, Meta(ge=1, le=10**9)] | None = None

    def of(self, items: Sequence[Item]) -> Sequence[Item]:
        """Select from the items.

        Raises:
            UserError: the shard is not of the form i/n with 0 <= i < n.
        """
        first, count = shard_numbers(self.shard)
        return items[first::count][: self.limit]


def _report(failures: Mapping[str, str], what: str, warnings: Mapping[str, list[str]]) -> int:
    """Print failures and warnings; return the exit code."""
    for name, lines in sorted(warnings.items()):
        say(f"warning: {name}: {'; '.join(lines)}")
    for name, reason in sorted(failures.items()):
        say(f"{what}: {name}: {reason}", sys.stderr)
    return 1 if failures else 0


def _report_empty_splits(data: Path) -> None:
    """Print one line about the empty parts of a dataset's split, if any."""
    from gamba_warp.data.dataset import open_dataset, splits_of

    with suppress(UserError):  # an empty or damaged dataset is reported by its readers
        there = {*splits_of(data, open_dataset(data).uids).values()}
        empty = [name for name in _WITHOUT if name not in there]
        if empty:
            parts = f"{' and '.join(empty)} {'split is' if len(empty) == 1 else 'splits are'}"
            print(f"the {parts} empty; {'; '.join(_WITHOUT[name] for name in empty)}")


def data_furniture_command(out: Path, deb: Path | None = None, tree: Path | None = None) -> int:
    """Get 820 free textured models with icons: Sweet Home 3D's libraries, from Debian's package.

    Without --deb or --tree the installed package is used, else apt-get downloads it (125 MB).

    Args:
        out: folder for the models, their icons and catalogue.json; 400 MB.
        deb: package file sweethome3d-furniture_*.deb, if you have it.
        tree: folder with the .sh3f files, if you have them.
    """
    from ..data.furniture import get_furniture

    count = get_furniture(out, deb, tree)
    print(f"{count} models in {out}; next: gamba data render {out} --out DATA")
    return 0


@ranged
def data_procedural_command(
    out: Path, count: Annotated[int, Meta(ge=1, le=100_000)] = 200, seed: Seed = 0
) -> int:
    """Make objects of random parts, free of copyright (.glb).

    An object depends only on the seed and its number; existing ones are kept.

    Args:
        out: folder for the models and catalogue.json.
        count: number of objects.
        seed: seed of all objects.
    """
    from ..data.procedural import make_files

    make_files(out, count, seed)
    print(f"{count} models in {out}; next: gamba data render {out} --out DATA")
    return 0


@ranged
def data_render_command(
    folder: tyro.conf.Positional[Path],
    out: Path,
    settings: tyro.conf.OmitArgPrefixes[Settings],
    selection: tyro.conf.OmitArgPrefixes[Selection],
    split: Literal["all", "train", "val", "test"] = "all",
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
) -> int:
    """Render posed RGBA views of every mesh in a folder (.obj .glb .gltf .ply .stl .off).

    Existing objects are skipped, so a stopped command can be continued.

    Args:
        folder: folder of meshes, at any depth; its catalogue.json may give names and attribution.
        out: the dataset to make or to continue.
        settings: Options of the images.
        selection: Selection of objects.
        split: render only the objects of this part of the set.
        workers: number of processes; 0 means one per core.
    """
    from gamba_warp.data.dataset import split_of
    from gamba_warp.formats.catalogue import find_meshes

    from ..data.render import render_meshes, still_missing

    fov, spread = settings.fov, settings.fov_spread
    if fov / spread < 5 or fov * spread > 120:
        raise UserError(f"--fov-spread {spread:g}: makes fields of view outside 5 to 120 degrees")
    meshes = find_meshes(folder)
    groups = {mesh.uid: mesh.group for mesh in meshes}
    meshes = selection.of([m for m in meshes if split in ("all", split_of(m.group))])
    out = output_folder(out)
    todo, damaged = still_missing(meshes, out, settings)
    if done := len(meshes) - len(todo) - len(damaged):
        print(f"{done} of {counted(len(meshes), 'object')} already in {out}")
    warnings, failures = render_meshes(todo, out, settings, workers, groups)
    rendered, failures = len(todo) - len(failures), failures | damaged
    code = _report(failures, "failed", warnings)
    print(f"rendered {counted(rendered, 'object')} into {out}, {len(failures)} failed")
    if split == "all":
        _report_empty_splits(out)
    return code


@ranged
def data_pack_command(
    data: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    size: Annotated[int, Meta(ge=1, le=4096)] | None = None,
    shard_mb: Annotated[int, Meta(ge=1, le=100_000)] = 1000,
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
) -> int:
    """Write the views of a dataset into a few tar files for training, in the format of WebDataset.

    Args:
        data: the dataset.
        out: folder of the shards; older ones are replaced.
        size: height of the images, pixels: they are resized once, and are lossless WebP; without
            it they keep their bytes.
        shard_mb: a shard ends with the object that exceeds this size, megabytes.
        workers: number of threads that read; 0 means one per core.
    """
    from gamba_warp.data.dataset import background_note, open_dataset
    from gamba_warp.kernels.runtime.system import cores

    from .pack import write_pack

    counts, failures = write_pack(data, out, size, shard_mb, workers or cores())
    summary = f"packed {counted(counts.total(), 'object')} into {counted(len(counts), 'shard')}"
    print(f"{summary} in {out}, {len(failures)} failed; next: gamba train {out}")
    _report_empty_splits(data)
    if note := background_note(open_dataset(data)):
        print(f"warning: {data}: {note}", file=sys.stderr)
    return _report(failures, "failed", {})


def data_index_command(data: tyro.conf.Positional[Path]) -> int:
    """Check every object of a dataset once, and list them in DATA/gamba-manifest.jsonl.

    Every command then opens the dataset by this list, with at most three system calls an object,
    compares sizes and times, and refuses a list that is older than the dataset: run this again.

    Args:
        data: the dataset's folder.
    """
    from gamba_warp.data.dataset import index_dataset

    path, count, bad = index_dataset(data)
    print(f"{counted(count, 'object')}, {len(bad):,} left out, listed in {path}")
    for uid, reason in list(bad.items())[:_MAX_SHOWN]:
        say(f"left out: {uid}: {reason}", sys.stderr)
    if (more := len(bad) - _MAX_SHOWN) > 0:
        print(f"left out: {more:,} more, see {path}", file=sys.stderr)
    return 1 if bad else 0


@ranged
def data_gso_command(
    out: tyro.conf.Positional[Path],
    source: Path,
    selection: tyro.conf.OmitArgPrefixes[Selection],
    size: Annotated[int, Meta(ge=8, le=4096)] = 512,
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
    objects: Path | None = None,
) -> int:
    """Make the evaluation "gso" from a copy of Google Scanned Objects: 60 objects, 24 views each.

    Writes OUT/views (a dataset, all of it the test split; view 0 is the input) and OUT/meshes.
    Existing objects are skipped, so a stopped command can be continued.
    Found and missing objects are listed; if any are missing, the exit code is 1.

    Args:
        out: folder to make or to continue.
        source: folder of the set, with a folder or a zip of each model as the Fuel server has them.
        selection: Selection of objects.
        size: pixels a side; the evaluation's are 512.
        objects: text file of other objects, one name a line: the same poses, another list.
        workers: number of processes that render; 0 means one per core.
    """
    from gamba_warp.data.gso import names_of

    from .gso import make_views, others_of, take_models, taken

    listed = names_of(objects)
    names = selection.of(listed)
    out = output_folder(out)
    failures = take_models(source, out, names)
    meshes = taken(out, names)
    failures = {name: why for name, why in failures.items() if name not in {m.uid for m in meshes}}
    print(f"{len(meshes)} of {len(names)} found: {', '.join(mesh.uid for mesh in meshes)}")
    if others := others_of(source, listed):
        left = f"{counted(others, 'other object')} of the set outside the evaluation"
        print(f"{left}: gamba data render {source} --out DATA")
    rendered, warnings, failed = make_views(out, meshes, size, workers)
    failures |= failed
    code = _report(failures, "missing", warnings)
    views, missing = out / "views", f"{len(failures)} of {len(names)} missing"
    print(f"rendered {counted(rendered, 'object')} into {views}, {missing}")
    objects_option = "" if objects is None else f" --objects {objects}"
    evaluation = f"--protocol gso{objects_option} --checkpoint MODEL --data {views} --out EVAL"
    print(f"next: gamba eval-views {evaluation}")
    geometry = f"gamba eval-geometry EVAL/gaussians {out / 'meshes'}"
    print(f"      {geometry} --protocol gso{objects_option} --data {views}")
    return code
