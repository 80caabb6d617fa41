"""Targets for figures, and quotients of figures, of ``gamba bench`` and the studies.

``make study`` checks its results, and with --render also those of ``gamba bench``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from gamba_warp.kernels.bench.core.case import BOTH, DIRECTIONS
from gamba_warp.kernels.bench.core.report import Table, number


@dataclass(frozen=True)
class Key:
    """Key of a figure; ``field`` is ``ms_p50`` or a key of the record's ``work``."""

    op: str
    case: str
    variant: str
    direction: str = "forward"
    field: str = "ms_p50"


@dataclass(frozen=True)
class Target:
    """Target for a figure or a quotient of figures.

    Attributes:
        text: meaning of the figure, in words.
        times: figures to multiply.
        over: figures to divide by.
        scale: factor of the quotient.
        at_least: the bound, if it is a lower one.
        at_most: the bound, if it is an upper one.
    """

    text: str
    times: tuple[Key, ...]
    over: tuple[Key, ...] = ()
    scale: float = 1.0
    at_least: float | None = None
    at_most: float | None = None


def judge(targets: Iterable[Target], records: Sequence[dict]) -> list[dict]:
    """Compare records with targets.

    Returns:
        ``{op, text, wanted, value, reached}`` for each target whose cases were measured; ``value``
        and ``reached`` are None if a figure is missing.
    """
    cases = {(r["op"], r["case"]) for r in records}
    found = {(r["op"], r["case"], r["variant"], r["direction"]): r for r in reversed(records)}

    def figure(key: Key) -> float:
        r = found.get((key.op, key.case, key.variant, key.direction), {"work": {}})
        return (r[key.field] if key.field in r else r["work"].get(key.field)) or 0.0

    rows = []
    for target in targets:
        keys = (*target.times, *target.over)
        if not all((k.op, k.case) in cases for k in keys):
            continue
        below = math.prod(map(figure, target.over))
        value = target.scale * math.prod(map(figure, target.times)) / below if below else None
        reached = None
        if value:
            low = target.at_least is None or value >= target.at_least
            reached = low and (target.at_most is None or value <= target.at_most)
        wanted = f"≥ {target.at_least:.3g}" if target.at_least else f"≤ {target.at_most:.3g}"
        row = dict(op=keys[0].op, text=target.text, wanted=wanted)
        rows.append(row | dict(value=value or None, reached=reached))
    return rows


def rows(document: dict) -> list[Table]:
    """The targets of a document as a table, or none; those of ``gamba bench`` are judged here."""
    judged = document.get("targets")
    if judged is None:
        judged = judge(of_bench(document), document["records"])
    cells = [
        [t["op"], t["text"], t["wanted"], number(t["value"]), _WORDS[t["reached"]]] for t in judged
    ]
    return [(("", "target", "wanted", "measured", ""), cells)] if cells else []


def lines(document: dict) -> list[str]:
    """A line for each target of a document."""
    return [
        f"{word:<12} {value:>8}  ({wanted})  {op}: {text}"
        for _, cells in rows(document)
        for op, text, wanted, value, word in cells
    ]


_WORDS = {True: "reached", False: "missed", None: "not measured"}


def of_bench(document: dict) -> list[Target]:
    """The targets of a document of ``gamba bench``; none at a quick run's sizes."""
    level = document.get("settings", {}).get("level")
    if level == "quick":
        return []
    cuda = document["machine"]["gpu"] is not None
    made = [*_scan(cuda), *_raster(cuda, level == "full")]
    pairs = [
        (f"torch conv1d's time over ours, {d}", "conv", "operator", "torch conv1d", "default", d, 1)
        for d in DIRECTIONS
    ]
    for r in document["records"]:
        if r["case"].startswith("harmonics") and r["is_peer"]:
            text, suffix = f"{r['variant']}: its time over ours", r["variant"].split(", ", 1)[1]
            ours = f"ours, {suffix}"
            pairs.append((text, r["op"], r["case"], r["variant"], ours, r["direction"], 2))
    for text, op, case, theirs, ours, direction, least in pairs:
        times, over = (Key(op, case, name, direction) for name in (theirs, ours))
        made.append(Target(text, (times,), (over,), at_least=least))
    if cuda:
        text = "a picture to 16,384 Gaussians, bfloat16, ms (an H200; the paper: 50 on an A100)"
        picture = Key("inference", "one picture", "CUDA graph, bfloat16")
        made.append(Target(text, (picture,), at_most=10))
    return made


def _scan(cuda: bool) -> list[Target]:
    key = partial(Key, "scan")
    ours, both = key("operator", "default"), key("operator", "default", BOTH)
    made = [Target("forward + backward over forward", (both,), (ours,), at_most=5)]
    long, short = (partial(key, "length", f"L {length}") for length in (65536, 4096))
    for name, field in (("time", "ms_p50"), ("memory", "peak_bytes")):
        for direction in DIRECTIONS:
            text = f"{direction}, {name} per token at L 65536 over L 4096"
            times, over = (long(direction, field),), (short(direction, field),)
            most = 1.2 if (name, direction) == ("time", BOTH) else 1.1
            made.append(Target(text, times, over, scale=4096 / 65536, at_most=most))
    saved, history = (long(BOTH, field) for field in ("saved_bytes", "state_history_bytes"))
    text = "saved for the backward over the state history"
    made.append(Target(text, (saved,), (history,), at_most=1 / 64))
    if not cuda:
        for direction in DIRECTIONS:
            one, two = (key("threads", name, direction) for name in ("1 thread", "2 threads"))
            made.append(Target(f"{direction}, 1 thread over 2", (one,), (two,), at_least=1.8))
        return made
    layer = partial(key, "training batch")
    ours, both, single = layer("default"), layer("default", BOTH), layer("one sequence")
    return [
        *made,
        Target("forward of a layer, B 16, bfloat16, ms", (ours,), at_most=2.2),
        Target("forward + backward of a layer, B 16, bfloat16, ms", (both,), at_most=6),
        Target("forward of a layer, B 1, bfloat16, ms", (single,), at_most=0.25),
        Target("forward, mamba-ssm's time over ours", (layer("mamba-ssm"),), (ours,), at_least=1.5),
    ]


def _raster(cuda: bool, full: bool) -> list[Target]:
    made, key = [], partial(Key, "raster")
    for scale, bound in ((1, 12), (2, 25), (4, 55)):
        forward, both = (key("scene", f"scale {scale}", d) for d in DIRECTIONS)
        if not cuda:
            made.append(Target(f"forward, scale {scale}, ms", (forward,), at_most=bound))
        text = f"forward + backward over forward, scale {scale}"
        made.append(Target(text, (both,), (forward,), at_most=3.5))
    for direction in DIRECTIONS:
        many, one = (key("one call", name, direction) for name in ("32 calls", "one call"))
        text = f"8 objects x 4 views, {direction}, 32 calls over one"
        made.append(Target(text, (many,), (one,), at_least=1.3))
    for count in (65536, 262144) if full else (65536,):
        for direction in DIRECTIONS:
            few, many = (
                partial(key, "Gaussians", f"{n} Gaussians", direction) for n in (16384, count)
            )
            text = f"{direction}, growth of time over growth of pairs, 16384 to {count} Gaussians"
            times, over = (many(), few("pairs")), (few(), many("pairs"))
            made.append(Target(text, times, over, at_most=1.0))
    if cuda:
        ours, both = (key("32 views", "ours", d) for d in DIRECTIONS)
        peer = key("32 views", "gsplat, 32 views")
        made += [
            Target("forward, µs a view of 512²", (ours,), scale=1e3 / 32, at_most=60),
            Target("forward + backward, µs a view of 512²", (both,), scale=1e3 / 32, at_most=210),
            Target("forward, gsplat's time over ours", (peer,), (ours,), at_least=1.5),
        ]
    return made
