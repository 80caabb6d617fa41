"""The wheel holds all that a first picture needs, and nothing in it looks for a checkout."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("gamba_warp", "kernels", "train", "eval", "starter")
FILES = ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "THIRD_PARTY.md")
# Where everything of ours comes from, and then the command itself.
RUN = """
import sys
import gamba_warp
from gamba_warp.files import STARTER
from gamba_warp import cli
print(gamba_warp.__file__, STARTER, flush=True)
cli.main(sys.argv[1:])
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


@pytest.mark.slow
def test_an_installed_wheel_reconstructs_its_own_picture(wheel, tmp_path):
    site = tmp_path / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*command, "--target", str(site), str(wheel)], check=True, timeout=300)
    picture = site / "gamba_warp" / "starter" / "icons" / "scopia-toaster.png"
    environment = os.environ | {"PYTHONPATH": str(site)}

    def gamba(*arguments):
        return subprocess.run(
            [sys.executable, "-c", RUN, *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=300,
        )

    quick = ("--size", 32, "--frames", 3, "--out", tmp_path / "out")
    done = gamba("reconstruct", picture, *quick)
    assert done.returncode == 0, done.stderr
    places = done.stdout.splitlines()[0].split()
    assert all(Path(place).is_relative_to(site) for place in places)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {f"scopia-toaster.{end}" for end in ("ply", "gif", "html")}
    none = gamba("reconstruct")
    assert none.returncode == 2 and f"such as {site}" in none.stderr
    demo = gamba("demo")
    assert demo.returncode == 2 and demo.stderr.count("\n") == 1
    assert f"{site}/gamba_warp/starter/data: no such folder; make" in demo.stderr


@pytest.mark.slow
def test_the_wheel_holds_the_model_its_card_two_pictures_and_whose_they_are(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        card = json.loads(archive.read("gamba_warp/starter/rays.json"))
        text = archive.read("gamba_warp/starter/ATTRIBUTION.md").decode()
    own = {name.removeprefix("gamba_warp/starter/") for name in names if "/starter/" in name}
    icons = {name for name in own if name.startswith("icons/")}
    assert own - icons == {"ATTRIBUTION.md", "rays.json", "rays.safetensors"}
    assert card["steps"] > 0 and len(icons) == 2
    assert all(f"`{Path(icon).stem}`" in text for icon in icons)
    assert wheel.stat().st_size < 12e6
    assert not any("tests" in name.split("/") for name in names)
