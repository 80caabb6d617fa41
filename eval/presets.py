"""Published protocols: JSON files of fields, with their sources and open points."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill, indent
from typing import Any

import msgspec


class Preset(msgspec.Struct, forbid_unknown_fields=True):
    """A protocol file.

    Attributes:
        source: authors and publication.
        stated: statements of the source, by field or another subject.
        open: points that the source leaves open, likewise, and our choices.
        shapes: fields of ``GeometryProtocol`` that differ from "default"; None without shapes.
        views: options of ``eval-views`` that differ from the default; None without views.
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
    """Describe a protocol: each field with the statements and open points of its source.

    Args:
        name: of ``PRESETS``, or any other, which has no source.
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
