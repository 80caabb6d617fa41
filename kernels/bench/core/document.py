"""The check of a result file, which comes before any use of it."""

from __future__ import annotations

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
_LONGEST = 10_000  # letters of a text; the longest of ours is a message of a compiler
_TIMES = ("ms_p20", "ms_p50", "ms_p80", "jit_ms")


def check_document(document: object) -> dict:
    """Checks that the content of a bench.json holds all that reports need, and returns it.

    Raises:
        ValueError: it is of another format, a number is not finite or out of range, or something
            is missing or of another type; the message names it.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"not a result of 'gamba bench' (format is not {FORMAT})")
    _check("machine", document.get("machine"), _MACHINE)
    peers = document["machine"].get("peers", {})
    if not isinstance(peers, dict) or not all(type(v) is str for v in peers.values()):
        raise ValueError("damaged: machine.peers is no list of versions by name")
    if not isinstance(document.get("interrupted"), bool):
        raise ValueError("damaged: interrupted is missing or is no truth value")
    for name, fields in (("records", _RECORD), ("targets", _TARGET)):
        rows = document.get(name, [] if name == "targets" else None)
        if not isinstance(rows, list):
            raise ValueError(f"damaged: {name} is missing or is no list")
        for i, row in enumerate(rows):
            _check(f"{name}[{i}]", row, fields)
    for i, record in enumerate(document["records"]):
        times = [record[name] for name in _TIMES]
        if record["status"] == "ok" and None in times:
            raise ValueError(f"damaged: records[{i}] has no times, but its status is ok")
        if not all(t is None or t > 0 for t in (*times[:3], record["peer_ms"])):
            raise ValueError(f"damaged: records[{i}] has a time that is not above 0")
        if not all(_is_number(x) for x in record["work"].values()):
            raise ValueError(f"damaged: records[{i}] has what is no number, or none to be drawn")
        if not all(_is_value(x) for x in record["parameters"].values()):
            raise ValueError(f"damaged: records[{i}] has a parameter that is no value")
    return document


def _is_number(value: object) -> bool:
    if type(value) not in _NUMBER or not isinstance(value, (int, float)):
        return False
    return -1e300 < value < 1e300


def _is_value(value: object) -> bool:
    return type(value) in (bool, *_TEXT, *_NONE) or _is_number(value)


def _check(name: str, row: object, fields: dict[str, tuple[type, ...]]) -> None:
    if not isinstance(row, dict):
        raise ValueError(f"damaged: {name} is missing or is no object")
    for key, kinds in fields.items():
        if key not in row:
            raise ValueError(f"damaged: {name} has no {key}")
        value = row[key]
        long = type(value) is str and len(value) > _LONGEST
        if type(value) not in kinds or long or type(value) in _NUMBER and not _is_number(value):
            raise ValueError(f"damaged: {name}.{key} is {str(value)[:40]!r}")
