"""The Makefile installs for users what users need, and the rest for developers."""

import os
from pathlib import Path

import pytest
from helpers.children import ran

ROOT = Path(__file__).resolve().parents[2]


def commands(folder: Path, *words: str) -> str:
    """Everything that ``make WORDS`` would run where nothing is installed yet."""
    command = ["make", "--dry-run", f"VENV={folder / 'none'}", *words]
    done = ran(*command, cwd=ROOT, env={**os.environ, "MAKEFLAGS": ""})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("target", ["setup", "demo"])
def test_a_user_installs_no_tools_of_developers(target, tmp_path):
    said = commands(tmp_path, target)
    assert "--editable '.[all]'" in said and "[test]" not in said
    assert "--quiet" not in said, "each step has its line, and downloads pip's bars"
    assert "pip fetches" in said


@pytest.mark.parametrize("target", ["test", "lint", "docs", "format", "hostile", "endurance"])
def test_tests_and_checks_add_their_tools(target, tmp_path):
    said = commands(tmp_path, target)
    tools = said.index("--editable '.[test]'")
    assert said.index("--editable '.[all]'") < tools < said.rindex(str(tmp_path / "none"))


def test_a_locked_set_up_has_the_versions_of_constraints(tmp_path):
    assert "--constraint" not in commands(tmp_path, "test")
    locked = commands(tmp_path, "test", "LOCKED=1")
    assert locked.count("--constraint constraints.txt --editable") == 2
