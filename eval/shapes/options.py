"""Options of ``gamba eval-geometry``, and the words that they and protocols choose from.

This module imports nothing that is slow.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.surfaces.options import Method, Pixels, Views, Voxels
from gamba_warp.untrusted.ranges import Seed, check_options

Align = Literal["none", "scale", "icp"]
Frame = Literal["gt", "unit", "reference"]
Up = Literal["auto", "y", "z"]
PredAxes = Literal["auto", "opencv", "opengl", "z-up", "frame"]
PointRule = Literal["area", "views"]
GridRule = Literal["around", "lattice"]
OccupancyRule = Literal["solid", "joint", "enclosed", "majority", "winding", "parity"]

Reference = Annotated[int, Meta(ge=0, le=100_000)]
Distance = Annotated[float, Meta(ge=0.01, le=1000)]


@dataclass(frozen=True)
class ShapesOptions:
    """What to evaluate, and what differs from the protocol; None leaves the protocol's value."""

    pred: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PRED")]
    """Gaussians (.ply), a mesh or a point cloud; or a folder of them."""
    gt: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GT")]
    """A mesh or a point cloud; or a folder, paired with PRED by name."""
    out: Path | None = None
    """Folder for report.json, objects.csv and, with --baseline, table.md."""
    baseline: tuple[Path, ...] = ()
    """Folders of other predictions of the same objects: PRED is compared with each, object by
    object. A folder's name names its row."""
    protocol: str = "default"
    """default, syncdreamer (points that 16 cameras see, parity on a 64^3 lattice), gso (the objects
    of "gamba data gso", in the input camera's frame), or a JSON file: a protocol, or the
    report.json of an evaluation to repeat."""
    surface: Method | None = None
    """How Gaussians become a surface; centers is a diagnostic."""
    align: Align | None = None
    """How predictions are aligned with the truth before comparing; scale also moves, icp also
    turns."""
    frame: Frame | None = None
    """Frame of the predictions: that of the GT file, its unit frame (z-up, longest side 1,
    centred), or the reference camera's (needs --data)."""
    up: Up | None = None
    """Upward axis of GT files; auto goes by the format: y of .obj, .glb and .gltf; of others it is
    not known, and taken for z."""
    pred_axes: PredAxes | None = None
    """Axes of PRED files: opencv (y down), opengl (y up), z-up, or frame: those of --frame already.
    auto goes by the format: opencv of Gaussians, opengl of .obj, .glb and .gltf; where those of
    PRED or GT are not known, coordinates are used as they are, and the report says so."""
    data: Path | None = None
    """Dataset whose objects have the same names, for --frame reference."""
    reference: Reference | None = None
    """Index of the input view, for --frame reference."""
    distance: Distance | None = None
    """Distance of the input camera in the model's world, for --frame reference."""
    points: Annotated[int, Meta(ge=8, le=10_000_000)] | None = None
    """Number of points on each surface."""
    voxels: Voxels | None = None
    """Number of voxels in a unit of length, for surfaces of Gaussians."""
    views: Views | None = None
    """Number of views of the TSDF."""
    pixels: Pixels | None = None
    """Side of the TSDF's depth maps."""
    seed: Seed | None = None
    """Seed of the random points."""
    strict: bool = False
    """Meshes with a flag other than "open" (not manifold, self-intersecting, inverted, …) are
    failures; else they are evaluated and flagged."""

    def check(self) -> None:
        """Checks the numbers that are given here.

        Raises:
            UserError: one is out of its range; the message names the option.
        """
        check_options(self)
