"""Options of ``gamba eval-geometry``, and the values of its protocols' fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.surfaces.options import Method, Pixels, Views, Voxels
from gamba_warp.untrusted.ranges import Seed

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
        out: Folder for report.json, objects.csv, table.md and sheet.png. An interrupted evaluation
            resumes there.
        limit: Number of objects, evenly spaced in the order of names; all by default.
        objects: Text file of the objects of --protocol gso in place of its own list, one name a
            line; the report states that.
        protocol: default, gso (the objects of "gamba data gso", in the input camera's frame), a
            published protocol (triposr, sf3d, spar3d, syncdreamer, gamba), or a JSON file: a
            protocol, or the report.json of an evaluation to repeat.
        explain: Print the protocol: statements of its source, open points and our choices; nothing
            is evaluated.
        set: Fields of the protocol, FIELD=JSON each: --set num_points=10000 surface.voxels=64
            thresholds=[0.1,0.2]. "--explain" lists them.
        surface: Method that turns Gaussians into a surface; centers is a diagnostic.
        align: Steps that align predictions with the ground truth, in order: box (bounding boxes),
            scale (centroids and spread of points), yaw and turn (rotation search about the upward
            axis or any), rigid and icp (ICP without and with scale); or none.
        frame: Frame of the predictions: the GT file's, its unit frame (z-up, longest side 1,
            centred), or the reference camera's (needs --data).
        up: Upward axis of GT files; auto goes by the format: y for .obj, .glb and .gltf; for others
            it is unknown, and z is assumed.
        pred_axes: Axes of PRED files: opencv (y down), opengl (y up), z-up, or frame: those that
            the frame has. auto goes by the format: opencv for Gaussians, opengl for .obj, .glb and
            .gltf; if those of PRED or GT are unknown, coordinates are used unchanged, and the
            report notes it.
        data: Dataset whose objects have the same names, for --frame reference.
        reference: Index of the input view, for --frame reference.
        distance: Distance of the input camera in the model's world, for --frame reference.
        points: Number of points on each surface.
        voxels: Number of voxels per unit of length, for surfaces of Gaussians.
        views: Number of views of the TSDF.
        pixels: Side of the TSDF's depth maps.
        seed: Seed of the random points.
        sensitivity: Evaluate under every protocol, and under each change of one field of this one:
            a table of the effect of the protocol, in OUT.
        workers: Pairs evaluated at the same time, each in its own process.
        strict: Meshes with a flag other than "open" (not manifold, self-intersecting, inverted, …)
            are failures; else they are evaluated and flagged.
        sheet: Draw the worst and the best pairs, six of each, next to their ground truths.
    """

    pred: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="PRED")] = None
    gt: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="GT")] = None
    out: Path | None = None
    limit: Annotated[int, Meta(ge=1)] | None = None
    objects: Path | None = None
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
    workers: Annotated[int, Meta(ge=1, le=256)] = 1
    strict: bool = False
    sheet: bool = True
