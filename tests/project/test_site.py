"""The site builds without broken links; tables and scripts that its pages show."""

import os
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from helpers.children import ran
from lab import scanned

from gamba_warp.versions import __version__

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


class Loaded(HTMLParser):
    """Collects what a browser fetches to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "video"):
            self.found.append(values.get("src") or "")
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preconnect", "preload"):
            self.found.append(values.get("href") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocstrings", reason="needs pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder]
    done = ran(*command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_site_builds_strictly_and_has_every_page(site):
    for path in (ROOT / "docs").rglob("*.md"):
        page = path.relative_to(ROOT / "docs").with_suffix(".html")
        assert (site / page).is_file(), page
    for page in ("examples/first-steps.html", "repository/kernels/rasterize.html"):
        assert (site / page).is_file(), page
    code = (site / "code/docs/examples/fit_photograph.py.html").read_text()
    assert "rasterization" in code
    assert not list(site.rglob("*.py")) and not list(site.rglob("*.ipynb"))


def test_every_page_is_in_the_navigation(site):
    start = (site / "index.html").read_text()
    for path in (ROOT / "docs").glob("*.md"):
        assert f'href="{path.stem}.html"' in start or path.stem == "index", path.name


def test_a_page_loads_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        reader = Loaded()
        reader.feed(page.read_text(encoding="utf-8"))
        outside = [name for name in reader.found if re.match(r"(https?:)?//", name)]
        assert not outside, f"{page}: {outside}"


def test_the_citation_is_that_of_the_paper():
    assert CITATION["cff-version"] == "1.2.0" and CITATION["version"] == __version__
    assert {"title", "message", "authors", "license"} <= set(CITATION)
    paper = CITATION["preferred-citation"]
    names = [f"{a['family-names']}, {a['given-names']}" for a in paper["authors"]]
    bibtex = re.search(r"```bibtex\n(.*?)```", README, re.DOTALL)[1]
    flat = " ".join(bibtex.split())
    assert " and ".join(names) in flat and paper["title"] in flat
    assert f"{{{paper['year']}}}" in flat and "2403.18795" in flat


def row(name, psnr, views="novel"):
    means = {"psnr": psnr, "ssim": 0.8, "mask_iou": 0.5}
    cells = {key: {"mean": value} for key, value in means.items()}
    return {"views": views, "name": name, "lpips": None, **cells}


VIEWS = {
    "protocol": {"source": {"path": "m.safetensors", "sha256": "0123456789abcdef77"}},
    "num_ok": 2,
    "table": [row("model", 20.5), row("retrieval", 99.0), row("billboard", 17.0)]
    + [row("model", 38.0, "input")],
}
SHAPES = {"mean": {"chamfer": 0.04321, "normal_consistency": 0.7, "iou": 0.5}}


def cells(table):
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()]


def test_the_means_are_of_new_views_and_the_shapes_stand_with_the_model():
    head, _, *rows = cells(scanned.figures(VIEWS, SHAPES).partition("\n\n")[0])
    assert head[0] == "2 objects" and head[-3:] == ["Chamfer", "normals", "Volume IoU"]
    assert rows == [
        ["**this project**", "20.50", "0.800", "–", "0.500", "0.0432", "0.700", "0.500"],
        ["billboard", "17.00", "0.800", "–", "0.500", "–", "–", "–"],
    ]
    assert scanned.figures(VIEWS, SHAPES).endswith("`m.safetensors`, SHA-256 0123456789abcdef.")


SCRIPT = ROOT / "docs" / "examples" / "slurm.sh"
ARRAY = SCRIPT.with_name("slurm_array.sh")
PAGE = (ROOT / "docs" / "train-your-own.md").read_text(encoding="utf-8")


def slurm(folder, *arguments, script=SCRIPT, **more):
    """Run a script with stand-ins for scontrol and srun that print their arguments."""
    for name, text in (("scontrol", "printf 'node7\\nnode8\\n'"), ("srun", 'printf "%s\\n" "$@"')):
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    place = {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_JOB_ID": "41234"}
    place |= {"SLURM_JOB_NODELIST": "node[7-8]", "SLURM_NNODES": "2", **more}
    return ran("bash", script, *arguments, env=place, timeout=60)


def test_the_slurm_script_starts_torchrun_on_each_machine(tmp_path):
    done = slurm(tmp_path, "my data", "my run", "--lr", "0.002")
    assert done.returncode == 0, done.stderr
    words = done.stdout.splitlines()
    assert words[:2] == ["--kill-on-bad-exit=1", "torchrun"] and words[-2:] == ["--lr", "0.002"]
    own = words[words.index("gamba_warp.train") + 1 :]
    assert own[:3] == ["my data", "--out", "my run"]
    for name, value in (("--nnodes", "2"), ("--rdzv-endpoint", "node7:21234")):
        assert words[words.index(name) + 1] == value
    # The page's own command has the same options.
    shown = re.search(r"torchrun --nnodes 2.*?```", PAGE, re.DOTALL)
    assert shown
    for word in own[3:-2]:
        assert word in shown[0].split(), word
    missing = slurm(tmp_path, "my data")
    assert missing.returncode == 2 and missing.stderr.startswith("usage:")


def test_the_tasks_of_an_array_take_their_parts(tmp_path):
    task = {"script": ARRAY, "SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "16"}
    done = slurm(tmp_path, "data", "render", "my meshes", "--out", "DATA", **task)
    wanted = ["gamba", "data", "render", "my meshes", "--out", "DATA", "--shard", "3/16"]
    assert done.stdout.splitlines() == wanted, done.stderr
    task |= {"SLURM_ARRAY_TASK_COUNT": "1", "PARTS": "8"}  # one task again, of eight
    done = slurm(tmp_path, "data", "render", "MESHES", "--out", "DATA", **task)
    assert done.stdout.split()[1:] == "data render MESHES --out DATA --shard 3/8".split()
    assert slurm(tmp_path, "data", **task).returncode == 2
