"""Style rules that can be checked automatically."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [
    path
    for folder in ("kernels", "gamba_warp", "train", "eval", "docs")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


def _is_device(node) -> bool:
    return any("wp." in ast.unparse(d) for d in node.decorator_list)


def _is_overload(node) -> bool:
    return any(ast.unparse(d) == "overload" for d in node.decorator_list)


def test_public_functions_have_docstrings():
    for path in SOURCES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                if isinstance(node, ast.FunctionDef) and (_is_device(node) or _is_overload(node)):
                    continue
                assert ast.get_docstring(node), f"{path}: {node.name} has no docstring"


def test_every_progress_bar_is_the_one_that_logs_do_without():
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            bars = "tqdm", "tqdm.tqdm", "trange"
            if isinstance(node, ast.Call) and ast.unparse(node.func) in bars:
                assert path == ROOT / "gamba_warp" / "batch.py", f"{path}, line {node.lineno}"


def test_the_continuous_integration_trusts_no_tag_and_may_only_read():
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        text = path.read_text()
        actions = re.findall(r"uses: *(.*)", text)
        assert actions and "\npermissions:\n  contents: read\n" in text, path
        assert text.count("permissions:") == 1 and "persist-credentials: false" in text, path
        for action in actions:
            assert re.fullmatch(r"\S+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action
