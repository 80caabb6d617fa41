"""The wheel has everything for a first image, and needs no checkout."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import PathDistribution, distribution
from pathlib import Path

import pytest
from helpers.children import ran
from helpers.forked import python
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("gamba_warp", "kernels", "train", "eval", "starter")
FILES = ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "THIRD_PARTY.md")
# Where everything of ours comes from.
WHERE = """
import gamba_warp
from gamba_warp.files import STARTER
from gamba_warp import cli
print(gamba_warp.__file__, STARTER)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, so that nothing is left in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for part in PARTS:
        shutil.copytree(ROOT / part, folder / "copy" / part)
    for name in FILES:
        shutil.copy(ROOT / name, folder / "copy" / name)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
    subprocess.run([*command, str(folder), str(folder / "copy")], check=True, timeout=300)
    shutil.rmtree(folder / "copy")
    (found,) = folder.glob("*.whl")
    return found


def add(requirement: Requirement, found: dict) -> None:
    """Adds what a requirement means here, and all that this requires, by name and extras."""
    name = canonicalize_name(requirement.name), *sorted(requirement.extras)
    if name in found:
        return
    found[name] = one = distribution(requirement.name)
    for line in map(Requirement, one.requires or []):
        extras = "", *requirement.extras
        if line.marker is None or any(line.marker.evaluate({"extra": e}) for e in extras):
            add(line, found)


@pytest.fixture(scope="module")
def fresh(wheel, tmp_path_factory):
    """An environment of its own: the wheel, and of what is here only what the wheel requires."""
    folder = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    subprocess.run([*command, "--no-deps", "--no-index", str(wheel)], check=True, timeout=300)
    (site,) = folder.glob("lib/python*/site-packages")
    (metadata,) = site.glob("gamba_warp-*.dist-info")
    found: dict = {}
    for requirement in map(Requirement, PathDistribution(metadata).requires or []):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            add(requirement, found)
    for one in found.values():
        for top in {file.parts[0] for file in one.files or []} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(one.locate_file(top))).resolve())
    return folder, site


@pytest.mark.slow
def test_an_installed_wheel_reconstructs_its_own_image(fresh, tmp_path):
    folder, site = fresh
    image = site / "gamba_warp" / "starter" / "icons" / "scopia-toaster.png"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}

    def run(*words):
        return ran(folder / "bin" / words[0], *words[1:], cwd=tmp_path, env=environment)

    names = ("trimesh", "kornia", "open3d", "timm", "scipy", "skimage", "pytest")
    look = f"from importlib.util import find_spec; print([n for n in {names} if find_spec(n)])"
    assert run("python", "-c", look).stdout == "[]\n"
    where = run("python", "-c", WHERE)
    assert where.returncode == 0, where.stderr
    assert all(Path(place).is_relative_to(site) for place in where.stdout.split())
    quick = ("--size", 32, "--frames", 3, "--out", tmp_path / "out")
    done = run("gamba", "reconstruct", image, *quick, "--sheet", tmp_path / "sheet.png")
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {f"scopia-toaster.{end}" for end in ("ply", "gif", "html")}
    assert (tmp_path / "sheet.png").exists()
    none = run("gamba", "reconstruct")
    assert none.returncode == 2 and f"such as {site}" in none.stderr
    mesh = run("gamba", "reconstruct", image, "--mesh", "obj", *quick)
    assert mesh.returncode == 2 and "pip install '.[" in mesh.stderr, mesh.stderr
    demo = run("gamba", "demo")
    assert demo.returncode == 2 and demo.stderr.count("\n") == 1
    assert "'FILE.whl[all]'" in demo.stderr


@pytest.mark.slow
def test_the_demo_of_an_installed_wheel_asks_for_a_checkout(fresh, tmp_path):
    _, site = fresh  # and all extras, which are where this test runs
    code, environment = "from gamba_warp import cli; cli.main(['demo'])", dict(os.environ)
    environment["PYTHONPATH"] = str(site)
    demo = ran(python(), "-c", code, cwd=tmp_path, env=environment)
    assert demo.returncode == 2 and demo.stderr.count("\n") == 1
    assert f"{site}/gamba_warp/starter/data: no such folder; make" in demo.stderr


@pytest.mark.slow
def test_the_wheel_holds_the_model_its_card_two_images_and_whose_they_are(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        card = json.loads(archive.read("gamba_warp/starter/rays.json"))
        text = archive.read("gamba_warp/starter/ATTRIBUTION.md").decode()
    own = {name.removeprefix("gamba_warp/starter/") for name in names if "/starter/" in name}
    icons = {name for name in own if name.startswith("icons/")}
    assert own - icons == {"ATTRIBUTION.md", "rays.json", "rays.safetensors"}
    assert card["steps"] > 0 and len(icons) == 2
    assert all(f"`{Path(icon).stem}`" in text for icon in icons)
    for part in ("gamba_warp", "kernels", "train", "eval"):
        files = [x.relative_to(ROOT) for x in (ROOT / part).rglob("*") if x.is_file()]
        top = Path() if part == "gamba_warp" else Path("gamba_warp")
        inside = {str(top / path) for path in files if path.suffix in (".py", ".h", ".cuh")}
        assert inside <= names, inside - names
    assert "gamba_warp/py.typed" in names
    assert wheel.stat().st_size < 12e6
    assert not any("tests" in name.split("/") for name in names)
