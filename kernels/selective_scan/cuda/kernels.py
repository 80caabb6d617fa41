"""The kernels of the CUDA scan: sizes and types for ``scan_forward.cuh``, ``scan_backward.cuh``."""

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp

from ...runtime.native import WARP_DTYPES, constants, cuda_kernel, native
from ...runtime.views import struct
from ..problem import DISCRETIZATIONS

STATES = 16  # of a pass, the most that the threads of a channel hold in registers
CHUNK = 64  # tokens between the states that the forward saves for the gradient
# Chunks whose sums are added in a row: equal terms in a row round to the same side.
RUN = 16

_HERE = Path(__file__).parent
_VECTOR, _STATES = wp.array(dtype=float), wp.array3d(dtype=float)


@struct
class Sizes:
    """Launch parameters of all kernels: shapes, and numbers that map block indices to them."""

    length: int
    states: int
    group_width: int
    groups: int
    parts: int  # blocks of channels in a group
    segments: int  # of a sequence, each a block's own; of packed ones at most
    segment: int  # tokens of one, a multiple of CHUNK; packed sequences have their own
    save: int


@dataclasses.dataclass(frozen=True)
class BlockShape:
    """The static shape of a block; ``block.cuh`` says which thread does what."""

    block: int  # threads
    channels: int  # of a thread
    states: int  # of a thread, in one pass
    lanes: int  # threads that share a channel
    passes: int  # over the tokens of a tile, each for other states; 1 up to 16 states

    @property
    def width(self) -> int:
        """States of a pass, padded."""
        return self.lanes * self.states

    @property
    def padded(self) -> int:
        """All states, padded."""
        return self.width * self.passes

    @property
    def slots(self) -> int:
        """Groups of ``lanes`` threads."""
        return self.block // self.lanes

    @property
    def span(self) -> int:
        """Channels of a block."""
        return self.slots * self.channels

    @property
    def rows(self) -> int:
        """Threads that share the loads of one channel, each for other tokens."""
        return self.block // self.span

    @property
    def held(self) -> int:
        """Elements (channel, state) of a thread in a pass."""
        return self.channels * self.states

    @property
    def own(self) -> int:
        """Elements of a thread."""
        return self.held * self.passes

    @property
    def pad(self) -> int:
        """Floats between the lanes' partial sums, against bank conflicts."""
        return 32 // self.lanes if self.lanes > 1 else 0

    @property
    def constants(self) -> dict[str, int]:
        """Constants of the C++."""
        names = (*vars(self), "width", "padded", "slots", "span", "rows", "held", "own", "pad")
        shape = {name.upper(): getattr(self, name) for name in names}
        return shape | {"CHUNK": CHUNK, "RUN": RUN}


def block_shape(block: int, channels: int, states: int, total: int) -> BlockShape:
    """The block shape for ``total`` states; the others are a tuning's, of a block or a thread."""
    width = min(STATES, 1 << (total - 1).bit_length())
    states = min(states, width)
    lanes = width // states
    return BlockShape(block, min(channels, lanes), states, lanes, -(-total // width))


class Rules(NamedTuple):
    """A call's choices that its kernels are compiled for.

    Attributes:
        dtypes: of u, delta, and of B and C.
        shape: of a block.
        mode: the discretization.
        softplus: True if δ is a softplus.
        gate: True if there is z.
        output: True if there are outputs; else C is left out.
    """

    dtypes: tuple[torch.dtype, torch.dtype, torch.dtype]
    shape: BlockShape
    mode: str
    softplus: bool
    gate: bool
    output: bool

    @property
    def types(self) -> dict[str, Any]:
        """Warp types of the inputs by name."""
        u, delta, matrix = (WARP_DTYPES[x] for x in self.dtypes)
        return {
            "sizes": Sizes,
            "packed_in": wp.array2d(dtype=int),
            "u_in": wp.array3d(dtype=u),
            "delta_in": wp.array3d(dtype=delta),
            "z_in": wp.array3d(dtype=u),
            "A_in": _STATES,
            "B_in": wp.array4d(dtype=matrix),
            "C_in": wp.array4d(dtype=matrix),
            "D_in": _VECTOR,
            "delta_bias_in": _VECTOR,
        }

    def header(self, file: str, **more: object) -> str:
        """A C++ file in this folder, and the struct of a kernel's constants."""
        mode = [*DISCRETIZATIONS].index(self.mode)
        rules = {"MODE": mode, "SOFTPLUS": self.softplus, "GATE": self.gate, "OUTPUT": self.output}
        return native(_HERE / file) + constants("Config", **self.shape.constants, **rules, **more)


@functools.cache
def forward_kernel(rules: Rules, summary: bool):
    """The kernel of a segment, or as a summary that of its last state from zero and its decay."""
    f = rules.shape
    # fewer where B and C of very many states would fill shared memory
    tokens = 16 if f.padded <= 128 else 8
    shared = _operands(f, tokens)
    if rules.output and not summary:
        shared += tokens * f.padded + f.lanes * (tokens * f.span + f.pad)
    header = rules.header("scan_forward.cuh", TOKENS=tokens, SHARED=2 * shared, SUMMARY=summary)
    return cuda_kernel(
        "scan_forward",
        "gamba::scan::scan_forward<Config>",
        rules.types | {"initial_state_in": _STATES},
        {
            "last_state_out": _STATES,
            "decay_out": _STATES,
            "saved_out": _STATES,
            "y_out": rules.types["u_in"],
        },
        header,
        2 * shared,
        f.block,
    )


def _operands(f: BlockShape, tokens: int) -> int:
    """Floats of the operands of a tile in shared memory."""
    return tokens * (2 * f.span + f.padded)


@functools.cache
def summary_kernel(rules: Rules):
    """The first kernel of a gradient in segments: ``summarise_backward``."""
    f, types = rules.shape, rules.types
    shared = 2 * _operands(f, 16)
    names = "sizes", "packed_in", "delta_in", "z_in", "A_in", "C_in", "delta_bias_in"
    header = rules.header("scan_forward.cuh", TOKENS=16, SHARED=shared, SUMMARY=True)
    return cuda_kernel(
        "summarise_backward",
        "gamba::scan::summarise_backward<Config>",
        {name: types[name] for name in names} | {"dout_in": types["u_in"]},
        {"dinitial_state_out": _STATES, "decay_out": _STATES},
        header,
        shared,
        f.block,
    )


@functools.cache
def backward_kernel(rules: Rules, needs: frozenset[str]):
    """The gradient's kernel.

    Args:
        rules: of the forward.
        needs: gradients that it computes: of ``du``, ``ddelta``, ``dz``, ``dB``, ``dC``, and ``dh``
            if any but dz, dC and that of D is needed.
    """
    f, types, tokens = rules.shape, rules.types, 8
    lane = tokens * f.channels * (f.slots + 8 // f.channels) + (8 if f.lanes > 1 else 0)
    shared = _operands(f, tokens) + rules.output * tokens * (f.span + f.padded)
    shared += f.lanes * lane * (("dz" in needs) + 2 * ("dh" in needs))
    shared += tokens * (f.slots + 1) * f.width * (("dB" in needs) + ("dC" in needs))
    shared = max(shared, 2 * _operands(f, 16))  # where states are recomputed
    wanted = {f"NEED_{x.upper()}": x in needs for x in ("du", "ddelta", "dz", "dB", "dC", "dh")}
    header = rules.header("scan_backward.cuh", TOKENS=tokens, SHARED=shared, **wanted)
    # without outputs 168 registers suffice; the compiler's own choice is more, or fewer with spills
    resident = 1 if rules.output or f.passes > 1 else max(1, 3 * 128 // f.block)
    return cuda_kernel(
        "scan_backward",
        "gamba::scan::scan_backward<Config>",
        types | {"dout_in": types["u_in"], "saved_in": _STATES, "dlast_state_in": _STATES},
        {
            "dinitial_state_out": _STATES,
            "du_out": types["u_in"],
            "ddelta_out": types["delta_in"],
            "dz_out": types["u_in"],
            **dict.fromkeys(("dA_out", "dB_out", "dC_out", "dD_out", "ddelta_bias_out"), _STATES),
        },
        header,
        shared,
        (f.block, resident) if resident > 1 else f.block,
    )
