"""A run's findings as tables, and a failing case as the content of a file."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from ...runtime.tables import markdown as markdown_table
from .case import Case, Op, Outcome

FORMAT = "gamba_warp.stress.1"
_HEAD = (
    "op", "kind", "cases", "forward error", "of", "gradient error", "of", "error / limit",
    "undecided pixels", "steep", "non-finite", "failures",
)  # fmt: skip


@dataclass
class Row:
    """What the cases of one kind found so far.

    Attributes:
        op: name of the op.
        kind: kind of values.
        cases: number of cases that were run.
        forward: largest relative rms error of a forward result in float32, and its name.
        gradient: largest relative rms error of a gradient, and its name.
        ratio: largest error over its limit; infinite if something was not finite.
        nonfinite: count of numbers that are not finite and should be.
        failures: number of cases that failed in any way.
        pixels: number of pixels compared (rasterizer).
        undecided: number of those pixels in which rounding decides a cut or an order.
        steep: number of cases that are judged by the widest limit of many trials.
        seconds: time spent.
    """

    op: str
    kind: str
    cases: int = 0
    forward: tuple[float, str] = (0.0, "")
    gradient: tuple[float, str] = (0.0, "")
    ratio: float = 0.0
    nonfinite: int = 0
    failures: int = 0
    pixels: int = 0
    undecided: int = 0
    steep: int = 0
    seconds: float = 0.0

    def add(self, outcome: Outcome, seconds: float) -> None:
        """Counts one case."""
        self.cases += 1
        self.seconds += seconds
        self.nonfinite += outcome.nonfinite
        self.failures += outcome.failure() is not None
        self.pixels += outcome.pixels
        self.undecided += outcome.undecided
        self.steep += outcome.steep
        for c in outcome.comparisons:
            self.ratio = max(self.ratio, c.ratio)
            which = "gradient" if c.name.startswith("gradient") else "forward"
            if c.counts:
                setattr(self, which, max(getattr(self, which), (c.error, c.name)))


class Tally:
    """Rows by op and kind, in the order in which they first appeared."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str], Row] = {}

    def add(self, case: Case, outcome: Outcome, seconds: float) -> None:
        """Counts one case, in the row of its kind and in that of its op."""
        for key in ((case.op, "all"), (case.op, case.kind)):
            self._rows.setdefault(key, Row(*key)).add(outcome, seconds)

    def totals(self) -> list[Row]:
        """Returns one row per op, of kind "all"."""
        return [row for row in self._rows.values() if row.kind == "all"]

    def sorted(self) -> list[Row]:
        """Returns all other rows, with those of an op together."""
        rows = [row for row in self._rows.values() if row.kind != "all"]
        ops = [row.op for row in self.totals()]
        return sorted(rows, key=lambda row: ops.index(row.op))


def table(rows: list[Row]) -> str:
    """Returns a Markdown table with its columns aligned for a terminal."""

    def error(value: float) -> str:
        return f"{value:.1e}" if value else "0"

    cells = []
    for r in rows:
        undecided = f"{r.undecided / r.pixels:.2%}" if r.pixels else ""
        counts = str(r.steep), str(r.nonfinite), str(r.failures)
        (forward, of), (gradient, of_gradient) = r.forward, r.gradient
        errors = error(forward), of, error(gradient), of_gradient.removeprefix("gradient of ")
        cells.append([r.op, r.kind, str(r.cases), *errors, f"{r.ratio:.2f}", undecided, *counts])
    return markdown_table(_HEAD, cells, aligned=True)


def plain_number(value: float | None) -> float | None:
    """Returns the number, or None for one that is not finite, which JSON cannot hold."""
    return value if value is not None and math.isfinite(value) else None


def document(tally: Tally, about: dict, failures: list[dict]) -> dict:
    """Returns the whole run as JSON values."""
    content: dict = {"format": FORMAT, **about, "totals": [], "rows": [], "failures": failures}
    for name, rows in (("totals", tally.totals()), ("rows", tally.sorted())):
        for row in rows:
            errors = {
                k: {"error": plain_number(error), "of": of}
                for k, (error, of) in (("forward", row.forward), ("gradient", row.gradient))
            }
            rest = {"ratio": plain_number(row.ratio), "seconds": round(row.seconds, 3)}
            content[name].append(asdict(row) | errors | rest)
    return content


def markdown(tally: Tally, about: dict, failures: list[dict]) -> str:
    """Returns the whole run as a Markdown page."""
    run = ", ".join(f"{name} {value}" for name, value in about.items())
    parts = ["# Numerical stress test", run, table(tally.totals()), table(tally.sorted())]
    if failures:
        parts += ["## Failures", "\n".join(f"- {f['file']}: {f['text']}" for f in failures)]
    return "\n\n".join(parts) + "\n"


def failure_text(case: Case, outcome: Outcome) -> str:
    """Describes a failure in one line."""
    failure = outcome.failure()
    assert failure is not None
    ratio = "" if failure["ratio"] is None else f"{failure['ratio']:.3g}"
    words = {"limit": f" is {ratio} times its limit off", "not finite": " is not finite"}
    return f"{case.op}, {case.kind}: {failure['name']}{words.get(failure['what'], '')}"


def reproducer(case: Case, outcome: Outcome, versions: dict) -> dict:
    """Returns the content of a file that ``read_reproducer`` reads."""
    failure = outcome.failure()
    if failure is not None:
        failure = {k: plain_number(v) if k in ("error", "ratio") else v for k, v in failure.items()}
    return {"format": FORMAT, "case": asdict(case), "failure": failure, "versions": versions}


def read_reproducer(document: object, ops: dict[str, Op]) -> Case:
    """Reads the case of a ``reproducer``.

    Raises:
        ValueError: the document is not such a file; the message says in one line what is wrong.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"not a case of 'gamba stress' (format is not {FORMAT})")
    case = document.get("case")
    keys = {"op": str, "kind": str, "seed": int, "options": dict}
    if not isinstance(case, dict) or {k: type(v) for k, v in case.items()} != keys:
        raise ValueError(f"damaged: case must have {', '.join(keys)} and nothing else")
    op = ops.get(case["op"])
    if op is None or case["kind"] not in op.kinds:
        shown = f"{case['op'][:40]}, {case['kind'][:40]}"
        raise ValueError(f"this version has no case {shown!r}")
    if not 0 <= case["seed"] < 2**31:
        raise ValueError("damaged: seed is not in 0 to 2147483647")
    options = case["options"]
    for name in sorted(options.keys() | op.plain.keys()):
        if name not in op.plain or name not in options:
            kind = "an unknown" if name in options else "no"
            raise ValueError(f"{kind} option {name[:40]!r}; from another version, or damaged")
        value, plain = options[name], op.plain[name]
        allowed = op.choices.get(name)
        wrong = type(value) is not type(plain) or (allowed and value not in allowed)
        if wrong or (isinstance(value, (int, float)) and not 0 <= value <= 10**6):
            shown = repr(value)[:40]
            raise ValueError(f"option '{name}' is {shown}; from another version, or damaged")
    fitting = op.valid(options)
    for name, value in options.items():
        if fitting[name] != value:
            text = f"'{name}' is {value}, and {fitting[name]} is the nearest that fits"
            raise ValueError(f"damaged: its options do not fit each other: {text}")
    return Case(**case)
