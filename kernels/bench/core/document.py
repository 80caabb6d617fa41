"""The check of a result file, which comes before any use of it."""

from __future__ import annotations

import json

from .measure import FORMAT

_TEXT, _NUMBER, _MAP, _NONE = (str,), (int, float), (dict,), (type(None),)
_RECORD = {
    **dict.fromkeys(("op", "case", "variant", "device", "dtype", "direction", "status"), _TEXT),
    **dict.fromkeys(("oracle", "text"), _TEXT),
    **dict.fromkeys(("ms_p20", "ms_p50", "ms_p80", "jit_ms"), _NUMBER + _NONE),
    **dict.fromkeys(("rel_rms_error", "max_error", "peer_ms"), _NUMBER + _NONE),
    **dict.fromkeys(("peer", "axis"), _TEXT + _NONE),
    **dict.fromkeys(("work", "parameters"), _MAP),
    **dict.fromkeys(("is_peer", "is_default"), (bool,)),
}
_TARGET = {
    **dict.fromkeys(("op", "text", "wanted"), _TEXT),
    "value": _NUMBER + _NONE,
    "reached": (bool, *_NONE),
}
_MACHINE = {
    **dict.fromkeys(("cpu", "simd", "system", "python", "torch", "warp", "gamba_warp"), _TEXT),
    **dict.fromkeys(("gpu", "cuda"), _TEXT + _NONE),
    **dict.fromkeys(("cores", "threads"), (int,)),
    "date": _TEXT,
}
_TIMES = ("ms_p20", "ms_p50", "ms_p80", "jit_ms")


def parse_document(text: str) -> dict:
    """Reads the text of a bench.json and checks that it holds all that reports need.

    Raises:
        ValueError: the text is not JSON or of another format, a number is not finite, or something
            is missing or of another type; the message names it.
    """
    try:
        document = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"not a result of 'gamba bench' (format is not {FORMAT})")
    _check("machine", document.get("machine"), _MACHINE)
    if not isinstance(document.get("interrupted"), bool):
        raise ValueError("damaged: interrupted is missing or is no truth value")
    for name, fields in (("records", _RECORD), ("targets", _TARGET)):
        rows = document.get(name, [] if name == "targets" else None)
        if not isinstance(rows, list):
            raise ValueError(f"damaged: {name} is missing or is no list")
        for i, row in enumerate(rows):
            _check(f"{name}[{i}]", row, fields)
    for i, record in enumerate(document["records"]):
        if record["status"] == "ok" and None in [record[name] for name in _TIMES]:
            raise ValueError(f"damaged: records[{i}] has no times, but its status is ok")
        numbers = [*record["work"].values(), record["ms_p50"] or 0, record["peer_ms"] or 0]
        if not all(type(x) in _NUMBER and -1e300 < x < 1e300 for x in numbers):
            raise ValueError(f"damaged: records[{i}] has what is no number, or none to be drawn")
    return document


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _check(name: str, row: object, fields: dict[str, tuple[type, ...]]) -> None:
    if not isinstance(row, dict):
        raise ValueError(f"damaged: {name} is missing or is no object")
    for key, kinds in fields.items():
        if key not in row:
            raise ValueError(f"damaged: {name} has no {key}")
        if type(row[key]) not in kinds:
            raise ValueError(f"damaged: {name}.{key} is {str(row[key])[:40]!r}")
