"""Check that docstrings open with a noun or verb phrase; ``make lint`` runs it.

A docstring that opens with a question word or a pronoun describes its subject by a clause, where
"Return the …", "True if …" or "Number of …" is shorter.
"""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("gamba_warp", "eval", "train", "kernels", "tests", "docs")
_OPENING = re.compile(r"(?:What|Whether|How|That|Who|Those|It|Where|Which|Why)\b")
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def findings(name: str, text: str) -> list[str]:
    """Return the docstrings of a module that open with one of the words."""
    found = []
    for node in ast.walk(ast.parse(text)):
        first = node.body[0] if isinstance(node, _DOCUMENTED) and node.body else None
        opening = first and _OPENING.match(ast.get_docstring(node) or "")
        if opening:
            found.append((first.lineno, f"the docstring opens with {opening[0]}"))
    return [f"{name}:{line}: {fault}" for line, fault in sorted(found)]


if __name__ == "__main__":
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    faults = [x for path in files for x in findings(str(path.relative_to(ROOT)), path.read_text())]
    sys.exit("\n".join(faults) or None)
