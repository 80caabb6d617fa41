"""Commands in README and pages parse, and the short ones run."""

import contextlib
import functools
import io
import json
import os
import re
import shlex
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch
import trimesh
from helpers.gaussians import some
from helpers.images import cut_out
from website.blocks import PAGES, ROOT, Block, blocks, commands

from gamba_warp import cli
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.images import load_rgba

README = ROOT / "README.md"
MAKEFILE = (ROOT / "Makefile").read_text()
# Programs of others, and words of the shell, that stand in blocks.
OTHERS = {"cat", *"git cd docker source pip for do done sbatch export apt-get ulimit".split()}
OTHERS.add("docs/lab/gpu_train.sh")
SHELL = blocks("bash")
PYTHON = blocks("python")
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
# `gamba … ` in the middle of a sentence; a name in capitals or an ellipsis stands for something.
INLINE = re.compile(r"`(gamba [a-z][^`]*)`")


@pytest.fixture
def parsed(monkeypatch):
    """Parses the words behind ``gamba`` as the command does, and runs nothing."""
    real = cli.load_command

    @functools.cache
    def load(name):
        command = real(name)
        return functools.wraps(command)(lambda *args, **kwargs: 0)

    monkeypatch.setattr(cli, "load_command", load)

    def parse(words, where, capsys):
        try:
            code = cli._main(words)
        except SystemExit as end:
            code = end.code
        said = capsys.readouterr()
        assert code in (0, None), f"{where}: gamba {shlex.join(words)}\n{said.out}{said.err}"

    return parse


def own(words: list[str]) -> list[str] | None:
    """Return the words after ``gamba``, in any form; None for another program."""
    if words[0] == "gamba":
        return words[1:]
    if "gamba_warp.train" in words:
        return ["train", *words[words.index("gamba_warp.train") + 1 :]]
    return None


def test_the_reader_of_blocks_sees_them():
    assert len(SHELL) > 25 and len(PYTHON) > 5 and README in PAGES
    assert sum(block.runs for block in SHELL) >= 5 and sum(block.runs for block in PYTHON) >= 2
    (block,) = [b for b in SHELL if b.path.name == "train-your-own.md" and "nnodes 2" in b.text]
    assert own(commands(block)[0])[:4] == ["train", "DATA", "--out", "RUN"]


@pytest.mark.parametrize("block", SHELL, ids=str)
def test_commands_are_understood(block, parsed, capsys):
    for words in commands(block):
        mine = own(words)
        if mine is not None and "…" in mine:  # other options stand there: only names are known
            assert_known(mine, block)
        elif mine is not None:
            parsed(mine, block, capsys)
        elif words[0] == "make":
            targets = [word for word in words[1:] if "=" not in word]
            for target in targets:
                assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), f"{block}: make {target}"
        elif words[0] == "python":
            found = find_spec(words[2]) if words[1] == "-m" else (ROOT / words[1]).is_file()
            assert found, f"{block}: {words}"
        else:
            assert words[0] in OTHERS, f"{block}: {words}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_in_sentences_are_understood(path, parsed, capsys):
    """Commands with options; a bare name needs no arguments in a sentence."""
    for text in INLINE.findall(path.read_text(encoding="utf-8")):
        words = text.replace("\n", " ").split()[1:]
        known = any(" ".join(words[:n]) in cli.COMMANDS for n in (1, 2))
        assert known or "data" in words[0] or words[0] in ("COMMAND", "help"), f"{path}: {text}"
        assert_known(words, path)


def assert_known(words: list[str], where: object) -> None:
    """Every option among the words is in the command's help."""
    for word in words:
        name = word.split("=")[0].rstrip(".,;:")
        if re.fullmatch(r"--[a-z][a-z-]+", name):
            known = options(" ".join(words[:2]), words[0])
            assert re.search(rf"{name}\b", known), f"{where}: gamba {' '.join(words)}"


@functools.cache
def options(*names: str) -> str:
    """The help of the first of some names that is a command's."""
    name = next(name for name in names if name in cli.COMMANDS)
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        cli._main([*name.split(), "--help"])
    return out.getvalue() + "--help --version"


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """Folder with the files that the pages assume: photos, meshes, the starter set."""
    for name in ("photo.png", "other.png"):
        cut_out(tmp_path / name)
    (tmp_path / "starter").symlink_to(ROOT / "starter")
    (tmp_path / "my-meshes").mkdir()
    for name in ("one", "other"):
        (tmp_path / "my-meshes" / f"{name}.obj").write_text(TETRAHEDRON)
    monkeypatch.chdir(tmp_path)
    return tmp_path


RUNS = [block for block in SHELL if block.runs]


@pytest.mark.parametrize("block", RUNS, ids=str)
def test_marked_commands_run(block, workplace, capsys):
    prepare(block, workplace)
    for words in commands(block):
        mine = own(words)
        assert mine is not None, f"{block}: only commands of gamba can be run"
        name = " ".join(mine[:2]) if " ".join(mine[:2]) in cli.COMMANDS else mine[0]
        code = cli._main([*mine, *block.small.get(name.split()[-1], [])])
        said = capsys.readouterr()
        assert code == 0, f"{block}: gamba {shlex.join(mine)}\n{said.err}"


def prepare(block: Block, folder) -> None:
    """Makes what a block's own page has made before."""
    torch.manual_seed(0)
    if "out/photo.ply" in block.text:
        for name in ("out/photo.ply", "splats/one.ply"):
            (folder / name).parent.mkdir()
            save_ply(folder / name, some(60))
    if "truth.obj" in block.text:
        (folder / "truth.obj").write_text(TETRAHEDRON)
        trimesh.load(folder / "truth.obj").export(folder / "prediction.ply")


def assert_alike(found: str, wanted: str) -> None:
    """Compare words, and numbers within 2 %, for other processors' rounding."""
    number = re.compile(r"-?\d+\.?\d*")
    assert number.sub("#", found) == number.sub("#", wanted)
    numbers = zip(map(float, number.findall(found)), map(float, number.findall(wanted)))
    assert all(a == pytest.approx(b, rel=0.02, abs=0.01) for a, b in numbers), found


README_PYTHON = [b for b in PYTHON if b.runs or b.path == README]


@pytest.mark.parametrize("block", README_PYTHON, ids=str)
def test_marked_python_runs(block, workplace):
    exec(compile(block.text, str(block), "exec"), {})
    if "view.png" in block.text:
        assert load_ply("photo.ply").num > 1000
        image = load_rgba("view.png")
        assert image.shape == (256, 256, 4) and (image[..., :3] < 0.9).any()


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_a_script_beside_the_clone_finds_the_package(page, tmp_path):
    """An installation of a checkout is found after folders beside the script, packages or not."""
    (name,) = re.findall(r"^git clone <this repository> (\w+) ", (ROOT / page).read_text(), re.M)
    (tmp_path / name / "gamba_warp").mkdir(parents=True)
    (tmp_path / "script.py").write_text("from gamba_warp import __version__")
    plain = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run([sys.executable, tmp_path / "script.py"], check=True, env=plain)


def test_the_notebook_runs(workplace):
    """The code of its cells, one after the other; the figures that it shows are today's."""
    notebook = json.loads((ROOT / "docs" / "examples" / "first-steps.ipynb").read_text())
    names: dict = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
        shown = [o for o in cell["outputs"] if o["output_type"] == "stream"]
        assert_alike(out.getvalue(), "".join("".join(o["text"]) for o in shown))
