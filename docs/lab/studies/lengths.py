"""Benchmark cases over the number of tokens: a Mamba block against a transformer block.

The paper's question 2 concerns the benefit of Mamba's linear cost. Both blocks have the same width
and the same tokens, one sequence; the condition of a Gamba block is left out (its cost does not
grow with L). The transformer block attends to all tokens, as in other reconstruction models.
"""

from __future__ import annotations

import math
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from gamba_warp.kernels.bench.core.case import (
    BOTH,
    Case,
    Error,
    NotMeasured,
    Settings,
    Variant,
    compare,
)
from gamba_warp.kernels.bench.core.measure import peak_bytes, synchronize
from gamba_warp.measure.blocks import BACKWARD_LIMIT, LIMIT, reference_block
from gamba_warp.model.config import PRESETS
from gamba_warp.model.parts.attention import AttentionBlock
from gamba_warp.model.parts.block import GambaBlock, run_blocks

OP = "lengths"
MAMBA, ATTENTION = "Mamba block", "transformer block"
HALF_LIMITS = {"forward": 0.02, BOTH: 0.1}  # of bfloat16: 8 bits of a number, through a few sums
_TOKENS = 64  # first tokens that are compared with the oracle
_SPARE = 0.8  # share of the free memory that a run may take
_GROWTH = 2.5  # of the memory from one length to the next, at most: both blocks need O(L)
# The kernels that never hold the L x L matrix; torch raises where it has none of them.
_FUSED = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION]


class Stopped(NotMeasured):
    """Raised instead of a run that would exceed a limit, named by ``str(error)``."""

    word = "stopped"


@dataclass(frozen=True)
class Sizes:
    """Sizes of a run.

    Attributes:
        lengths: numbers of tokens, ascending.
        width: channels of a token, of both blocks.
        seconds: a series ends before the first length at which a call would take longer, judged
            by the two lengths before it.
    """

    lengths: tuple[int, ...]
    width: int
    seconds: float


def sizes_of(settings: Settings) -> Sizes:
    """Return the sizes of a level; the paper's width on CUDA or at the level "full"."""
    # The question concerns 1k to 64k; the shorter ones show a crossing below.
    powers = tuple(2**k for k in range(8, 17))
    if settings.level == "quick":
        return Sizes((128, 256, 512), 64, 2.0)
    wide = settings.device.type == "cuda" or settings.level == "full"
    width = PRESETS["paper"].width if wide else 256
    return Sizes(powers, width, 120.0 if settings.level == "full" else 40.0)


def reference_transformer(block: AttentionBlock, tokens: Tensor, count: int) -> Tensor:
    """The first tokens after a transformer block in float64 torch on the CPU, softmax written out.

    Args:
        block: the block whose weights are used; it has no prefix.
        tokens: ``[B, L, width]`` float64; every one of them is seen.
        count: number of tokens of the result.

    Returns:
        ``[B, count, width]`` float64.
    """
    weights = {name: p.detach().double().cpu() for name, p in block.named_parameters()}

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(x: Tensor, name: str) -> Tensor:
        centred = x - x.mean(-1, keepdim=True)
        scaled = centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt()
        return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    k, v, q = linear(norm(tokens, "norm"), "kvq_proj").chunk(3, -1)
    heads = []
    for q_h, k_h, v_h in zip(*(x.chunk(block.heads, -1) for x in (q[:, :count], k, v))):
        scores = q_h @ k_h.mT / q_h.shape[-1] ** 0.5
        heads.append(scores.softmax(-1) @ v_h)
    x = tokens[:, :count] + linear(torch.cat(heads, -1), "out_proj")
    hidden = linear(norm(x, "mlp_norm"), "mlp.0")
    hidden = 0.5 * hidden * (1 + torch.erf(hidden / 2**0.5))
    return x + linear(hidden, "mlp.2")


class Bench:
    """Both blocks and the tokens, for all lengths."""

    def __init__(self, settings: Settings, sizes: Sizes, dtype: torch.dtype) -> None:
        self.device, self.sizes, self.dtype = settings.device, sizes, dtype
        config = replace(PRESETS["paper"], width=sizes.width, depth=1, dt_rank=0, prepend=False)
        torch.manual_seed(0)
        other = replace(config, mixer="attention")
        self.blocks: dict[str, nn.Module] = {
            MAMBA: GambaBlock(config, 0, 0).to(self.device),
            ATTENTION: AttentionBlock(other, 0, 0).to(self.device),
        }
        self.tokens = torch.randn(1, sizes.lengths[-1], sizes.width).to(self.device)
        # A rate of 0 makes every step the same work on the same weights.
        self.optimizers = {
            name: torch.optim.AdamW(block.parameters(), lr=0.0, weight_decay=0.0)
            for name, block in self.blocks.items()
        }

    def autocast(self) -> AbstractContextManager:
        """Autocast of the products, as in training."""
        if self.dtype == torch.float32:
            return nullcontext()
        return torch.autocast(self.device.type, self.dtype)

    def apply(self, name: str, tokens: Tensor) -> Tensor:
        """Apply one block like the model: Mamba's on a CPU without gradients in segments."""
        with self.autocast(), sdpa_kernel(_FUSED):
            return run_blocks([self.blocks[name]], tokens, [None])

    @torch.no_grad()
    def forward(self, name: str, length: int) -> Tensor:
        """Run the block without gradients; timed."""
        return self.apply(name, self.tokens[:, :length])

    def step(self, name: str, length: int) -> None:
        """Forward, backward to the tokens and all weights, AdamW; timed."""
        tokens = self.tokens[:, :length].detach().requires_grad_()
        self.apply(name, tokens).float().square().mean().backward()
        self.optimizers[name].step()
        self.optimizers[name].zero_grad()

    def reference(self, name: str, tokens: Tensor, count: int) -> Tensor:
        """The first tokens after a block, float64 on the CPU."""
        block = self.blocks[name]
        if isinstance(block, AttentionBlock):
            return reference_transformer(block, tokens, count)
        assert isinstance(block, GambaBlock)
        return reference_block(block, tokens[:, :count], None, None)

    def check(self, name: str, length: int) -> Error:
        """Error of the block's contribution to the first tokens, which is causal for Mamba."""
        count = min(_TOKENS, length)
        tokens = self.tokens[:, :length].double().cpu()
        with torch.no_grad():
            got = self.forward(name, length)[:, :count].double().cpu()
            want = self.reference(name, tokens, count)
        first = tokens[:, :count]
        return compare({"update": got - first}, {"update": want - first})

    def check_step(self, name: str, length: int) -> Error:
        """Error of the gradient of the first tokens after the block with respect to all tokens."""
        count = min(_TOKENS, length)
        tokens = self.tokens[:, :length].detach().requires_grad_()
        cotangent = torch.zeros_like(tokens)
        cotangent[:, :count] = self.tokens[:, :count].flip(1)
        (got,) = torch.autograd.grad(self.apply(name, tokens), [tokens], cotangent)
        leaf = self.tokens[:, :length].double().cpu().requires_grad_()
        out = self.reference(name, leaf, count)
        (want,) = torch.autograd.grad(out, [leaf], cotangent[:, :count].double().cpu())
        return compare({"gradient of the tokens": got}, {"gradient of the tokens": want})


@dataclass
class Line:
    """A block in one direction, from length to length, until a limit ends it.

    Attributes:
        name: of the block.
        direction: "forward" or "forward+backward".
        bench: the benchmarked blocks.
        seconds: of the fastest call so far, by length.
        peaks: bytes by length, where they are known.
    """

    name: str
    direction: str
    bench: Bench
    seconds: dict[int, float] = field(default_factory=dict)
    peaks: dict[int, int] = field(default_factory=dict)
    ended: str = ""

    def _call(self, length: int) -> object:
        training = self.direction == BOTH
        return (self.bench.step if training else self.bench.forward)(self.name, length)

    def run(self, length: int) -> object:
        """Run one call. Raises Stopped if a shorter length exceeded a limit, or memory is short."""
        self._check_limits(length)
        try:
            return self._timed(length)
        except (MemoryError, RuntimeError) as error:
            if not _is_memory(error):
                raise
            self.ended = f"not enough memory at L {length:,}"
            raise Stopped(self.ended) from error

    def _timed(self, length: int) -> object:
        started = time.perf_counter()
        result = self._call(length)
        synchronize(self.bench.device)
        spent = time.perf_counter() - started
        self.seconds[length] = min(spent, self.seconds.get(length, spent))
        return result

    def expected(self, length: int) -> float:
        """Expected seconds of a call, by the power law through the two shorter lengths."""
        shorter = sorted(done for done in self.seconds if done < length)
        if not shorter:
            return 0.0
        last = shorter[-1]
        if len(shorter) == 1:
            return self.seconds[last]
        before = shorter[-2]
        slope = math.log(self.seconds[last] / self.seconds[before]) / math.log(last / before)
        # A call's overhead hides the growth of short lengths, and no call exceeds O(L squared).
        return self.seconds[last] * (length / last) ** min(max(slope, 0.0), 2.0)

    def _check_limits(self, length: int) -> None:
        shorter = max((done for done in self.seconds if done < length), default=None)
        if not self.ended and shorter is not None and length not in self.seconds:
            limit, free = self.bench.sizes.seconds, free_bytes(self.bench.device)
            needed = _GROWTH * self.peaks.get(shorter, 0)
            expected = self.expected(length)
            if expected > limit:
                self.ended = f"L {length:,} would take {expected:.3g} s, limit {limit:g} s"
            elif free is not None and needed > _SPARE * free:
                self.ended = (
                    f"L {length:,} may need {needed / 2**30:.1f} GiB, {free / 2**30:.1f} are free"
                )
        if self.ended and length not in self.seconds:
            raise Stopped(self.ended)

    def check(self, length: int) -> Error:
        """Return the error; record the memory of a call to predict that of the next length."""
        error = self.bench.check_step if self.direction == BOTH else self.bench.check
        found = error(self.name, length)
        # This is the second call: the first one may include a compilation.
        peak = peak_bytes(partial(self._timed, length), self.bench.device)
        if peak is not None:
            self.peaks[length] = peak
        return found

    def work(self, length: int) -> dict[str, int]:
        """Memory of a call: its growth, including results, excluding earlier allocations."""
        return {"peak_bytes": self.peaks[length]} if length in self.peaks else {}


def _is_memory(error: BaseException) -> bool:
    known = isinstance(error, (MemoryError, torch.OutOfMemoryError))
    return known or "can't allocate memory" in str(error)


def free_bytes(device: torch.device) -> int | None:
    """Free memory of the GPU, or of a Linux machine; None elsewhere."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        return 1024 * int(next(x for x in lines if x.startswith("MemAvailable")).split()[1])
    except (OSError, StopIteration, ValueError):
        return None


def cases(settings: Settings) -> list[Case]:
    """Return the cases: forward and a step of training; on CUDA each in two dtypes."""
    sizes = sizes_of(settings)
    dtypes = [torch.float32, torch.bfloat16][: 2 if settings.device.type == "cuda" else 1]
    names = {"forward": "forward", BOTH: "training step"}
    text = (
        f"A Mamba block and a transformer block (pre-norm, fused attention over all tokens, heads "
        f"of 64 channels, GELU MLP of 4 times the width) of width {sizes.width}, one sequence. "
        f"A series ends before the first length at which a call would take over "
        f"{sizes.seconds:g} s, and where memory would not do. Memory: growth of "
        f"{_memory_word(settings)} while a call runs, its results included; weights, tokens and "
        f"AdamW's moments are there before. L*: where the lines cross, on logarithmic axes."
    )
    extra = {
        "forward": " Without gradients; Mamba in segments on a CPU, as the model runs it there.",
        BOTH: " Forward, backward to the tokens and all weights, and a step of AdamW.",
    }
    return [
        Case(
            op=OP,
            name=f"{name}, {_name(dtype)}",
            text=text + extra[direction],
            build=partial(lines, settings, sizes, direction, dtype),
            axis="lengths",
        )
        for dtype in dtypes
        for direction, name in names.items()
    ]


def _memory_word(settings: Settings) -> str:
    cuda = settings.device.type == "cuda"
    return "what torch has allocated on the GPU" if cuda else "the process's resident memory"


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def lines(settings: Settings, sizes: Sizes, direction: str, dtype: torch.dtype) -> list[Variant]:
    """Return the variants of one direction: both blocks at every length, short ones first."""
    bench = Bench(settings, sizes, dtype)
    both = [Line(name, direction, bench) for name in bench.blocks]
    full = dtype == torch.float32
    limit = {"forward": LIMIT, BOTH: BACKWARD_LIMIT}[direction] if full else HALF_LIMITS[direction]
    what = "gradient of all tokens, of the" if direction == BOTH else "the"
    return [
        _variant(line, length, limit, f"float64, {what} first {_TOKENS} tokens")
        for length in sizes.lengths
        for line in both
    ]


def _variant(line: Line, length: int, limit: float, oracle: str) -> Variant:
    weights = sum(p.numel() for p in line.bench.blocks[line.name].parameters())
    width = line.bench.sizes.width
    made = Variant(
        name=f"{line.name}, L {length:,}",
        run=lambda: None,
        check=partial(line.check, length),
        limit=limit,
        oracle=oracle,
        direction=line.direction,
        dtype=_name(line.bench.dtype),
        parameters={"L": length, "D": width, "series": line.name, "weights": weights},
        work=partial(line.work, length),
    )

    def run() -> object:
        result = line.run(length)
        # Three rounds suffice for calls of seconds, one for longer calls.
        share = line.seconds[length] / line.bench.sizes.seconds
        made.rounds = None if share < 0.01 else 3 if share < 0.1 else 1
        return result

    made.run = run
    return made
