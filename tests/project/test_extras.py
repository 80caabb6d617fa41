"""The core runs without the extras, and tells how to install a missing library."""

import ast
import configparser
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.children import ran
from helpers.forked import python
from helpers.gaussians import some
from helpers.images import cut_out, disc_on_noise

from gamba_warp import cli, versions
from gamba_warp.formats.ply import save_ply
from gamba_warp.images import save_image

ROOT = Path(__file__).resolve().parents[2]
# They need the library for everything that they do, and are loaded when that is asked for.
ALL_OF_IT = {
    *(ROOT / "train" / "data" / "procedural").glob("*.py"),
    ROOT / "gamba_warp" / "compat" / "gsplat" / "strategy.py",
    ROOT / "gamba_warp" / "photo" / "plain.py",
    ROOT / "kernels" / "stress" / "run.py",
    *(ROOT / "gamba_warp" / "app" / f"{name}.py" for name in ("actions", "interface")),
}
# The name on the command line of an installer, or as an address there.
BY_NAME = re.compile(
    r"(install|run|add)\s([^\n]*?['\"\s])?gamba[-_]warp[\[=\s'\"]|pypi\.org/\S*gamba"
)
# Libraries whose distribution has another name than the module.
DISTRIBUTIONS = {"PIL": "pillow", "skimage": "scikit-image", "warp": "warp-lang", "yaml": "pyyaml"}
# Its weights are taken from the package where somebody has it.
OPTIONAL = {"lpips"}
# Refuses each library of the extras as if it were not installed, and runs a command.
WITHOUT = """
import importlib.util, sys
from gamba_warp import cli, versions

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if {name, name.partition(".")[0]} & set(versions.EXTRA_OF):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

real = versions.find_spec
versions.find_spec = lambda name: None if name in versions.EXTRA_OF else real(name)
importlib.util.find_spec = versions.find_spec
sys.meta_path.insert(0, Refuse())
assert not {*versions.EXTRA_OF} & {*sys.modules}
cli.main(sys.argv[1:])
"""


def in_the_core(*arguments):
    return ran(python(), "-c", WITHOUT, *arguments)


def distribution(library):
    return DISTRIBUTIONS.get(library, library.replace("_", "-"))


def declared():
    """Names of the distributions of each extra, those of extras in it included."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    section = config["options.extras_require"]
    section["core"] = config["options"]["install_requires"]

    def names(extra):
        found = set()
        for line in filter(None, map(str.strip, section[extra].split("\n"))):
            inner = re.fullmatch(r"gamba-warp\[(.*)\]", line)
            if inner:
                found |= set().union(*map(names, inner[1].split(",")))
            elif not line.startswith("#"):
                found.add(re.split(r"[<>=!~;\s\[]", line)[0])
        return found

    return {extra: names(extra) for extra in section}


def test_nothing_is_installed_by_a_name_that_is_nobodys():
    """No index has ``gamba-warp``; whoever registers it there would be installed by such a line."""
    kinds = {".md", ".py", ".ipynb", ".cfg", ".toml", ".yml", ".sh", ".js", ".html", ".txt", ""}
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    named, seen = [], 0
    for name in files.stdout.decode().split("\0")[:-1]:
        path = ROOT / name
        if path.suffix in kinds and path.is_file():
            text, seen = path.read_text(encoding="utf-8"), seen + 1
            named += [f"{name}: {found[0]}" for found in BY_NAME.finditer(text)]
    assert seen > 500 and not named


def test_each_library_is_in_the_extras_that_are_named():
    found = declared()
    for library, extra in versions.EXTRA_OF.items():
        name = distribution(library)
        holding = {extra} | {e for e, libraries in versions.HOLDS.items() if library in libraries}
        for one in holding:
            assert name in found[one], f"{one} lacks {name}"
    for name, row in cli.COMMANDS.items():
        assert {*row.needs} <= versions.HOLDS.get(row.extra, {*row.needs}), name
    assert found["all"] >= set().union(*(found[e] for e in set(versions.EXTRA_OF.values())))


def sources() -> list[Path]:
    folders = ("gamba_warp", "kernels", "train", "eval")
    return [path for folder in folders for path in (ROOT / folder).rglob("*.py")]


def imports_of(nodes) -> set[str]:
    """Names of the modules that these statements import."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module or "")
    return found


def test_no_module_imports_an_extra_when_it_is_loaded():
    """Imports for types and inside functions do not count."""
    for path in sources():
        nodes = [] if path in ALL_OF_IT else ast.parse(path.read_text(encoding="utf-8")).body
        for name in imports_of(nodes):
            assert not {name, name.partition(".")[0]} & set(versions.EXTRA_OF), (path, name)


def test_training_loads_without_what_makes_objects(monkeypatch):
    code = WITHOUT.rpartition("cli.main")[0] + "import gamba_warp.train.batches"
    done = ran(python(), "-c", code)
    assert done.returncode == 0, done.stderr
    from gamba_warp.train.data.pool import Pool

    real = versions.find_spec
    monkeypatch.setattr(versions, "find_spec", lambda n: n != "manifold3d" and real(n) or None)
    with pytest.raises(ModuleNotFoundError) as found:
        Pool(None, 0)
    assert found.value.name == "manifold3d"


@pytest.mark.parametrize(
    "line, library, extra",
    [
        ("train data", "kornia", "train"),
        ("data render meshes --out {0}/out", "trimesh", "mesh"),
        ("eval-views --checkpoint m --data d", "kornia", "eval"),
        ("demo", "kornia", "all"),
        ("app", "gradio", "app"),
        ("reconstruct {0}/a.png --out {0}/out --mesh obj", "trimesh", "mesh"),
        ("reconstruct {0}/a.png --out {0}/out --turntable mp4", "imageio_ffmpeg", "video"),
        ("export {0}/a.ply --out {0}/out --splats spz", "trimesh", "mesh"),  # a mesh by default
        ("export {0}/a.ply --out {0}/out --mesh none --turntable mp4", "imageio_ffmpeg", "video"),
        ("render {0}/a.ply --out {0}/out --kind mp4", "imageio_ffmpeg", "video"),
    ],
)
def test_what_is_missing_is_one_line_before_any_work(line, library, extra, tmp_path):
    cut_out(tmp_path / "a.png")
    save_ply(tmp_path / "a.ply", some(10))
    words = line.format(tmp_path).split()
    done = in_the_core(*words)
    name = "data render" if words[0] == "data" else words[0]
    what = f"{name} needs {library}, which is not installed"
    assert (done.returncode, done.stderr) == (2, f"gamba: {what}: {versions.to_install(extra)}\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_only_an_option_needs(tmp_path):
    image = cut_out(tmp_path / "thing.png")
    save_image(tmp_path / "busy.png", disc_on_noise((60, 80))[0])
    quick = ("--turntable", "none", "--no-page", "--out", tmp_path / "out")
    done = in_the_core("reconstruct", image, "--matte-model", "model.onnx", *quick)
    what = f"needs onnxruntime, which is not installed: {versions.to_install('photo')}\n"
    assert done.returncode == 2 and done.stderr.endswith(what), done.stderr
    done = in_the_core("reconstruct", tmp_path / "busy.png", *quick)
    assert done.returncode == 0 and "GrabCut cut the object out" in done.stdout, done.stderr
    assert versions.to_install("photo") in done.stderr


def imported() -> dict[str, Path]:
    """Libraries imported anywhere in the package, inside functions too, each with a file."""
    found = {}
    for path in sources():
        names = imports_of(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        found.update({name.split(".")[0]: path for name in names})
    return {n: p for n, p in found.items() if n not in {*sys.stdlib_module_names, "gamba_warp"}}


def test_every_import_is_required():
    required = set().union(*(names for extra, names in declared().items() if extra != "test"))
    libraries = imported()
    required |= OPTIONAL
    assert {"torch", "scipy", "PIL"} <= set(libraries), "the reader sees imports"
    for name, path in libraries.items():
        assert distribution(name) in required, f"{path}: {name} is not in setup.cfg"
