import os
import subprocess
import sys

import pytest

from gamba_warp import __version__, cli
from gamba_warp.errors import UserError


def exit_code(arguments):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    return caught.value.code or 0


@pytest.fixture
def command(monkeypatch):
    """Registers functions as the commands ``try`` and ``group one``."""

    def register(function):
        names = "try", "group one"
        monkeypatch.setattr(cli, "COMMANDS", dict.fromkeys(names, "Tries something."))
        monkeypatch.setattr(cli, "MODULES", dict.fromkeys(names, __name__))
        for name in ("try_command", "group_one_command"):
            monkeypatch.setattr(f"{__name__}.{name}", function, raising=False)

    return register


@pytest.mark.parametrize("arguments", [[], ["-h"], ["--help"]])
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
        (["data"], "'data' needs one of: data furniture, data render"),
        (["data", "nonsense"], "'data' needs one of"),
        (["--nonsense"], "unknown command '--nonsense'"),
    ],
)
def test_unknown_commands_are_told_in_one_line(arguments, reason, capsys):
    assert exit_code(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("gamba: ") and reason in captured.err


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


@pytest.mark.parametrize(
    "error, code, text",
    [
        (UserError("a.png: no such file"), 2, "gamba: a.png: no such file\n"),
        (KeyboardInterrupt(), 130, "gamba: interrupted\n"),
    ],
)
def test_expected_errors_have_a_code_and_no_traceback(command, error, code, text, capsys):
    def current() -> None:
        raise error

    command(current)
    assert exit_code(["try"]) == code
    assert capsys.readouterr().err == text


def test_defects_keep_their_traceback(command):
    def current() -> None:
        raise ZeroDivisionError

    command(current)
    with pytest.raises(ZeroDivisionError):
        cli.main(["try"])


def test_wrong_options_exit_with_2(command, capsys):
    def current(number: int = 3) -> None:
        raise AssertionError("must not run")

    command(current)
    assert exit_code(["try", "--nonsense", "5"]) == 2
    assert exit_code(["try", "--number", "five"]) == 2
    assert "number" in capsys.readouterr().err


def test_help_of_a_command(command, capsys):
    def current(number: int = 3) -> None:
        """Counts.

        Args:
            number: How far.
        """

    command(current)
    assert exit_code(["try", "--help"]) == 0
    out = capsys.readouterr().out
    assert "gamba try" in out and "Counts." in out and "How far." in out


def run(*arguments, **options):
    command = [sys.executable, "-m", "gamba_warp", *arguments]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120, **options)


def test_exit_code_reaches_the_shell(tmp_path):
    result = run("nonsense", stdout=subprocess.PIPE, cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr == "gamba: unknown command 'nonsense'; gamba --help lists them\n"


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
    command = [sys.executable, "-c", HELP, *name.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and f"gamba {name}" in done.stdout
    seconds, *modules = done.stderr.split()
    heavy = {"torch", "warp", "numpy", "PIL", "imageio_ffmpeg", "kornia", "timm", "trimesh"}
    assert not heavy & set(modules)
    assert float(seconds) < 2  # 0.2 where nothing else runs


def test_every_command_has_one_line_of_help():
    assert set(cli.MODULES) <= set(cli.COMMANDS)
    assert all(text.endswith(".") and len(text) < 60 for text in cli.COMMANDS.values())


# Ctrl-C while ``gamba train`` opens its data; in the loop it saves and stops, see test_train.py.
CTRL_C = """
import os, runpy, signal, sys
from gamba_warp.train import run
signal.signal(signal.SIGINT, signal.default_int_handler)
run.open_data = lambda config: os.kill(os.getpid(), signal.SIGINT)
module, *sys.argv[1:] = sys.argv[1:]
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("words", [["gamba_warp", "train"], ["gamba_warp.train"]], ids=" ".join)
def test_ctrl_c_ends_training_in_one_line(tmp_path, words):
    command = [sys.executable, "-c", CTRL_C, *words, str(tmp_path), "--out", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130 and done.stderr == "gamba: interrupted\n"
