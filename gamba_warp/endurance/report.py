"""The report of an endurance run, as a table in Markdown."""

from __future__ import annotations

_COLUMNS = {
    "runs": "tried",
    "hit": "hit",
    "lost": "older files lost",
    "not_resumed": "did not go on",
    "untold": "not one line",
    "left": "left over",
    "debris": "debris",
}
_EXPLAINED = (
    "Hit: the fault came before the command had ended. Left over: unfinished files right after "
    "the faults, under names that no command reads. Debris: those still there after the next run "
    "of the command, two days later (of training: at once)."
)


def page(result: dict) -> str:
    """The table, a line for each command and fault, and what went wrong."""
    lines = ["| command | fault | " + " | ".join(_COLUMNS.values()) + " |"]
    lines.append("| --- | --- |" + " ---: |" * len(_COLUMNS))
    for count in result["counts"]:
        cells = " | ".join(str(count[name]) for name in _COLUMNS)
        lines.append(f"| {count['command']} | {count['fault']} | {cells} |")
    lines += ["", _EXPLAINED, ""]
    lines += [f"- {note}" for count in result["counts"] for note in count["notes"]]
    return "\n".join(lines).rstrip() + "\n"
