"""Protocols of ``eval-geometry``: definitions, presets and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from gamba_warp.conventions import DEFAULT_DISTANCE
from gamba_warp.errors import UserError
from gamba_warp.surfaces.options import SurfaceOptions
from gamba_warp.untrusted.documents import read_document, value_of
from gamba_warp.untrusted.ranges import Seed, check_options

from .. import presets
from .align import STEPS
from .occupancy import RULES
from .options import (
    ChamferForm,
    Distance,
    Frame,
    GridRule,
    OccupancyRule,
    PointRule,
    PredAxes,
    Reference,
    ShapesOptions,
    Step,
    Up,
)

Thresholds = Annotated[
    tuple[Annotated[float, Meta(gt=0, le=100)], ...], Meta(min_length=1, max_length=100)
]
VERSION = 5  # raised whenever the same protocol would give other numbers

POINTS: dict[PointRule, str] = {
    "area": "area-uniform on the whole surface, inner faces included; faces given twice and faces "
    "without area do not count; of a point cloud a random draw without repetition, all where it "
    "has no more",
    "views": "depth maps of 16 cameras (256 pixels, focal length 280, distance 1.5, elevation "
    "30 degrees, azimuths 22.5 apart) back-projected, one mean point a voxel of 0.01; of a point "
    "cloud as 'area'",
}
GRIDS: dict[GridRule, str] = {
    "around": "voxels around both shapes, 'iou_voxels' a unit, faces on multiples of their side; "
    "larger where the longest side of both together would have more than twice as many",
    "lattice": "64 points a side from -1 in steps of 1/32",
}
FORMS: dict[ChamferForm, str] = {
    "mean": "mean of the two mean nearest distances between points, not squared",
    "sum": "sum of the two mean nearest distances between points, not squared",
    "squared": "mean of the two mean squared nearest distances",
    "squared-sum": "sum of the two mean squared nearest distances",
}
DEFINITIONS = {
    "normalization": "ground truth centred on its bounding box, longest side 1, turned to z-up",
    "axes": "of a file: asked for, else of a ground truth what the dataset rendered of it says, "
    "else those of its format (Gaussians: opencv; .obj, .glb, .gltf: opengl), else unknown; a "
    "prediction is turned into those of its frame where both are known",
    "samples": "both shapes are drawn from with one seed: a shape and itself have distance 0",
    "chamfer_squared": FORMS["squared"],
    "accuracy": "mean nearest distance from predicted to true points",
    "completeness": "mean nearest distance from true to predicted points",
    "hausdorff": "largest nearest distance, of either way, between the points",
    "fscore": "harmonic mean of the fractions of predicted and of true points within the threshold",
    "normal_consistency": "mean absolute cosine at nearest points, mean of both ways",
    "noise_floor": "chamfer between two samples of the ground truth, one way; of a point cloud "
    "between two halves that share no point",
}


@dataclass(frozen=True)
class GeometryProtocol:
    """Complete definition of the numbers of ``eval-geometry``.

    Fields that are lengths assume that the ground truth's longest side is 1. In reports, and for
    the thresholds, it is ``unit``.

    Attributes:
        name: name of the preset, or that in a file.
        points: rule for points on surfaces, one of ``POINTS``.
        num_points: number of points per shape (for "area", and for point clouds).
        seed: seed of the random points, of both shapes.
        unit: length of the ground truth's longest side: 2 for sources that use the cube [-1, 1]^3.
        chamfer: the form of the Chamfer distance, one of ``FORMS``.
        thresholds: distances of the F-score.
        occupancy: rule of the Volume IoU, one of ``occupancy.RULES``; "none" skips it.
        grid: grid of the Volume IoU, one of ``GRIDS``.
        iou_voxels: number of the grid's voxels per unit of length, for "around".
        align: steps of the alignment with the ground truth, of ``align.STEPS``.
        frame: of the predictions (see the command).
        up: upward axis of the ground truth's files.
        pred_axes: axes of the predictions' files (see the command).
        reference: index of the input view, for the frame "reference".
        distance: distance of the input camera in the model's world, for the frame "reference".
        strict: meshes that are not manifold, intersect themselves, are inverted, or have degenerate
            or duplicate faces are failures.
        surface: options of surfaces of Gaussians.
    """

    name: Annotated[str, Meta(max_length=200)] = "default"
    points: PointRule = "area"
    num_points: Annotated[int, Meta(ge=1, le=10_000_000)] = 100_000
    seed: Seed = 0
    unit: Annotated[float, Meta(ge=1e-3, le=1e3)] = 1.0
    chamfer: ChamferForm = "mean"
    thresholds: Thresholds = (0.01, 0.02, 0.05)
    occupancy: OccupancyRule = "solid"
    grid: GridRule = "around"
    iou_voxels: Annotated[int, Meta(ge=8, le=512)] = 64
    align: Annotated[tuple[Step, ...], Meta(max_length=10)] = ()
    frame: Frame = "gt"
    up: Up = "auto"
    pred_axes: PredAxes = "auto"
    reference: Reference = 0
    distance: Distance = DEFAULT_DISTANCE
    strict: bool = False
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)

    def definitions(self) -> dict[str, str]:
        """Return the definitions of the chosen rules and of each metric."""
        return {
            "points": POINTS[self.points],
            "chamfer": FORMS[self.chamfer],
            "align": "; then ".join(STEPS[step] for step in self.align) or "nothing is moved",
            "occupancy": "it is not taken"
            if self.occupancy == "none"
            else RULES[self.occupancy].meaning,
            "grid": GRIDS[self.grid],
            **DEFINITIONS,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the protocol for a report; ``read_protocol`` reads it back."""
        return {"version": VERSION, **self.fields(), "definitions": self.definitions()}

    def fields(self) -> dict[str, Any]:
        """Return all values by field, as in JSON."""
        return asdict(self) | {"thresholds": list(self.thresholds), "align": list(self.align)}

    def changes(self) -> list[str]:
        """Return the fields that differ from the preset of this name, else from the default."""
        preset = asdict(PRESETS.get(self.name, PRESETS["default"]))
        mine = asdict(self)
        changed = [k for k in mine if k not in ("name", "surface") and mine[k] != preset[k]]
        nested = [k for k, v in mine["surface"].items() if v != preset["surface"][k]]
        return changed + [f"surface.{k}" for k in nested]


PRESETS = {"default": GeometryProtocol()} | {
    name: msgspec.convert({"name": name, **preset.shapes}, GeometryProtocol)
    for name, preset in presets.PRESETS.items()
    if preset.shapes is not None
}


def chosen_protocol(options: ShapesOptions) -> GeometryProtocol:
    """Return the protocol that the options name, with their own values.

    Raises:
        UserError: the protocol is unknown, or a number is out of its range.
    """
    base = read_protocol(options.protocol)
    check_options(options)
    names = ("seed", "frame", "up", "pred_axes", "reference", "distance")
    outer = {name: getattr(options, name) for name in names}
    outer |= {"num_points": options.points, "strict": options.strict or None}
    if options.align is not None:
        outer["align"] = tuple(step for step in options.align if step != "none")
    surface = {name: getattr(options, name) for name in ("voxels", "views", "pixels")}
    surface["method"] = options.surface
    outer, surface = ({k: v for k, v in part.items() if v is not None} for part in (outer, surface))
    chosen = replace(base, surface=replace(base.surface, **surface), **outer)
    return with_fields(chosen, options.set) if options.set else chosen


def with_fields(protocol: GeometryProtocol, texts: Sequence[str]) -> GeometryProtocol:
    """Set fields of a protocol, given as ``FIELD=JSON`` or ``surface.FIELD=JSON``.

    A value that is not JSON counts as text.

    Raises:
        UserError: a malformed text, an unknown field, or a value out of its range.
    """
    value = protocol.fields()
    for text in texts:
        field, sign, literal = text.partition("=")
        inner, _, name = field.rpartition(".")
        target = value["surface"] if inner == "surface" else value
        if not sign or inner not in ("", "surface") or name not in target or field == "surface":
            known = ", ".join([*(k for k in value if k != "surface"), "surface.…"])
            raise UserError(f"--set {text}: expected FIELD=JSON, FIELD one of {known}")
        target[name] = value_of(literal)
    return _checked(value, f"--set {' '.join(texts)}")


def _checked(value: dict[str, Any], whose: str | Path) -> GeometryProtocol:
    try:
        return msgspec.convert(value, GeometryProtocol)
    except msgspec.ValidationError as error:
        raise UserError(f"{whose}: {error}") from error


def read_protocol(choice: str) -> GeometryProtocol:
    """Find a preset by name, or read a JSON file: a protocol, or a report with one.

    Missing fields come from the preset of its ``name``, or from the default.

    Raises:
        UserError: neither a preset nor a readable file; an unknown field, a value of the wrong type
            or out of its range, or another version.
    """
    if choice in PRESETS:
        return PRESETS[choice]
    path = Path(choice)
    if choice in presets.PRESETS:
        raise UserError(f"--protocol {choice}: is for views (gamba eval-views), not for shapes")
    if not path.is_file():
        raise UserError(f"--protocol {choice}: expected {', '.join(PRESETS)} or a file")
    value = read_document(path, dict[str, Any])
    return protocol_of(inner if isinstance(inner := value.get("protocol"), dict) else value, path)


def protocol_of(value: Mapping[str, Any], path: Path) -> GeometryProtocol:
    """Return a protocol of its fields; ``path`` is for errors, as of ``read_protocol``."""
    value = dict(value)
    version, words = value.pop("version", VERSION), value.pop("definitions", None)
    if version != VERSION:
        shown = str(version)[:40]
        raise UserError(f"{path}: protocol version {shown}, this program has version {VERSION}")
    base = asdict(PRESETS.get(str(value.get("name")), PRESETS["default"]))
    surface = value.get("surface", {})
    if isinstance(surface, dict):
        value["surface"] = base["surface"] | surface
        for at, part, known in (("", value, base), ("surface.", surface, base["surface"])):
            if unknown := part.keys() - known.keys():
                names = ", ".join(sorted(known))
                raise UserError(f"{path}: {at}{min(unknown)} is not a known field; known: {names}")
    protocol = _checked(base | value, path)
    if words is not None and words != protocol.definitions():
        raise UserError(f"{path}: its definitions differ from this program's")
    return protocol
