"""Code blocks of README and pages, and their commands, for the tests."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path
    for folder in ("docs", "kernels", "eval", "train")
    for path in (ROOT / folder).rglob("*.md")
    if "images" not in path.parts
)
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
# A block, and the comment before it that says that it runs: <!-- run -->, or with options that
# make it small, <!-- run: render --views 4; train --steps 2 -->.
_BLOCK = re.compile(
    r"(?:<!-- run(?:: (?P<small>[^>]*?))? (?P<runs>)-->\n)?^```(?P<kind>\w+)\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """Fenced block.

    Attributes:
        path: the page.
        line: of its first line in the page, from 1.
        kind: its language.
        text: its content.
        runs: True if a test runs it.
        small: options to add when it runs, by command.
    """

    path: Path
    line: int
    kind: str
    text: str
    runs: bool
    small: dict[str, list[str]]

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}"


def blocks(kind: str) -> list[Block]:
    """All blocks of one language, page by page."""
    found = []
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for match in _BLOCK.finditer(text):
            if match["kind"] != kind:
                continue
            parts = [shlex.split(part) for part in (match["small"] or "").split(";")]
            small = {part[0]: part[1:] for part in parts if part}
            line = text.count("\n", 0, match.start("text")) + 1
            runs = match["runs"] is not None
            found.append(Block(path, line, kind, match["text"], runs, small))
    return found


def commands(block: Block) -> list[list[str]]:
    """Words of each command of a shell block, without comments, pipes and redirections.

    For a loop, those of the first iteration.
    """
    text = block.text.replace("\\\n", " ")
    for name, first in re.findall(r"^for (\w+) in (\S+)", text, re.MULTILINE):
        text = text.replace(f"${name}", first)
    lines = text.split("\n")
    found = []
    for line in lines:
        for part in re.split(r"&&|;", re.sub(r"(^|\s)#.*", "", line)):
            words = shlex.split(re.sub(r"\s(>|\||2>).*", "", part))
            while words and re.fullmatch(r"\w+=\S*", words[0]):  # OMP_NUM_THREADS=1 gamba …
                words = words[1:]
            if words:
                found.append(words)
    return found
