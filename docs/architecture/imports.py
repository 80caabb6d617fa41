"""Imports of every module of the repository, read without running it."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

# Folder of the checkout -> installed package (setup.cfg, package_dir).
FOLDERS = {
    "gamba_warp": "gamba_warp",
    "kernels": "gamba_warp.kernels",
    "train": "gamba_warp.train",
    "eval": "gamba_warp.eval",
}
_DOTTED = re.compile(r"\.{0,2}[A-Za-z_]\w*(\.[A-Za-z_]\w*)*\.?$")


@dataclass(frozen=True)
class Import:
    """One import statement, or one string that names a module of the project.

    Attributes:
        source: the importing module.
        name: full name: ``torch.nn.functional``, ``gamba_warp.files.atomic_path``.
        target: the module of the project that has ``name``, or None for a library.
        line: line of the file, from 1.
        lazy: True inside a function, under TYPE_CHECKING, or for a string.
        text: True for a string (``"module:function"``, ``import_module("module")``).
    """

    source: str
    name: str
    target: str | None
    line: int
    lazy: bool
    text: bool = False


def modules(root: Path) -> dict[str, Path]:
    """Map the full name of every module of the checkout at ``root`` to its file."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((root / folder).rglob("*.py")):
            inside = path.relative_to(root / folder).with_suffix("").parts
            if inside[-1] == "__init__":
                inside = inside[:-1]
            found[".".join((package, *inside))] = path
    return found


def read_imports(root: Path) -> list[Import]:
    """Return all imports of all modules of the checkout at ``root``."""
    files = modules(root)
    return [entry for module in files for entry in _Reader(module, files).read()]


class _Reader(ast.NodeVisitor):
    """Collects the imports of one module; ``files`` has all modules of the checkout."""

    def __init__(self, module: str, files: dict[str, Path]):
        self.module, self.files = module, files
        is_package = files[module].name == "__init__.py"
        self.package = module if is_package else module.rpartition(".")[0]
        self.depth = 0
        self.found: list[Import] = []

    def read(self) -> list[Import]:
        self.visit(ast.parse(self.files[self.module].read_text()))
        return self.found

    def _add(self, name: str, node: ast.AST, text: bool = False) -> None:
        target = name
        while target and target not in self.files:
            target = target.rpartition(".")[0]
        lazy = text or self.depth > 0
        line = getattr(node, "lineno", 0)
        self.found.append(Import(self.module, name, target or None, line, lazy, text))

    def _absolute(self, name: str, level: int) -> str:
        if level == 0:
            return name
        base = self.package.split(".")
        return ".".join([*base[: len(base) - level + 1], *filter(None, [name])])

    def visit_Import(self, node: ast.Import) -> None:  # noqa: N802 (a name of ast.NodeVisitor)
        for alias in node.names:
            self._add(alias.name, node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:  # noqa: N802
        base = self._absolute(node.module or "", node.level)
        for alias in node.names:
            self._add(f"{base}.{alias.name}", node)

    def visit_Constant(self, node: ast.Constant) -> None:  # noqa: N802
        if isinstance(node.value, str):
            self._text(node.value, node)

    def _text(self, value: str, node: ast.AST) -> None:
        """Record a dotted string that names a module of the project as an import."""
        name = value.partition(":")[0]
        if "." not in name or not _DOTTED.match(name):
            return
        level = len(name) - len(name.lstrip("."))
        full = self._absolute(name.strip("."), level)
        if level == 0 and full.startswith("gamba_warp."):  # may end in a function's name
            if full in self.files or full.rpartition(".")[0] in self.files:
                self._add(full, node, text=True)
            return
        if level == 0:  # "model.gamba", as a table of lazy names may have it
            full = f"{self.package}.{full}"
        if full in self.files:
            self._add(full, node, text=True)

    def visit_Expr(self, node: ast.Expr) -> None:  # noqa: N802
        if not isinstance(node.value, ast.Constant):  # a docstring is not code
            self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:  # noqa: N802
        checking = "TYPE_CHECKING" in ast.unparse(node.test)
        self.depth += checking
        for child in node.body:
            self.visit(child)
        self.depth -= checking
        self.visit(node.test)
        for child in node.orelse:
            self.visit(child)

    def _inside(self, node: ast.AST) -> None:
        self.depth += 1
        self.generic_visit(node)
        self.depth -= 1

    visit_FunctionDef = visit_AsyncFunctionDef = visit_Lambda = _inside
