"""For pytest, ``-p ops.debug_mode``: kernels are compiled in Warp's debug mode, on the CPU.

It checks each index into a Warp array, vector or matrix; the first that is wrong ends the process,
with the assertion, and with the launch in Python's stack. Pointers in C++ (``array.data``) have no
bounds that it could check. What tests/ptx executes is watched there, and skipped here.
"""

import pytest
import warp as wp

wp.config.mode = "debug"
# What a kernel checks at its end is found through a pointer that all threads share, if it lies on
# their stacks; optimization removes that, which this mode has none of. None: only on AArch64, where
# the pointer is in a register.
wp.config.enable_tiles_in_stack_memory = None


def pytest_collection_modifyitems(items):
    for item in items:
        if "from_ptx" in item.fixturenames or "_cuda.py" in item.nodeid:
            item.add_marker(pytest.mark.skip(reason="executed from PTX"))
