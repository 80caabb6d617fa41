"""C++ fragments, which ``runtime/native.py`` joins to kernels, begin by saying what they need."""

import re
from pathlib import Path

import pytest

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
FRAGMENTS = sorted(
    path
    for end in ("h", "inl")
    for path in KERNELS.rglob(f"*.{end}")
    if "namespace gamba" not in path.read_text()  # headers, whose functions have parameters
)
HEAD = re.compile(r"// needs: (.*?)\n// gives: (.*?)\n(?!//     )", re.DOTALL)


def heads(path):
    """Names that a fragment needs, by the file that gives them, names that it gives, its text."""
    text = path.read_text()
    found = HEAD.match(text)
    assert found, f"{path} must begin with its lines // needs: and // gives:"
    needs, gives = (re.sub(r"\n//     ", " ", x) for x in found.groups())
    by_file = dict(x.split(": ") for x in needs.split("; ")) if needs != "nothing" else {}
    gives = re.sub(r"(; )?the bod(y|ies) of .*", "", gives)
    names = gives.split(", ") if gives else []
    return {k: v.split(", ") for k, v in by_file.items()}, names, text[found.end() :]


def is_defined(name, code):
    """True if a name is declared, as a macro, a type, a variable or a function."""
    before = r"(#define |struct |enum |[\w>)*&\]] |[*&]|, |\) )"
    return re.search(rf"{before}{name}(\(|\[|;| =|,| \{{|\{{| __attribute__|\n)", code) is not None


@pytest.mark.parametrize("path", FRAGMENTS, ids=lambda path: str(path.relative_to(KERNELS)))
def test_a_fragment_says_what_it_needs_and_gives(path):
    needs, gives, text = heads(path)
    code = re.sub(r"//.*", "", text)
    assert not [name for name in gives if not is_defined(name, code)]
    for file, names in needs.items():
        assert not [name for name in names if not re.search(rf"\b{name}\b", code)], "needless"
        # its own folder's, or one of the package
        near = [x for x in (path.parent / file, path.parent.parent / file) if x.exists()]
        (origin, *_) = near or list((KERNELS / "runtime").glob(file))
        if origin.suffix == ".h":
            assert not set(names) - set(heads(origin)[1]), origin
        else:  # where it may be made of parts, or a macro of an attribute in small letters
            given = origin.read_text().lower()
            assert all(part in given for x in names for part in x.lower().split("_")), origin
