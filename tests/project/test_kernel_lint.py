"""Rules of kernel_lint.py: the tree obeys them, and violations are found."""

import sys

import pytest
from helpers.children import ran
from project import kernel_lint
from project.kernel_lint import findings

KERNEL = """
@wp.kernel(enable_backward=False, module="unique")
def k(sizes: Sizes, lists_in: Lists, x_in: wp.array2d[float], y_out: wp.array[wp.float32]):
    i = wp.tid()
    n = x_in.shape[1]
    at = wp.int64(i) * wp.int64(x_in.shape[1]) + wp.int64(wp.static(2 * SIZE))
    y_out[i] = x_in[i, n - 1] * float(x_in.shape[1])
    store(y_out, at, x_in[i, 0])
"""
CPP = """
const size_t row = task, at = row * 3;
out.order.data[row * count + i] = in.lists.order.data[i];
const float* p = (const float*)((char*)x_in.data + (size_t)i * x_in.strides[0]) + i * 4;
const float* q = p + wide_(i, x_in.strides[1]) * 2 + (x_in.data[i] == 0);
float* out = y_out.data + ((size_t)b * rows + i) * count;
"""


def _found(python="", cpp=CPP):
    return findings({"k/a.py": KERNEL + python, "k/n.h": cpp})


def test_what_keeps_the_rules_is_not_found():
    assert _found() == []


def test_the_kernels_keep_the_rules():
    done = ran(sys.executable, kernel_lint.__file__)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("y_out[i] =", "x_in[i, 0] =", "inputs"),
        ("store(y_out, at", "L.store_int(x_in, at", "inputs"),
        ("i = wp.tid()", "i = wp.atomic_add(lists_in.order, 0, 1)", "inputs"),
        ("i = wp.tid()", "i = wp.tid()\n    i *= x_in.strides[0]", "32 bits"),
        ("wp.int64(i) * wp.int64(x_in.shape[1])", "wp.int64(i * sizes.rows)", "32 bits"),
        ("enable_backward=False, ", "", "backward"),
        ('(enable_backward=False, module="unique")', "", "backward"),
    ],
)
def test_each_rule_of_python(old, new, rule):
    before, found_old, after = KERNEL.partition(old)
    assert found_old
    (found,) = findings({"k/a.py": (head := before + new) + after})
    assert found.startswith(f"k/a.py:{head.count(chr(10)) + 1}: {rule}: "), found


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("in.lists.order.data[i + n] |= 1;", "inputs"),
        ("__atomic_fetch_add(lists_in.order.data + i, 1, 0);", "inputs"),
        ("float* p = y_out.data + (size_t)i + n * count;", "32 bits"),
        ("const auto* s = x_in.strides;", "32 bits"),
        ("at += (size_t)(i * count);", "32 bits"),
    ],
)
def test_each_rule_of_cpp(text, rule):
    (found,) = _found(cpp=f"// {text}\n{text}\n")
    assert found.startswith(f"k/n.h:2: {rule}: "), found
    inside = f'\n@wp.func_native("""\n{text}\n""")\ndef f(): ...\n'
    assert len(_found(python=inside)) == 1


def test_a_module_may_turn_backward_off():
    off = 'wp.set_module_options({"enable_backward": False})\n'
    kernel = "@wp.kernel\ndef k(i: int): ...\n"
    assert findings({"k/a.py": off + kernel}) == []
    assert len(findings({"k/a.py": kernel})) == 1
    own = '@wp.kernel(module="unique")\ndef k(i: int): ...\n'  # a module of its own
    assert len(findings({"k/a.py": off + own})) == 1
