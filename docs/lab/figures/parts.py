"""Generated parts of a page, each between two marks."""

from __future__ import annotations

from collections.abc import Mapping

_MARK = "<!-- {name}: written by {writer} -->"


def marks(writer: str, name: str) -> tuple[str, str]:
    """Lines before and after a part.

    Args:
        writer: the command that writes the part.
        name: name of the part.
    """
    begin, end = (_MARK.format(name=text, writer=writer) for text in (name, f"end of {name}"))
    return begin, end


def with_parts(text: str, writer: str, parts: Mapping[str, str]) -> str:
    """Replace the parts of a page; everything else is unchanged.

    Args:
        text: of the page, with the marks of every part.
        writer: as for ``marks``.
        parts: text of each part by its name.

    Raises:
        ValueError: the page lacks a mark.
    """
    for name, part in parts.items():
        begin, end = marks(writer, name)
        head, found, rest = text.partition(begin)
        tail = rest.partition(end)
        if not found or not tail[1]:
            raise ValueError(f"missing marker {begin if not found else end}")
        text = f"{head}{begin}\n\n{part}\n\n{end}{tail[2]}"
    return text
