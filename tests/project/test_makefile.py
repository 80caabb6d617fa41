"""The Makefile installs for users what users need, and the rest for developers."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def commands(target: str, folder: Path) -> str:
    """Everything that ``make TARGET`` would run where nothing is installed yet."""
    done = subprocess.run(
        ["make", "--dry-run", f"VENV={folder}", target],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "MAKEFLAGS": ""},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("target", ["setup", "demo"])
def test_a_user_installs_no_tools_of_developers(target, tmp_path):
    said = commands(target, tmp_path / "none")
    assert "--editable '.[all]'" in said and "[test]" not in said
    assert "--quiet" not in said, "each step has its line, and downloads pip's bars"
    assert "pip fetches" in said


@pytest.mark.parametrize("target", ["test", "lint", "docs", "format", "hostile", "endurance"])
def test_tests_and_checks_add_their_tools(target, tmp_path):
    said = commands(target, tmp_path / "none")
    tools = said.index("--editable '.[test]'")
    assert said.index("--editable '.[all]'") < tools < said.rindex(str(tmp_path / "none"))


def test_a_locked_set_up_has_the_versions_of_constraints(tmp_path):
    said = commands("test", tmp_path / "none")
    assert "--constraint" not in said
    locked = subprocess.run(
        ["make", "--dry-run", f"VENV={tmp_path / 'none'}", "test", "LOCKED=1"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert locked.count("--constraint constraints.txt --editable") == 2
