"""Every library that the package imports is named in setup.cfg."""

import ast
import configparser
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Libraries whose distribution has another name than the module.
DISTRIBUTIONS = {"PIL": "pillow", "skimage": "scikit-image", "warp": "warp-lang"}
# Its weights are taken from the package where somebody has it.
OPTIONAL = {"lpips"}


def imported() -> dict[str, Path]:
    """Libraries imported anywhere in the package, inside functions too, each with a file."""
    found = {}
    for folder in ("gamba_warp", "kernels", "train", "eval"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.level == 0:
                    names = [node.module or ""]
                found.update({name.split(".")[0]: path for name in names})
    return {n: p for n, p in found.items() if n not in {*sys.stdlib_module_names, "gamba_warp"}}


def test_every_import_is_required():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    extras = [text for name, text in config["options.extras_require"].items() if name != "test"]
    lines = "\n".join([config["options"]["install_requires"], *extras]).split("\n")
    required = {re.split(r"[<>=!~;\s]", line.strip())[0] for line in lines}
    libraries = imported()
    assert {"torch", "scipy", "PIL"} <= set(libraries), "the reader sees imports"
    for name, path in libraries.items():
        wanted = DISTRIBUTIONS.get(name, name.replace("_", "-"))
        assert name in OPTIONAL or wanted in required, f"{path}: {name} is not in setup.cfg"
