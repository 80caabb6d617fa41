"""``gamba eval-geometry``: predicted shapes against true ones.

Slow imports are inside the command, so that ``--help`` is quick.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.errors import UserError
from gamba_warp.files import write_options
from gamba_warp.surfaces.options import Method, Pixels, Views, Voxels
from gamba_warp.untrusted.ranges import Seed, ranged

Step = Literal["box", "scale", "yaw", "turn", "rigid", "icp"]
Frame = Literal["gt", "unit", "reference"]
Up = Literal["auto", "y", "z"]
PredAxes = Literal["auto", "opencv", "opengl", "z-up", "frame"]
PointRule = Literal["area", "views"]
GridRule = Literal["around", "lattice"]
OccupancyRule = Literal["solid", "joint", "enclosed", "majority", "winding", "parity", "none"]
ChamferForm = Literal["mean", "sum", "squared", "squared-sum"]

Reference = Annotated[int, Meta(ge=0, le=100_000)]
Distance = Annotated[float, Meta(ge=0.01, le=1000)]


@dataclass(frozen=True)
class ShapesOptions:
    """Options of ``gamba eval-geometry``; None keeps the protocol's value.

    Attributes:
        pred: Gaussians (.ply), a mesh or a point cloud; or a folder of them.
        gt: A mesh or a point cloud; or a folder, paired with PRED by name.
        out: Folder for report.json, objects.csv, table.md and table.tex. An interrupted evaluation
            resumes there.
        limit: Number of objects, evenly spaced in the order of names; all by default.
        shard: i/n takes every n-th of these objects from the i-th, for n machines; gamba eval-join
            joins their reports.
        objects: Text file of the objects of --protocol gso in place of its own list, one name a
            line; the report states that.
        baseline: Folders of other predictions of the same objects: PRED is compared with each,
            object by object. Rows are named by the folders.
        protocol: default, gso (the objects of "gamba data gso", in the input camera's frame), a
            published protocol (triposr, sf3d, spar3d, syncdreamer, gamba), or a JSON file: a
            protocol, or the report.json of an evaluation to repeat.
        explain: Print the protocol: statements of its source, open points and our choices; nothing
            is evaluated.
        set: Fields of the protocol, FIELD=JSON each: --set num_points=10000 surface.voxels=64
            thresholds=[0.1,0.2]. "--explain" lists them.
        surface: Method that turns Gaussians into a surface; centers is a diagnostic.
        align: Steps that align predictions with the truth, in order: box (bounding boxes), scale
            (centroids and spread of points), yaw and turn (rotation search about the upward axis or
            any), rigid and icp (ICP without and with scale); or none.
        frame: Frame of the predictions: that of the GT file, its unit frame (z-up, longest side 1,
            centred), or the reference camera's (needs --data).
        up: Upward axis of GT files; auto goes by the format: y for .obj, .glb and .gltf; for others
            it is unknown, and z is assumed.
        pred_axes: Axes of PRED files: opencv (y down), opengl (y up), z-up, or frame: those of
            --frame. auto goes by the format: opencv for Gaussians, opengl for .obj, .glb and .gltf;
            if those of PRED or GT are unknown, coordinates are used unchanged, and the report notes
            it.
        data: Dataset whose objects have the same names, for --frame reference.
        reference: Index of the input view, for --frame reference.
        distance: Distance of the input camera in the model's world, for --frame reference.
        points: Number of points on each surface.
        voxels: Number of voxels per unit of length, for surfaces of Gaussians.
        views: Number of views of the TSDF.
        pixels: Side of the TSDF's depth maps.
        seed: Seed of the random points.
        sensitivity: Evaluate under every protocol, and under each change of one field of this one:
            a table and a chart of the effect of the protocol, in OUT.
        paint: Number of objects whose surfaces are painted by distance, from the best to the worst,
            in OUT/painted.html.
        workers: Pairs evaluated at the same time, each in its own process.
        strict: Meshes with a flag other than "open" (not manifold, self-intersecting, inverted, …)
            are failures; else they are evaluated and flagged.
    """

    pred: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="PRED")] = None
    gt: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="GT")] = None
    out: Path | None = None
    limit: Annotated[int, Meta(ge=1)] | None = None
    shard: str | None = None
    objects: Path | None = None
    baseline: tuple[Path, ...] = ()
    protocol: str = "default"
    explain: bool = False
    set: tuple[str, ...] = ()
    surface: Method | None = None
    align: tuple[Step | Literal["none"], ...] | None = None
    frame: Frame | None = None
    up: Up | None = None
    pred_axes: PredAxes | None = None
    data: Path | None = None
    reference: Reference | None = None
    distance: Distance | None = None
    points: Annotated[int, Meta(ge=8, le=10_000_000)] | None = None
    voxels: Voxels | None = None
    views: Views | None = None
    pixels: Pixels | None = None
    seed: Seed | None = None
    sensitivity: bool = False
    paint: Annotated[int, Meta(ge=0, le=10_000)] = 0
    workers: Annotated[int, Meta(ge=1, le=256)] = 1
    strict: bool = False


@ranged
def eval_geometry_command(
    options: Annotated[ShapesOptions, tyro.conf.arg(name="")],
    json: bool = False,
    csv: bool = False,
) -> int:
    """Chamfer distance, F-score, normal consistency and Volume IoU of shapes.

    Prints the means with 95 % intervals over objects. Options default to the protocol's values.
    Exit code 1 if an object failed (each is listed), 2 if nothing could start.

    Args:
        options: of the evaluation.
        json: Print report.json in place of the summary.
        csv: Print objects.csv in place of the summary.
    """
    if json and csv:
        raise UserError("--json and --csv: give one of them")
    if options.explain:
        return _explain(options)
    if options.pred is None or options.gt is None:
        raise UserError("give PRED and GT: two files or two folders")
    from ..report import FAILED, count_line, csv_of, json_of
    from .pairs import evaluate_shapes
    from .protocol import chosen_protocol
    from .table import text_of

    protocol = chosen_protocol(options)
    if options.sensitivity and options.shard is not None:
        raise UserError("--sensitivity: cannot be divided by --shard")
    if options.sensitivity:
        from .sensitivity import evaluate_variants

        table, records = evaluate_variants(options, protocol)
        _save(options)
        print(table, end="")
        failed = [record for record in records if record["status"] == FAILED]
        for record in failed:
            print(f"failed: {record['name']}: {record['reason']}", file=sys.stderr)
        return 1 if failed else 0
    report = evaluate_shapes(options, protocol)
    _save(options)
    parts = {"": report} | report["baselines"]
    for name, part in parts.items():
        for text in part["warnings"]:
            print(f"warning: {name}{': ' if name else ''}{text}", file=sys.stderr)
    code = 1 if any(part["failures"] for part in parts.values()) else 0
    if json or csv:
        print(json_of(report) if json else csv_of(report), end="")
        return code
    print(text_of(report, protocol), end="")
    beside = sum(len(part["failures"]) for part in report["baselines"].values())
    print(count_line(report, options.out, beside))
    return code


def _save(options: ShapesOptions) -> None:
    """Write the options into the folder of the results, if there is one."""
    if options.out is not None:
        write_options(options.out, asdict(options))


def _explain(options: ShapesOptions) -> int:
    """Print the protocol that the options name, with its source."""
    from .. import presets
    from ..report import flat
    from .protocol import PRESETS, chosen_protocol

    preset = presets.PRESETS.get(options.protocol)
    if preset is not None and preset.views is not None:
        print(presets.explain(options.protocol, preset.views), "", sep="\n")
    if preset is None or options.protocol in PRESETS:
        protocol = chosen_protocol(options)
        print(presets.explain(protocol.name, flat(protocol.fields(), lists=True)))
        if protocol.changes():
            print(f"changed: {', '.join(protocol.changes())}")
    return 0
