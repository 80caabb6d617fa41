"""Reports: a run's findings as tables, and a failing case as the content of a file."""

from __future__ import annotations

import math
from dataclasses import asdict

from .case import Case, Op, Outcome
from .runner import Row, Tally

FORMAT = "gamba_warp.stress.1"
_HEAD = (
    "op", "kind", "cases", "forward error", "of", "gradient error", "of", "error / limit",
    "undecided pixels", "steep", "non-finite", "failures",
)  # fmt: skip


def _error(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _cells(row: Row) -> list[str]:
    share = f"{row.undecided / row.pixels:.2%}" if row.pixels else ""
    return [
        row.op, row.kind, str(row.cases), _error(row.forward[0]), row.forward[1],
        _error(row.gradient[0]), row.gradient[1].removeprefix("gradient of "), f"{row.ratio:.2f}",
        share, str(row.steep), str(row.nonfinite), str(row.failures),
    ]  # fmt: skip


def table(rows: list[Row]) -> str:
    """Returns a Markdown table with its columns aligned for a terminal."""
    cells = [list(_HEAD), *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(_HEAD))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(line, widths)) + " |" for line in cells]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def plain_number(value: float | None) -> float | None:
    """Returns the number, or None for one that is not finite, which JSON cannot hold."""
    return value if value is not None and math.isfinite(value) else None


def _record(row: Row) -> dict:
    record = asdict(row)
    for name in ("forward", "gradient"):
        record[name] = {"error": plain_number(record[name][0]), "of": record[name][1]}
    return record | {"ratio": plain_number(row.ratio), "seconds": round(row.seconds, 3)}


def document(tally: Tally, about: dict, failures: list[dict]) -> dict:
    """Returns the whole run as JSON values."""
    rows = [_record(row) for row in tally.sorted()]
    totals = [_record(row) for row in tally.totals()]
    return {"format": FORMAT, **about, "totals": totals, "rows": rows, "failures": failures}


def markdown(tally: Tally, about: dict, failures: list[dict]) -> str:
    """Returns the whole run as a Markdown page."""
    run = ", ".join(f"{name} {value}" for name, value in about.items())
    parts = [
        "# Numerical stress test",
        run,
        table(tally.totals()),
        table(tally.sorted()),
    ]
    if failures:
        parts += ["## Failures", "\n".join(f"- {f['file']}: {f['text']}" for f in failures)]
    return "\n\n".join(parts) + "\n"


def failure_text(case: Case, failure: dict) -> str:
    """Describes a failure in one line."""
    title, name = f"{case.op}, {case.kind}", failure["name"]
    if failure["what"] == "limit":
        return f"{title}: {name} is {failure['ratio']:.3g} times its limit off"
    if failure["what"] == "not finite":
        return f"{title}: {name} is not finite"
    return f"{title}: {name}"


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
