"""Untrusted files are only opened by the modules that validate them."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Allowed callers; ``vision.weights`` opens an archive after its digest.
DOORS = {
    "Image.open": {"gamba_warp/images.py"},
    "tarfile.open": {"gamba_warp/vision/weights.py"},
    "zipfile.ZipFile": {
        "gamba_warp/untrusted/archives.py",
        "gamba_warp/untrusted/torch_files.py",
        "gamba_warp/app/work.py",  # which writes one
    },
    "np.load": set(),
    "pickle.load": set(),
    "pickle.loads": {"gamba_warp/untrusted/children.py"},
    "json.load": set(),
    # files just written by the same process or its parent, and options
    "json.loads": {"gamba_warp/model/checkpoint.py", "train/config.py"},
    "msgspec.json.decode": {"gamba_warp/untrusted/documents.py", "eval/presets.py"},
}


def calls(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield ast.unparse(node.func), node.lineno


@pytest.fixture(scope="module")
def found():
    """Lines of each call, by the called function."""
    lines = {name: set() for name in DOORS}
    for folder in ("gamba_warp", "train", "eval", "kernels"):
        for path in (ROOT / folder).rglob("*.py"):
            place = path.relative_to(ROOT).as_posix()
            for name, line in calls(path):
                if name in lines:
                    lines[name].add((place, line))
    return lines


@pytest.mark.parametrize("name", DOORS)
def test_a_library_is_called_at_its_door_only(found, name):
    elsewhere = {(place, line) for place, line in found[name] if place not in DOORS[name]}
    assert not elsewhere, f"{name}: see docs/security.md"
    if name == "Image.open":
        assert found[name], "the search itself must find something"
