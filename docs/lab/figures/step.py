"""Writes the tables of docs/lab/step.md from cpu-step.json and cpu-precision.json.

After both measurements:

    make study WHAT="step --threads 1 --data starter/data --out out/step"
    make study WHAT="model --only precision --out out/model"
    cp out/step/bench.json docs/lab/benchmarks/cpu-step.json
    cp out/model/bench.json docs/lab/benchmarks/cpu-precision.json
    make figures
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.studies.parts import WHOLE, parts_of

from gamba_warp.files import write_text
from gamba_warp.kernels.bench.core.report import machine_line
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.measure.suites import read_document

from .parts import with_parts

LAB = Path(__file__).parents[1]
PAGE = LAB / "step.md"
STEP, PRECISION = (LAB / "benchmarks" / f"cpu-{name}.json" for name in ("step", "precision"))
_PRECISIONS = ("float32", "bfloat16")
_BOTH = " / ".join(_PRECISIONS)


def main() -> None:
    """Update the page."""
    text = PAGE.read_text(encoding="utf-8")
    write_text(PAGE, page_of(text, read_document(STEP), read_document(PRECISION)))


def page_of(text: str, step: dict, precision: dict) -> str:
    """Update the parts of the page between its marks from the results.

    Args:
        text: of the page.
        step: results of the suite step, from ``read_document``.
        precision: those of the case precision of the suite model.

    Raises:
        ValueError: the page lacks a mark, or the results lack a variant.
    """
    pictures = _Case(precision, "model", "precision")
    parts = {
        "shares": "\n\n".join([_shares(_Case(step, "step", "parts")), machine_line(step)]),
        "products": "\n\n".join([_products(pictures), machine_line(precision)]),
        "pictures": _compared(pictures, ("tiny", "rays", "paper"), "Gaussians"),
        "gradients": _compared(
            _Case(step, "step", "precision"), ("tiny", "rays"), "gradient", angle=True
        ),
        "ssim": _ssim(_Case(step, "step", "SSIM")),
        "optimizer": _optimizer(_Case(step, "step", "optimizer")),
    }
    return with_parts(text, "make figures", parts)


class _Case:
    """The records of a case."""

    def __init__(self, document: dict, op: str, case: str) -> None:
        self._name = f"{op}, {case}"
        records = document["records"]
        self._records = {r["variant"]: r for r in records if (r["op"], r["case"]) == (op, case)}

    def __getitem__(self, variant: str) -> dict[str, Any]:
        """Return the record of a variant; raise ValueError without a timed one."""
        found = self._records.get(variant)
        if found is None or found["ms_p50"] is None:
            raise ValueError(f"no time of {self._name}, {variant}")
        return found

    def ms(self, variant: str) -> str:
        """The median of a variant's times."""
        ms = self[variant]["ms_p50"]
        return f"{ms:,.0f}" if ms >= 20 else f"{ms:.3g}"


def _shares(case: _Case) -> str:
    """Shares of the parts in the time of a step."""
    names = ("tiny", "tiny, bfloat16", "rays", "rays, bfloat16")
    columns = [(case[name]["work"][WHOLE], parts_of(case[name])) for name in names]
    rows = [["whole, ms", *(f"{whole:,.0f}" for whole, _ in columns)]]
    for part in columns[0][1]:
        shares = [sum(parts.get(part, (0.0,))) / whole for whole, parts in columns]
        rows.append([part, *(f"{100 * x:.{1 if x < 0.02 else 0}f} %" for x in shares)])
    return markdown(["share of a step", *names], rows)


def _products(case: _Case) -> str:
    """Time of a picture at the paper's size, and speed of its products."""
    kinds = ("paper, float32", "paper, bfloat16")
    alone = [*(f"{kind}, products alone" for kind in kinds), "paper, MKL's products alone"]
    rates = [f"{case[x]['work']['flops'] / case[x]['ms_p50'] / 1e6:,.0f}" for x in alone]
    rows = [
        ["a picture to Gaussians, ms", *map(case.ms, kinds), ""],
        ["its products alone, ms", *map(case.ms, alone)],
        ["the same, GFLOP/s", *rates],
    ]
    return markdown(["", *_PRECISIONS, "float32 by MKL"], rows)


def _compared(case: _Case, presets: tuple[str, ...], what: str, angle: bool = False) -> str:
    """Difference of ``what`` of each preset from that of float32, in both precisions."""
    shown: dict[str, Callable[[dict], str]] = {
        "ms": lambda r: case.ms(r["variant"]),
        f"{what}, relative rms": lambda r: f"{r['rel_rms_error']:.1e}",
    }
    if angle:
        shown["1 - cosine"] = lambda r: f"{r['work']['gradient_angle']:.0e}"
    shown["pictures, PSNR in dB"] = lambda r: f"{r['work']['psnr_to_float32']:.1f}"
    rows = []
    for preset in presets:
        found = [case[f"{preset}, {kind}"] for kind in _PRECISIONS]
        name = f"{preset}, {found[0]['parameters']['weights']} weights"
        rows.append([name, *(" / ".join(map(show, found)) for show in shown.values())])
    return markdown([_BOTH, *shown], rows)


def _ssim(case: _Case) -> str:
    """1 - SSIM beside kornia's."""
    rows = []
    for name, text in (("objects", "objects before white"), ("all over", "everywhere different")):
        ours, theirs = case[f"ours, {name}"], case[f"kornia, {name}"]
        rows.append(
            [
                text,
                *(case.ms(r["variant"]) for r in (theirs, ours)),
                f"{theirs['ms_p50'] / ours['ms_p50']:.1f} x",
                *(f"{r['rel_rms_error']:.1e}" for r in (theirs, ours)),
            ]
        )
    header = ["pictures", "kornia, ms", "kernels, ms", "ratio", "error of kornia", "of the kernels"]
    return markdown(header, rows)


def _optimizer(case: _Case) -> str:
    """Times after the gradient, with each optimizer."""
    ways = ("fused", "foreach", "single")
    rows = [["AdamW", *(case.ms(f"AdamW, {way}") for way in ways)]]
    for name, text in (("norm", "norm of the gradient"), ("average", "running average")):
        rows.append([text, "", *(case.ms(f"{name}, {way}") for way in ways[1:])])
    ends = " and ".join(f"{case.ms(f'gradients to {to}')} ms to {to}" for to in ("None", "zero"))
    return f"{markdown(['ms', *ways], rows)}\n\nTo set the gradients takes {ends}."
