"""What may import what, and that every package is listed for the wheel."""

import ast
import configparser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {
    "kernels": "gamba_warp.kernels",
    "train": "gamba_warp.train",
    "eval": "gamba_warp.eval",
    "gamba_warp": "gamba_warp",
}
# Layer -> what it must not import at all; heavy libraries may be imported inside functions only.
FORBIDDEN = {
    "kernels": (
        "gamba_warp.train",
        "gamba_warp.eval",
        "gamba_warp.model.checkpoint",
        "gamba_warp.gaussians",
    ),
    "gamba_warp": ("gamba_warp.train", "gamba_warp.eval"),
    "train": ("gamba_warp.eval",),
    "eval": ("gamba_warp.train",),
}
KERNELS_MAY = {"torch", "warp", "numpy", "gamba_warp"}
SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def _imports(path: Path):
    """Yields (full module name, whether at module level) for every import in the file."""
    folder = path.relative_to(ROOT).parts[0]
    inside = path.relative_to(ROOT / folder).with_suffix("").parts
    package = [*FOLDERS[folder].split("."), *inside][: -1 if path.name != "__init__.py" else None]
    if path.name == "__init__.py":
        package = package[:-1]
    tree = ast.parse(path.read_text())
    top = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in top
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            name = ".".join(part for part in (base, node.module) if part)
            for alias in node.names:
                yield f"{name}.{alias.name}", id(node) in top


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports(path):
    folder = path.relative_to(ROOT).parts[0]
    for name, top in _imports(path):
        root = name.split(".")[0]
        assert root not in ("kernels", "train", "eval"), f"import gamba_warp.{name} instead"
        assert not any(name == bad or name.startswith(bad + ".") for bad in FORBIDDEN[folder]), (
            f"{folder} must not import {name}"
        )
        if folder == "kernels" and root not in KERNELS_MAY:
            assert root in __import__("sys").stdlib_module_names, f"kernels must not import {name}"
        if root in ("open3d", "pymeshlab"):
            assert not top, f"{name} only inside functions"


def test_imports_are_seen():
    """The walker resolves relative imports: else the test above could not fail."""
    names = [name for name, _ in _imports(ROOT / "gamba_warp" / "render.py")]
    assert "gamba_warp.kernels.rasterize.rasterization" in names


def test_every_package_is_listed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    found = set()
    for folder, package in FOLDERS.items():
        for init in (ROOT / folder).rglob("__init__.py"):
            inside = init.parent.relative_to(ROOT / folder).parts
            found.add(".".join([package, *inside]))
    assert listed == found
