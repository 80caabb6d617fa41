"""The CPU kernels: lanes are adjacent channels, tokens run in strips, states a few at a time.

A task is one batch element, a segment of its tokens, and lane groups of one channel group. In a
strip it holds values that do not depend on the state n, and traverses the tokens once per few n and
lane group: their h_n are in registers and N is free. The loops are C++, ``forward.h`` and
``backward.h``. Equations are numbered as in README.md.
"""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp

from ...runtime.native import WARP_DTYPES, constants, lanes, native, native_kernel
from ...runtime.views import struct
from ..problem import DISCRETIZATIONS

# Lane groups of a task at most: rows are read in long parts that fit a core's cache. Transposed
# ones are read along the tokens, and a task has the fewest that it can.
SPAN = 32
BLOCKS = 4  # lane groups whose dB and dC are one partial sum, whatever the number of threads
FEW = 8  # states up to which the memory, and not the arithmetic, sets the time

# A chunk is traversed with care for slow decays where |x| <= 1/128 in one channel of the sixteen at
# least, or 1/32 in all. Then all channels with |x| <= 1/32 count as slow. Chunks of more than 64
# tokens take smaller limits, by their length, so that a state does not leave its base far behind.
SLOWEST, MODERATE = 1 / 128, 1 / 32

# gradients that cost work inside the loops, as bits of ``needs``
NEEDS = {"NEED_DZ": 1, "NEED_DC": 2, "NEED_DB": 4, "NEED_DH": 8}

_HERE = Path(__file__).parent
_MATRIX = wp.array4d(dtype=wp.float32)
_STATES = wp.array3d(dtype=wp.float32)  # [rows, D, N], or without rows
_WORK = wp.array2d(dtype=lanes)  # a row for each piece of the launch


class Tuning(NamedTuple):
    """Constants of a compiled kernel; the scan's README has the cost of the choices.

    Attributes:
        chunk: tokens between saved states, which the gradient traverses at once; a multiple of
            8 and of ``strip``.
        strip: tokens that the forward traverses at once for one state.
        degree: of the polynomial for the decays' 2^x, 2 to 6; the relative error of a decay is
            at most 2e-3, 1e-4, 3e-6, 3e-7 and 7.5e-9.
        table: True to compute 2^x by a table of 16 and a cubic, not the polynomial, where the
            processor has AVX-512; the relative error of a decay is then at most 6e-8.
        at_once: states that the forward computes together; 0 for 2 where there are FEW, else 4. A
            traversal fetches one tensor's rows of the next strip, so few states need shorter ones.
        back_at_once: states that the gradient computes together.
    """

    chunk: int = 64
    strip: int = 32
    degree: int = 5
    table: bool = True
    at_once: int = 0
    back_at_once: int = 4


class Kind(NamedTuple):
    """Key of a compiled kernel: the dtypes of u and delta, the rule, and the tuning.

    ``transposed``: u, delta, z, or the gradient of the output is (``runtime.views.is_transposed``).
    """

    io: torch.dtype
    delta_io: torch.dtype
    discretization: str
    tuning: Tuning
    transposed: bool

    def header(self, gradient: bool, output: bool = True) -> str:
        """C++ of the kernels, ``forward.h`` or ``backward.h``, and their constants, ``Config``."""
        tuning, rule = self.tuning, DISCRETIZATIONS[self.discretization]
        fraction = min(1.0, 64 / tuning.chunk)
        config = constants(
            "Config",
            MODE=[*DISCRETIZATIONS].index(self.discretization),
            WEIGHTED=rule.weighted,
            SCALE=rule.scale,
            DEGREE=tuning.degree,
            TABLE=tuning.table,
            SLOWEST=SLOWEST * fraction,
            MODERATE=MODERATE * fraction,
            GRADIENT=gradient,
            OUTPUT=output,
            TRANSPOSED=self.transposed,
            TOKENS=tuning.chunk if gradient else tuning.strip,
            CHUNK=tuning.chunk,
            AT_ONCE=tuning.back_at_once if gradient else tuning.at_once,
            BLOCKS=BLOCKS,
            **NEEDS,
        )
        return config + native(_HERE / ("backward.h" if gradient else "forward.h"))

    def kernel(self, function: str, inputs: dict[str, Any], outputs: dict[str, Any], header: str):
        """Return the kernel of a function of the header."""
        call = f"gamba::scan::{function}<Config>"
        inputs = {**_channels(self), **inputs}
        return native_kernel(f"scan_{function}", call, inputs, outputs, header, grouped=True)


@struct
class Sizes:
    """Launch parameters of the kernels: shapes, options, and wanted gradients."""

    length: int
    segment: int  # tokens of a segment, a multiple of the chunk
    segments: int
    batch: int  # sequences
    states: int
    groups: int
    group_width: int
    group_blocks: int
    span: int
    use_softplus: int
    use_z: int
    needs: int
    stream: int  # 1 if results bypass the caches


@functools.cache
def forward_kernel(kind: Kind, output: bool) -> Any:
    """Brings the states before each segment, ``first_in``, to those after it, ``last_out``.

    ``task.h`` has the layout of states. With ``output`` it computes y; else the products of the
    decays, and z, C and D are not used.
    """
    inputs = {"B_in": _MATRIX, "C_in": _MATRIX, "first_in": _STATES}
    outputs = {
        "work_out": _WORK,
        "last_out": _STATES,
        "product_out": _STATES,
        "starts_out": wp.array3d(dtype=lanes),
        "y_out": wp.array3d(dtype=WARP_DTYPES[kind.io]),
    }
    return kind.kernel("forward", inputs, outputs, kind.header(False, output))


@functools.cache
def gradient_states_kernel(kind: Kind) -> Any:
    """Kernel of a segment's gradient by the state before it, and of the products of the decays."""
    rows = wp.array3d(dtype=WARP_DTYPES[kind.io])
    inputs = {"C_in": _MATRIX, "dout_in": rows}
    outputs = {"work_out": _WORK, "dh_out": _STATES, "product_out": _STATES}
    return kind.kernel("gradient_states", inputs, outputs, kind.header(True))


@functools.cache
def backward_kernel(kind: Kind) -> Any:
    """Computes all gradients from the gradients of the states after each segment, ``dlast_in``."""
    rows = wp.array3d(dtype=WARP_DTYPES[kind.io])
    inputs = {
        "B_in": _MATRIX,
        "C_in": _MATRIX,
        "starts_in": wp.array3d(dtype=lanes),
        "dout_in": rows,
        "dlast_in": _STATES,
    }
    outputs = {
        "work_out": _WORK,
        "sums_out": _WORK,
        "dfirst_out": _STATES,
        "du_out": rows,
        "ddelta_out": wp.array3d(dtype=WARP_DTYPES[kind.delta_io]),
        "dz_out": rows,
        "dA_out": _STATES,
        "dB_out": wp.array2d(dtype=wp.float32),
        "dC_out": wp.array2d(dtype=wp.float32),
        "dchannel_out": wp.array3d(dtype=lanes),
    }
    return kind.kernel("backward", inputs, outputs, kind.header(True))


def _channels(kind: Kind) -> dict[str, Any]:
    """Return the inputs that all three begin with."""
    rows = wp.array3d(dtype=WARP_DTYPES[kind.io])
    deltas = wp.array3d(dtype=WARP_DTYPES[kind.delta_io])
    return {
        "sizes": Sizes,
        "ranges_in": wp.array2d(dtype=wp.int32),  # of packed rows: b, begin, end, chunk; or none
        "u_in": rows,
        "delta_in": deltas,
        "z_in": rows,
        "A_in": wp.array2d(dtype=wp.float32),
        "D_in": wp.array(dtype=wp.float32),
        "delta_bias_in": wp.array(dtype=wp.float32),
    }
