"""Conversion of links between files of the repository to links of the site.

The pages are also read in the repository, so a link is relative to its file:
``../kernels/ssim/README.md``, ``examples/fit_photograph.py``. On the site each linked file is a
page: those of docs/ at their path, other Markdown under ``repository/``, code under ``code/``.
"""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Callable
from pathlib import Path

# A link or image in Markdown whose target is no address of the web and no place in the same page.
LINK = re.compile(r"(!?\[[^\[\]]*(?:\[[^\[\]]*\][^\[\]]*)*\]\()(?!https?:|mailto:|#)([^()\s]+)(\))")
FENCE = re.compile(r"^( *)(```+).*?^\1\2 *$", re.MULTILINE | re.DOTALL)


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """Change the parts of a Markdown text outside fenced blocks.

    Args:
        text: Markdown.
        change: maps one part to its new text.

    Returns:
        The text with unchanged fenced blocks.
    """
    parts, end = [], 0
    for block in FENCE.finditer(text):
        parts += [change(text[end : block.start()]), block[0]]
        end = block.end()
    return "".join([*parts, change(text[end:])])


def targets(text: str, path: str) -> list[str]:
    """Files linked by a Markdown file, relative to the repository.

    Args:
        text: Markdown.
        path: the file that holds it, relative to the repository, with ``/``.
    """
    found: list[str] = []

    def note(part: str) -> str:
        for link in LINK.finditer(part):
            found.append(_resolve(link[2].partition("#")[0], path))
        return part

    outside_code(text, note)
    return found


def page_of(path: str) -> str:
    """Return the source path on the site of a file of the repository.

    Args:
        path: relative to the repository.

    Returns:
        A path relative to docs/: README.md is the first page, files in docs/ keep their path, other
        Markdown is under ``repository/``, and all other files under ``code/``.
    """
    if path == "README.md":
        return "index.md"
    inside = path.removeprefix("docs/")
    if path.endswith(".ipynb"):
        return str(Path(inside).with_suffix(".md"))
    if inside != path and not is_code(path):
        return inside
    if path.endswith("/README.md"):  # a page of its own, not the index of a section
        path = path.removesuffix("/README.md") + ".md"
    return f"code/{path}.md" if is_code(path) else f"repository/{path}"


def is_code(path: str) -> bool:
    """True if a file is shown as a page with its text: programs, settings, build files."""
    return Path(path).suffix in (".py", ".sh", ".cfg", ".toml", ".cff", "")


def rewritten(text: str, path: str, page: str) -> str:
    """Rewrite the links of a Markdown text for the site.

    Args:
        text: Markdown.
        path: the file that holds it, relative to the repository.
        page: its path on the site (``page_of``).
    """

    def one(link: re.Match) -> str:
        name, mark, anchor = link[2].partition("#")
        target = page_of(_resolve(name, path))
        return (
            f"{link[1]}{posixpath.relpath(target, posixpath.dirname(page))}{mark}{anchor}{link[3]}"
        )

    return outside_code(text, lambda part: LINK.sub(one, part))


def _resolve(name: str, path: str) -> str:
    return os.path.normpath(posixpath.join(posixpath.dirname(path), name))
