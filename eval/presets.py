"""Protocols of the field: small files of fields, each with its source and what that leaves open."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill, indent
from typing import Any

import msgspec


class Preset(msgspec.Struct, forbid_unknown_fields=True):
    """A protocol as its file has it.

    Attributes:
        source: whose it is, and where it is written.
        stated: what the source states, by field, or by a subject that is no field.
        open: what the source leaves open, likewise, and what was chosen.
        shapes: fields of ``GeometryProtocol`` that differ from "default"; None: it has no shapes.
        views: options of ``eval-views`` that differ from the default; None: it has no views.
    """

    source: str
    stated: dict[str, str] = {}
    open: dict[str, str] = {}
    shapes: dict[str, Any] | None = None
    views: dict[str, Any] | None = None


PRESETS = {
    path.stem: msgspec.json.decode(path.read_bytes(), type=Preset)
    for path in sorted((Path(__file__).parent / "protocols").glob("*.json"))
}


def explain(name: str, fields: dict[str, Any]) -> str:
    """A protocol in words: each field with what its source states of it or leaves open.

    Args:
        name: of ``PRESETS``, or another one, which has no source.
        fields: the values, by field.
    """
    preset = PRESETS.get(name, Preset("the fields below are all there is"))
    values = {field: msgspec.json.encode(value).decode() for field, value in fields.items()}
    lines = [f"{name}: {preset.source}"]
    for subject in dict.fromkeys((*values, *preset.stated, *preset.open)):
        lines.append(f"{subject:<24} {values.get(subject, '')}".rstrip())
        for kind, words in (("stated", preset.stated), ("open", preset.open)):
            if subject in words:
                lines.append(indent(fill(f"{kind}: {words[subject]}", 72), " " * 25))
    return "\n".join(lines)
