"""The image of the Dockerfile: built where Docker runs, else its steps in a fresh folder."""

import fnmatch
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.children import ran

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
STEPS = [line.split(maxsplit=1) for line in TEXT.split("\n") if line and line[0] != "#"]
IMAGE = ROOT / "starter" / "icons" / "scopia-toaster.png"
SMALL = ("--size", "16", "--frames", "2", "--out")


def sent(folder: Path) -> Path:
    """The build context: what ``.dockerignore`` lets pass of the files that git does not ignore."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").split("\n")
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules[0] == "*"
    kept = [rule[1:] for rule in rules if rule.startswith("!")]
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    for name in listed.stdout.decode().split("\0")[:-1]:
        if any(fnmatch.fnmatch(name, rule) or name.startswith(f"{rule}/") for rule in kept):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    return folder


def daemon() -> bool:
    docker = shutil.which("docker")
    return bool(docker) and not subprocess.run([docker, "info"], capture_output=True).returncode


def test_two_stages_and_no_root():
    kinds = [kind for kind, _ in STEPS]
    assert kinds.count("FROM") == 2 and kinds[-2:] == ["ENTRYPOINT", "CMD"]
    last = len(kinds) - kinds[::-1].index("FROM")
    after = dict(STEPS[last:])
    assert after["USER"] not in ("root", "0") and "--from=build" in after["COPY"]
    assert "pip" not in "".join(text for kind, text in STEPS[last:] if kind == "RUN")


@pytest.mark.slow
def test_the_steps_make_a_program_that_reconstructs(tmp_path):
    """Without Docker the libraries are those that are here; the package is built of the context."""
    if daemon():
        pytest.skip("the image is built instead")
    place, source = tmp_path / "opt", sent(tmp_path / "source")
    for kind, text in STEPS:
        if kind != "RUN" or "/opt/gamba" not in text or "--index-url" in text:
            continue  # useradd, apt-get; torch is here
        text = re.sub(r"\bpython\b(?= -m venv)", shlex.quote(sys.executable), text)
        text = text.replace("/opt/gamba", str(place))
        # The libraries that the extras name are looked up here, and not fetched.
        text = text.replace("pip install", "pip install --quiet --no-deps")
        subprocess.run(["sh", "-ec", text], cwd=source, check=True, timeout=300)
    shutil.rmtree(source)
    (site,) = place.glob("lib/python*/site-packages")
    here = Path(pytest.__file__).parents[1]
    (site / "here.pth").write_text(f"{here}\n")
    out = tmp_path / "out"
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = ("reconstruct", IMAGE, *SMALL, out)
    done = ran(place / "bin" / "gamba", *words, cwd=tmp_path, env=alone)
    assert done.returncode == 0, done.stderr
    assert (out / "scopia-toaster.ply").exists()
    code = "import gamba_warp; print(gamba_warp.__file__)"
    where = ran(place / "bin" / "python", "-c", code, cwd=tmp_path, env=alone)
    assert where.stdout.startswith(str(place))


@pytest.mark.slow
def test_the_image_is_built_and_reconstructs(tmp_path):
    if not daemon():
        pytest.skip("no Docker runs here")
    subprocess.run(["docker", "build", "--tag", "gamba-test", ROOT], check=True, timeout=1800)
    shutil.copy(IMAGE, tmp_path / "photo.png")
    tmp_path.chmod(0o777)
    mount = ["docker", "run", "--rm", "-v", f"{tmp_path}:/work", "gamba-test"]
    subprocess.run([*mount, "reconstruct", "photo.png", *SMALL, "out"], check=True, timeout=600)
    assert (tmp_path / "out" / "photo.ply").exists()
