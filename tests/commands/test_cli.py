import importlib.metadata
import os
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import torch
import tyro
from helpers.children import ran
from helpers.forked import python

from gamba_warp import __version__, cli, versions
from gamba_warp.batch import STAGES
from gamba_warp.errors import FileWarning, UserError
from gamba_warp.measure import health


def exit_code(arguments):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    return caught.value.code or 0


@pytest.fixture
def command(monkeypatch):
    """Registers functions as the commands ``try`` and ``group one``."""

    def register(function):
        names = "try", "group one"
        row = cli.Command("Tries something.", module=__name__)
        monkeypatch.setattr(cli, "COMMANDS", dict.fromkeys(names, row))
        for name in ("try_command", "group_one_command"):
            monkeypatch.setattr(f"{__name__}.{name}", function, raising=False)

    return register


@pytest.mark.parametrize("arguments", [[], ["-h"], ["--help"], ["help"]])
def test_help_lists_every_command(arguments, capsys):
    assert exit_code(arguments) == 0
    out = capsys.readouterr().out
    assert all(f"gamba {name} " in out for name in cli.COMMANDS)


@pytest.mark.parametrize("flag", ["-V", "--version"])
def test_version(flag, capsys):
    assert exit_code([flag]) == 0
    assert capsys.readouterr().out.strip() == __version__


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["nonsense"], "unknown command 'nonsense'"),
        (["data"], "'data' needs one of: data furniture, data procedural, data render"),
        (["data", "nonsense"], "'data' needs one of"),
        (["--nonsense"], "unknown command '--nonsense'"),
        (["trian", "x"], "unknown command 'trian'; did you mean 'train'?"),
        (["help", "dta"], "did you mean 'data'?"),
        ("eval-geometry a b --protocol absent.json".split(), "expected default, gamba, gso, sf3d,"),
        ("eval-geometry a b --protocol splatter-image".split(), "is for views (gamba eval-views)"),
        (["bench", "a"], "unknown case 'a'; there are scan, conv, raster, model, step and all"),
        ("bench scan --quick --full".split(), "choose one"),
        (["stress", "sort"], "unknown case 'sort'; there are scan, raster and all"),
    ],
)
def test_wrong_words_of_commands_are_told_in_one_line(arguments, reason, capsys):
    assert exit_code(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("gamba: ") and reason in captured.err


LINES = {
    "reconstruct a.png --cutout plan": "invalid choice 'plan' for --cutout: not one of alpha, "
    "auto, grabcut, matte, none, plain",
    "reconstruct a.png --detail 3": "invalid choice '3' for --detail: not one of 1, 2, 4",
    "reconstruct a.png --size abc": "--size: expected a whole number, got 'abc'",
    "reconstruct a.png --elevation steil": "--elevation: expected a number, got 'steil'",
    "data render": "missing arguments: FOLDER, --out",
    "view": "missing argument: FILE",
    "view --nonsense": "missing argument: FILE",
    "render a.ply --size": "--size needs a value",
    "view a b": "unexpected argument: b",
    "view a b c": "unexpected arguments: b c",
    "view a --nmber 3": "unknown option --nmber",
    "export a --frame opencv": "--frame is now --axes",
    "view a --mesh-frame=opencv": "--mesh-frame is now --mesh-axes",
    "eval-views --no-lpips": "--no-lpips is now --lpips off",
}


@pytest.mark.parametrize("words", LINES)
def test_the_whole_line_about_wrong_options(words, capsys):
    """As another release of tyro must give them."""
    name = "data render" if words == "data render" else words.split()[0]
    assert exit_code(words.split()) == 2
    assert capsys.readouterr() == ("", f"gamba: {LINES[words]}; gamba {name} --help\n")


@pytest.mark.parametrize("result, code", [(None, 0), (0, 0), (1, 1)])
def test_a_commands_result_is_the_exit_code(command, result, code):
    seen = []

    def current(number: int = 3, *, flag: bool = False) -> int | None:
        seen.append((number, flag))
        return result

    command(current)
    assert exit_code(["try", "--number", "5"]) == code
    assert exit_code(["group", "one", "--flag"]) == code
    assert seen == [(5, False), (3, True)]


@dataclass(frozen=True)
class Place:
    """Options of a group."""

    axes: tuple[str, ...] = ()
    """Names."""
    place_file: Path | None = None
    """File."""


def _with_lists(
    files: Annotated[tuple[str, ...], tyro.conf.Positional],
    /,
    change: tuple[str, ...] | None = None,
    number: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 3,
    page: bool = True,
    place: Annotated[Place, tyro.conf.OmitArgPrefixes] = Place(),
) -> None:
    """Prints what it is given."""
    print(files, change, number, place.axes)


@pytest.mark.parametrize(
    "words, said",
    [
        ("f --number 1 --change a --number 1", "--number may be given only once\n"),
        ("f --change a --change=b", "--change may be given only once\n"),
        ("f --page --no-page", "--no-page may be given only once\n"),
        ("f --number=1 --number", "--number may be given only once\n"),
        ("f --nmber 1", "unknown option --nmber; gamba try --help\n"),
        ("f -o out", "unknown option --out; gamba try --help\n"),
    ],
)
def test_wrong_and_repeated_options_are_told_in_one_line(command, capsys, words, said):
    command(_with_lists)
    assert exit_code(["try", *words.split()]) == 2
    read = capsys.readouterr()
    assert read.out == "" and read.err.startswith(f"gamba: {said}") and read.err.count("\n") == 1


def test_common_options(command, capsys, monkeypatch):
    monkeypatch.setattr(STAGES, "seconds", {})  # of the commands before

    def current(out: Path = Path("here"), *, steps: int = 1) -> None:
        """Says it."""
        print(out, STAGES.quiet)

    command(current)
    assert exit_code(["try", "-o", "there"]) == 0
    assert capsys.readouterr().out == "there False\n"
    for word in ("-q", "--quiet"):
        assert exit_code(["try", word]) == 0
        assert capsys.readouterr() == ("", "")
    assert not STAGES.quiet
    assert exit_code(["try", "--steps", "2", "-v"]) == 0
    assert re.fullmatch(r"[\d.]+ s of CPU time\n", capsys.readouterr().err)
    assert exit_code(["try", "-o", "a", "--out", "b"]) == 2
    assert "--out may be given only once" in capsys.readouterr().err
    assert exit_code(["help", "try"]) == 0
    out = capsys.readouterr().out
    assert "--out PATH" in out and "(default: here)" in out and "-q, --quiet" in out


def run(*arguments, program=sys.executable, **options):
    command = [program, "-m", "gamba_warp", *arguments]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120, **options)


def test_a_closed_pipe_is_no_traceback():
    reader, writer = os.pipe()
    os.close(reader)
    result = run("--help", stdout=writer)
    os.close(writer)
    assert result.returncode == 141 and result.stderr == ""


# Prints to stderr the CPU time and the modules that a command's --help needs.
HELP = """
import resource, sys
from gamba_warp import cli
try:
    cli.main([*sys.argv[1:], "--help"])
finally:
    spent = resource.getrusage(resource.RUSAGE_SELF)
    print(spent.ru_utime + spent.ru_stime, *sys.modules, file=sys.stderr)
"""


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_explains_itself_at_once(name):
    done = ran(sys.executable, "-c", HELP, *name.split())
    assert done.returncode == 0 and f"gamba {name}" in done.stdout
    seconds, *modules = done.stderr.split()
    heavy = {"torch", "warp", "numpy", "PIL", "imageio_ffmpeg", "kornia", "timm", "trimesh"}
    assert not heavy & set(modules)
    assert float(seconds) < 2  # 0.2 where nothing else runs


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_shows_no_missing_default(name):
    text = " ".join(cli.help_text(name, cli.load_command(name), []).split())
    assert "{None}" not in text and "(default: )" not in text and "(default: None)" not in text
    assert "none" in text.split("--mesh ")[1].split("}")[0] if name == "reconstruct" else True


# Ctrl-C while ``gamba train`` opens its data; in the loop it saves and stops, see test_train.py.
CTRL_C = """
import os, runpy, signal, sys
from gamba_warp.train import loop
signal.signal(signal.SIGINT, signal.default_int_handler)
loop.open_data = lambda *_: os.kill(os.getpid(), signal.SIGINT)
module, *sys.argv[1:] = sys.argv[1:]
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("words", [["gamba_warp", "train"], ["gamba_warp.train"]], ids=" ".join)
def test_ctrl_c_ends_training_in_one_line(tmp_path, words):
    done = ran(python(), "-c", CTRL_C, *words, tmp_path, "--out", tmp_path / "run")
    assert done.returncode == 130 and done.stderr == "gamba: interrupted\n"


NONSENSE = {
    "train DATA": {
        "seed": "-1 4294967296", "lr": "inf nan 0 -1 11",
        "minutes": "inf nan 0 -1", "size": "0 -8 100000",
        "steps": "0 -1", "epochs": "0 nan inf", "batch-size": "0 -1", "accumulate": "0",
        "views-per-object": "-1 1001", "workers": "0",
        "threads": "0 -1 1000000", "lpips-weight": "nan inf -1",
        "lpips-after": "-1", "warmup-steps": "-1", "ema": "nan 1 -1",
        "log-every": "0", "val-every": "-1", "val-objects": "-1", "save-every": "0 -1",
        "procedural": "-0.5 1.5",
        "set": "image_size=100000000 depth=1000000000 width=-8 fov=1e999 fov=NaN depth=[[",
    },
    "train DATA --lpips on": {"size": "8 15"},
    "eval-views --checkpoint M --data DATA": {
        "views": "0 -1", "size": "15 100000", "limit": "0", "sheet": "-1 1000", "strips": "-1",
        "distance": "nan inf 0 -1", "reference": "-1",
    },
    "eval-geometry A B": {
        "points": "7 -1 1000000000", "voxels": "7 1000000", "views": "0 100000",
        "pixels": "7 1000000", "seed": "-1", "reference": "-1", "distance": "nan inf 0",
    },
    "export FILE": {
        "voxels": "7 1000000", "views": "0 1000000", "pixels": "0 1000000", "faces": "-1",
        "size": "8 100000", "min-opacity": "nan -1 2", "frames": "1 1000000000",
        "elevation": "91 nan", "fov": "0 180", "distance": "nan 0",
    },
    "reconstruct IMAGE": {
        "size": "8 100000", "frames": "1 1000000000", "min-opacity": "nan -1",
        "elevation": "91 nan", "fov": "0 180", "distance": "nan 0",
    },
    "view FILE": {"elevation": "91", "fov": "0 180", "distance": "nan 0"},
    "ablate ours DATA": {"threads": "0 1000000", "seeds": "-1 4294967296"},
    "render FILE --out OUT": {"elevation": "91", "fov": "0 180", "distance": "nan 0"},
    "bench scan": {"threads": "0 -1 1000000"},
    "stress scan": {
        "seed": "-1", "minutes": "0 nan inf", "cases": "0 -1", "threads": "0 1000000",
    },
    "data render DATA --out OUT": {
        "views": "0 1000000", "size": "0 100000", "fov": "0 nan 180", "seed": "-1", "limit": "0",
        "workers": "-1",
    },
}  # fmt: skip


@pytest.mark.parametrize("words", NONSENSE)
def test_a_value_out_of_its_range_is_one_line_before_anything_starts(
    words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    name = max((n for n in cli.COMMANDS if words.startswith(n)), key=len)
    for option, values in NONSENSE[words].items():
        for value in values.split():
            arguments = [*words.removeprefix(name).split(), f"--{option}={value}"]
            assert cli.run(name, arguments) == 2, (option, value)
            captured = capsys.readouterr()
            assert captured.out == "" and captured.err.count("\n") == 1, captured
            what = value.split("=")[0]
            assert f"--{option}" in captured.err and what[:9] in captured.err, captured.err
            assert "unknown option" not in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "error, text",
    [
        (MemoryError(), "not enough memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory:\n9 bytes"), "not enough memory"),
        (FileNotFoundError(2, "No such file or directory", "a.txt"), "a.txt: No such file"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError(24, "Too many open files"), "Too many open files"),
        (UnicodeEncodeError("utf-8", "caf\udce9", 3, 4, "surrogates not allowed"), "not UTF-8"),
        (UserError("two\nlines"), "two\\nlines\n"),
        (KeyboardInterrupt(), "interrupted\n"),
        *[(error, None) for error in (ZeroDivisionError(), RecursionError())],
        *[(error("a defect"), None) for error in (OSError, UnicodeError)],
    ],
)
def test_what_is_wrong_outside_is_one_line_and_defects_keep_their_traceback(
    command, error, text, capsys
):
    def current() -> None:
        raise error

    command(current)
    if text is None:
        with pytest.raises(type(error)):
            cli.main(["try"])
        return
    assert exit_code(["try"]) == (130 if isinstance(error, KeyboardInterrupt) else 2)
    said = capsys.readouterr().err
    assert said.startswith("gamba: ") and text in said and said.count("\n") == 1


def test_a_full_disk_under_the_output_is_one_line(tmp_path):
    with open("/dev/full", "w") as full:
        result = run("--help", stdout=full)
    assert result.returncode == 2
    want = "gamba: cannot write the standard output: No space left on device\n"
    assert result.stderr == want


def test_names_that_are_not_utf_8_can_be_printed(tmp_path):
    name = os.fsdecode(bytes(tmp_path) + b"/caf\xe9.ply")
    result = run("export", name, program=python(), stdout=subprocess.PIPE, cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == "" and "Traceback" not in result.stderr
    assert result.stderr.endswith("caf\\udce9.ply: no such file\n")


def test_warnings_of_files_are_one_line(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    line = warnings.formatwarning("a.png: odd", FileWarning, "images.py", 3)
    assert line == "gamba: warning: a.png: odd\n"
    assert "images.py:3: UserWarning: b" in warnings.formatwarning("b", UserWarning, "images.py", 3)


def doctor(capsys, *arguments):
    code = cli.run("doctor", list(arguments))
    return code, capsys.readouterr().out


def test_it_says_what_is_there(capsys):
    code, out = doctor(capsys)
    assert code == 0
    assert re.search(rf"gamba_warp +{re.escape(__version__)}\n", out)
    for name in ("torch", "warp-lang", "kornia", "pymeshlab"):
        assert re.search(rf"{name} +{re.escape(importlib.metadata.version(name))}\n", out)
    assert re.search(r"open3d(-cpu)? +\d", out) and "not installed" not in out
    assert re.search(r"cpu +\d+ threads", out) and "--warm-up" in out
    if not torch.cuda.is_available():
        assert re.search(r"cuda +none", out)
    for name in ("open3d", "mp4"):
        assert re.search(rf"{name} +yes\n", out)


def test_missing_weights_come_with_a_remedy_and_are_no_fault(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "none"))
    monkeypatch.setattr(health, "DEFAULT_CHECKPOINT", tmp_path / "tiny.safetensors")
    code, out = doctor(capsys)
    assert code == 0
    assert f"{tmp_path}/none (0 MiB)" in out
    assert re.search(r"lpips +no weights here; 'gamba weights lpips' fetches them", out)
    assert re.search(r"reconstruct +no shipped model, .*--checkpoint", out)
    (tmp_path / "tiny.safetensors").touch()
    assert re.search(r"reconstruct +yes\n", doctor(capsys)[1])


def test_a_library_that_does_not_work_is_a_fault(capsys, monkeypatch):
    def broken():
        raise OSError("libusb-1.0.so.0: cannot open shared object file\nmore")

    monkeypatch.setattr(health, "import_open3d", broken)
    code, out = doctor(capsys)
    assert code == 1 and re.search(r"open3d +no: libusb-1.0.so.0: cannot open .* file\n", out)


def test_a_missing_package_is_named(capsys, monkeypatch):
    monkeypatch.setattr(versions, "_USED", ("torch", "no-such-package"))
    assert re.search(r"no-such-package +not installed\n", doctor(capsys)[1])


def test_warming_up_runs_both_kernels(capsys):
    code, out = doctor(capsys, "--warm-up")
    found = re.search(r"cpu +([\d.]+) s to compile or load, then (\d+) ms", out)
    assert code == 0 and found
    assert float(found[1]) * 1000 + 50 >= float(found[2])  # rounded to 0.1 s


@pytest.mark.gpu
def test_warming_up_on_the_gpu(capsys):
    assert re.search(r"cuda +[\d.]+ s to compile or load", doctor(capsys, "--warm-up")[1])
