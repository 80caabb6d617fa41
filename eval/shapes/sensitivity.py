"""Sensitivity to the protocol: the same predictions under many protocols.

Every named protocol, and the chosen one with one field changed at a time. Frames and axes describe
the files, so they always follow the chosen protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json, write_text

from ..averages import mean_of
from ..report import OK, check_finite, finite_or_none, stdout_to_stderr
from ..tables import Lines, markdown
from .options import ShapesOptions
from .pairs import Pair, evaluate_pairs, open_pairs
from .protocol import PRESETS, GeometryProtocol
from .shape import Similarity

CHOSEN = "chosen"
_FILE_FIELDS = ("frame", "up", "pred_axes", "reference", "distance", "strict", "seed")
# Alternative values by field. Those of "surface" matter only for Gaussians.
_CHANGES: dict[str, tuple[Any, ...]] = {
    "points": ("area", "views"),
    "num_points": (2_000, 10_000, 30_000, 100_000),
    "seed": (1,),
    "unit": (1.0, 2.0),
    "chamfer": ("mean", "sum", "squared", "squared-sum"),
    "align": (
        (),
        ("box",),
        ("scale",),
        ("rigid",),
        ("scale", "icp"),
        ("scale", "yaw", "rigid"),
        ("scale", "turn", "rigid"),
        ("scale", "turn", "icp"),
    ),
    "occupancy": ("solid", "joint", "enclosed", "majority", "winding", "parity"),
    "grid": ("around", "lattice"),
    "iou_voxels": (32, 64, 128),
    "surface.method": ("tsdf", "density", "centers"),
    "surface.voxels": (64, 128, 256),
    "surface.transmittance": (0.92, 0.5),
}


# Fields that each stage's result depends on.
_LOADED = ("surface", "num_points", "seed")
_MOVED = (*_LOADED, "points", "align")
_DEPENDS_ON = {
    "load_prediction": _LOADED,
    "align_shape": _MOVED,
    "point_metrics": (*_MOVED, "unit", "chamfer", "thresholds"),
    "shape_iou": (*_MOVED, "occupancy", "grid", "iou_voxels"),
}


def variants(protocol: GeometryProtocol) -> dict[str, GeometryProtocol]:
    """Return the protocols to compare by label: the chosen one, its changes, the named ones."""
    protocols = {CHOSEN: protocol}
    for field, values in _CHANGES.items():
        inner, _, name = field.rpartition(".")
        for value in values:
            if inner:
                changed = replace(protocol, surface=replace(protocol.surface, **{name: value}))
            else:
                changed = replace(protocol, **{name: value})
            if changed != protocol:
                shown = "+".join(value) or "none" if isinstance(value, tuple) else str(value)
                protocols[f"{field} = {shown}"] = changed
    of_files = {name: getattr(protocol, name) for name in _FILE_FIELDS}
    named: dict[GeometryProtocol, list[str]] = {}
    for name, preset in PRESETS.items():
        named.setdefault(replace(preset, name="", **of_files), []).append(name)
    return protocols | {f"protocol {', '.join(names)}": p for p, names in named.items()}


def evaluate_variants(
    options: ShapesOptions, protocol: GeometryProtocol
) -> tuple[str, list[dict[str, Any]]]:
    """Evaluate all pairs under all variants; write sensitivity.json and .md into OUT.

    Args:
        options: with the files to compare and the folder of the results.
        protocol: the chosen one.

    Returns:
        The table of sensitivity.md, and the records of all objects.

    Raises:
        UserError: something cannot be opened or written, or no object could be evaluated.
    """
    dataset, pairs, failures = open_pairs(options, protocol)
    folder = None if options.out is None else output_folder(options.out)
    protocols = variants(protocol)
    vary = partial(vary_pair, protocols=protocols)
    with stdout_to_stderr():
        records = failures + evaluate_pairs(
            pairs, protocol, dataset, evaluate=vary, workers=options.workers
        )
    done: list[Any] = [record["variants"] for record in records if record["status"] == OK]
    if not done:
        reasons = "; ".join(f"{r['name']}: {r['reason']}" for r in records[:3])
        raise UserError(f"no object could be evaluated: {reasons}")
    rows = {}
    for label, chosen in protocols.items():
        figures = [record[label] for record in done if "failed" not in record[label]]
        rows[label] = {
            "objects": len(figures),
            "thresholds": list(chosen.thresholds),
            "unit": chosen.unit,
            "mean": mean_of(figures),
        }
    page = _page(rows, len(done))
    if folder is not None:
        report = {"protocol": protocol.to_json(), "rows": rows, "objects": records}
        write_json(folder / "sensitivity.json", finite_or_none(report))
        write_text(folder / "sensitivity.md", page)
    return page, records


def vary_pair(
    pair: Pair,
    protocol: GeometryProtocol,
    transform: Similarity | None,
    protocols: dict[str, GeometryProtocol],
) -> dict[str, Any]:
    """Return the record of one pair: metrics, or the reason of a failure, under each protocol.

    Args:
        pair: the files.
        protocol: the chosen one, which loads the ground truth.
        transform: of the prediction into the ground truth's unit frame; None: the same as the
            ground truth's.
        protocols: by label.

    Raises:
        UserError: a file cannot be read.
    """
    from .load import FRAME_AXES, load_gt, load_prediction
    from .metrics import align_shape, point_metrics, shape_iou

    gt = load_gt(pair.gt, protocol, pair.rotation, pair.placement)
    axes = FRAME_AXES.get(protocol.frame, gt.axes)
    known: dict[Any, Any] = {}

    def once(function: Callable, *arguments: Any) -> Any:
        """Return the function's result, computed once for all protocols that share it."""
        chosen = arguments[-1]
        key = (function, *(repr(getattr(chosen, name)) for name in _DEPENDS_ON[function.__name__]))
        if key not in known:
            known[key] = function(*arguments)
        return known[key]

    figures: dict[str, dict[str, Any]] = {}
    for label, chosen in protocols.items():
        try:
            loaded = once(load_prediction, pair.pred, transform or gt.transform, axes, chosen)
            moved, _ = once(align_shape, loaded.shape, gt.shape, chosen)
            metrics = once(point_metrics, moved, gt.shape, chosen)
            metrics = metrics | once(shape_iou, moved, gt.shape, chosen)
            figures[label] = check_finite(_row_figures(metrics, chosen))
        except UserError as error:
            figures[label] = {"failed": str(error)}
    return {"name": pair.name, "status": OK, "variants": figures}


def _row_figures(metrics: dict[str, Any], protocol: GeometryProtocol) -> dict[str, Any]:
    """Return a row's figures: Chamfer, F-score at the least threshold, normals, Volume IoU."""
    least = f"{min(protocol.thresholds):g}"
    keys = ("chamfer", "normal_consistency", "iou", "noise_floor")
    return {key: metrics[key] for key in keys} | {"fscore": metrics["fscore"][least]}


def _page(rows: dict[str, dict[str, Any]], count: int) -> str:
    """Return the text of ``sensitivity.md``."""
    lines: Lines = [
        ["", "objects", "Chamfer", "of the chosen", "F-score", "at", "normals", "Volume IoU"]
    ]
    base = rows[CHOSEN]["mean"].get("chamfer")
    for label, row in rows.items():
        chamfer, fscore, normals, iou = (
            row["mean"].get(key) for key in ("chamfer", "fscore", "normal_consistency", "iou")
        )
        ratio = chamfer / base if chamfer is not None and base else None
        at = f"{min(row['thresholds']):g} of {row['unit']:g}"
        lines.append(
            [
                *(label, str(row["objects"]), _number(chamfer, 4), _number(ratio, 2)),
                *(_number(fscore, 4), at, _number(normals, 3), _number(iou, 3)),
            ]
        )
    note = (
        f"The same predictions of {count} objects under one protocol a row: means over the objects "
        "that could be evaluated. F-score: at the protocol's least threshold, where the second "
        "number is the ground truth's longest side."
    )
    return f"{markdown(lines)}\n\n{note}\n"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
