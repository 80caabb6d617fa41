"""The rules of kernels that can be checked without running them; ``make lint`` does so.

- ``inputs``: nothing is written to what is named ``…_in``, or in C++ ``in.…``. What a function
  knows by a plain name is not followed.
- ``32 bits``: the number of a row fits in 32 bits, because views.py refuses longer arrays, and
  Warp's own indexing multiplies it by the stride in 64. What is counted in elements or bytes does
  not fit: so a stride or a length is widened before it is multiplied, and so is, in C++, a factor
  of what is added to an array's ``data``. A product that is widened too late is refused; if it is
  the number of a row, it gets a name. Lengths that a struct holds, and pointers that were made
  from ``data``, are not looked at; ``make ptx`` runs the scan with strides near 2^31.
- ``backward``: ``enable_backward=False``, for the kernel or the module.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_WRITING = re.compile(r"(tile_)?(atomic|store|write|put)")
_WIDENED = ("wp.int64", "wp.uint64", "wp.static", "float", "wp.float32")
_WIDE = r"\(size_t\)|\(long long\)|\bwide_?\("

Found = Iterator[tuple[int, str, str]]  # line, rule, what


def findings(sources: dict[str, str]) -> list[str]:
    """Return violations in Python or C++ files, given as texts by name."""
    found = []
    for name, text in sources.items():
        of_file = {*(_python(ast.parse(text)) if name.endswith(".py") else _cpp(text))}
        found += [f"{name}:{line}: {rule}: {what}" for line, rule, what in sorted(of_file)]
    return found


def _python(tree: ast.Module) -> Found:
    options = [ast.unparse(node) for node in tree.body]
    off = any("set_module_options({'enable_backward': False" in text for text in options)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.kernel":
            said = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if said.get("enable_backward", str(not off or "module" in said)) != "False":
                yield node.lineno, "backward", "the kernel has no enable_backward=False"
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for line, rule, what in _cpp(node.value):
                yield node.lineno + line - 1, rule, what
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = [ast.unparse(x) for x in node.decorator_list]
        if "wp.kernel" in decorators and not off:
            at = node.decorator_list[decorators.index("wp.kernel")].lineno
            yield at, "backward", f"neither {node.name} nor its module turns it off"
        if any(x.startswith(("wp.kernel", "wp.func")) for x in decorators):
            yield from _body(node)


def _body(function: ast.FunctionDef) -> Found:
    for node in ast.walk(function):
        written: list[ast.expr] = []
        if isinstance(node, (ast.Assign, ast.AugAssign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            written = [y for x in targets for y in (x.elts if isinstance(x, ast.Tuple) else [x])]
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if _WRITING.match(called.rpartition(".")[2]):
                written = [*node.args[:1]]
            if called in ("wp.int64", "wp.uint64"):
                inside = [y for x in node.args for y in _narrow(x)]
                if any(isinstance(getattr(x, "op", None), ast.Mult) for x in inside):
                    yield node.lineno, "32 bits", f"widened too late: {ast.unparse(node)}"
        if isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.Mult):
            of = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.value,)
            names = {getattr(y, "attr", "") for x in of for y in _narrow(x)}
            if names & {"shape", "strides"}:
                yield node.lineno, "32 bits", f"a length is multiplied: {ast.unparse(node)}"
        for x in written:
            while isinstance(x, (ast.Subscript, ast.Attribute)):
                x = x.value
            if isinstance(x, ast.Name) and x.id.endswith("_in"):
                yield x.lineno, "inputs", f"{function.name} writes to {x.id}"


def _narrow(node: ast.AST) -> Iterator[ast.AST]:
    """A node and what is in it, without what is widened or known when the kernel is compiled."""
    if not (isinstance(node, ast.Call) and ast.unparse(node.func) in _WIDENED):
        yield node
        for child in ast.iter_child_nodes(node):
            yield from _narrow(child)


def _cpp(text: str) -> Found:
    text = re.sub(r"//.*", "", text)

    def line(at: int) -> int:
        return text.count("\n", 0, at) + 1

    target = r"\b(\w+_in|in\.\w+)(?:\.\w+)*\.data"
    for m in re.finditer(rf"{target}\[[^;=]*\]\s*[-+*/|&^]?=(?!=)|__atomic_\w+\(&?{target}", text):
        yield line(m.start()), "inputs", f"writes to {m[1] or m[2]}"
    for m in re.finditer(r"\((?:size_t|long long)\)\([^()]* \* [^()]*\)", text):
        yield line(m.start()), "32 bits", f"widened too late: {m[0]}"
    array = r"[\w.]+\.strides\[\d\]"
    allowed = rf"wide_?\([^;]*?{array}\)|\(size_t\)(?:[\w.]+\s*\* \(?)?{array}"
    rest = re.sub(allowed, lambda m: re.sub(r"\S", " ", m[0]), text)
    for m in re.finditer(r"\S+\bstrides\b\S*", rest):
        yield line(m.start()), "32 bits", f"not widened: {m[0]}"
    declared = re.findall(r"\b(?:size_t|long long|int64_t) ([^;()]*)", text)
    names = [n for x in declared for n in re.findall(r"^\w+|\w+(?= =)", x)]
    wide = re.compile("|".join([_WIDE, *(rf"\b{n}\b" for n in names)]))
    for m in re.finditer(r"\.data\)?(?:\[|\s+\+ )", text):
        for term in _terms(text[m.end() :]):
            factors = re.split(r"\s\* ", term)
            if len(factors) > 1 and not wide.search(" * ".join(factors[:2])):
                yield line(m.start()), "32 bits", f"not widened: {term}"


def _terms(text: str) -> list[str]:
    """The terms of the sum that a text begins with."""
    terms, depth = [""], 0
    for token in re.findall(r"\s[-+] |\s+|\w+|\S", text):
        depth += (token in "([{") - (token in ")]}")
        if depth < 0 or depth == 0 and token in ",;?:=":
            break
        if depth == 0 and token[1:] in ("+ ", "- "):
            terms.append("")
        else:
            terms[-1] += token
    return terms


if __name__ == "__main__":
    ends = (".py", ".h", ".cuh")
    files = [x for x in sorted((ROOT / "kernels").rglob("*")) if x.suffix in ends]
    faults = findings({str(x.relative_to(ROOT)): x.read_text() for x in files})
    sys.exit("\n".join(faults) or None)
