"""The interpreter itself: what it computes, what it finds, what it refuses."""

import ctypes
import operator
import re
from fractions import Fraction
from itertools import product
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from helpers.children import ran
from helpers.kernels import plain_kernel

from . import launch as launching
from . import machine as machines
from .launch import Interpreter
from .machine import Count, Missing, Refused, cuda_tool, opcodes, units
from .parse import SPACES, read

HEAD = ".version 8.0\n.target sm_80\n.address_size 64\n.shared .align 16 .b8 mem[1024];\n"
ENTRY = """.visible .entry k(.param .u64 p) {{
.reg .pred %p<20>; .reg .b16 %h<20>; .reg .b32 %r<40>; .reg .b64 %rd<40>;
ld.param.u64 %rd1, [p]; mov.u32 %r1, %tid.x; mov.u32 %r9, %ctaid.x; mov.u32 %r3, mem;
mul.wide.u32 %rd3, %r1, 4; add.s64 %rd4, %rd1, %rd3; shl.b32 %r2, %r1, 2; add.s32 %r4, %r3, %r2;
{}
ret; }}"""


def run(body, memory, threads=64, blocks=1, **options):
    """An interpreter that has executed a kernel's body; %rd1 is the address of ``memory``."""
    made, program = Interpreter(**options), read(HEAD + ENTRY.format(body))["k"]
    address = memory.data_ptr().to_bytes(8, "little")
    made.execute(program, [address], [memory], (threads, blocks, 0))
    return made


STORE = "st.global.u32 [%rd4], %r1;"
# In these each thread writes what it reads of another's shared memory: of the next lane, or warp.
PUT, TAKE = "st.shared.u32 [%r4], %r1;", "ld.shared.u32 %r7, [%r6]; st.global.u32 [%rd4], %r7;"
NEXT = f"xor.b32 %r5, %r2, 4; add.s32 %r6, %r3, %r5; {TAKE}"
FAR = f"xor.b32 %r5, %r2, 128; add.s32 %r6, %r3, %r5; {TAKE}"
ODD = "and.b32 %r5, %r1, 1; setp.eq.s32 %p1, %r5, 0;"
VOTE, SYNC = "vote.sync.ballot.b32 %r8, %p1, -1; st.global.u32 [%rd4], %r8;", "bar.sync 0;"
RACE, UNWRITTEN, BOUNDS = "race in shared memory", "depends on what nobody wrote", "out of bounds"
GLOBAL_RACE, DIVERGENT = "race in global memory", "divergent barrier"
FAULTS = {
    "neighbour without a barrier": (PUT + NEXT, {RACE}),
    "neighbour after a barrier of the warp": (PUT + "bar.warp.sync -1;" + NEXT, set()),
    "another warp after that": (PUT + "bar.warp.sync -1;" + FAR, {RACE}),
    "another warp after a barrier of the block": (PUT + "bar.sync 0;" + FAR, set()),
    "a vote orders no memory": (PUT + ODD + VOTE + NEXT, {RACE}),
    "written after it was read": (PUT + "bar.sync 0;" + FAR + "st.shared.u32 [%r4], %r2;", {RACE}),
    "never written": ("bar.sync 0;" + FAR, {UNWRITTEN}),
    "never written, never used": ("ld.shared.u32 %r7, [%r4+512]; mov.u32 %r8, %r7;" + STORE, set()),
    "a branch by what was never written": (
        "ld.shared.u32 %r7, [%r4]; setp.eq.s32 %p1, %r7, 0; @%p1 bra $A; mov.u32 %r8, 0; $A:",
        {UNWRITTEN},
    ),
    "past the end": ("st.global.u32 [%rd4+4], %r1;", {BOUNDS}),
    "before the beginning": ("ld.global.u32 %r7, [%rd1+-4]; st.global.u32 [%rd4], %r7;", {BOUNDS}),
    "past the end of shared memory": ("st.shared.u32 [%r4+2048], %r1;", {BOUNDS}),
    "misaligned": ("st.global.u32 [%rd1+2], %r1;", {"misaligned"}),
    "half a warp at a barrier": (ODD + f"@%p1 bra $A; {SYNC} bra $B; $A: {SYNC} $B:", {DIVERGENT}),
    "a guarded barrier": (ODD + "@%p1 bar.sync 0;", {DIVERGENT}),
    "half a warp votes": (ODD + f"@%p1 bra $A; {VOTE} bra $B; $A: {VOTE} $B:", {"deadlock"}),
    "a vote without its lanes": (
        ODD + "vote.sync.ballot.b32 %r8, %p1, 15; st.global.u32 [%rd4], %r8;",
        {"mask of lanes that are not there"},
    ),
    "two blocks, one place": ("add.s32 %r5, %r1, %r9; st.global.u32 [%rd4], %r5;", {GLOBAL_RACE}),
    "two blocks, one value": (STORE, set()),
    "atomic by two blocks": ("atom.global.add.u32 %r5, [%rd4], 1;", set()),
    "atomic and not": ("atom.global.add.u32 %r5, [%rd4], 1;" + STORE, {GLOBAL_RACE}),
    "no end": ("$A: bra $A;", {"no end"}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults(monkeypatch, name):
    monkeypatch.setattr(launching, "MOST_STEPS", 10_000)
    body, want = FAULTS[name]
    body = body if body.strip()[-1] == ";" else body + " mov.u32 %r10, 0;"
    for seed in (0, 1, 2):
        memory = torch.zeros(64, dtype=torch.int32)
        made = run(body, memory, blocks=1 + ("two blocks" in name or "atomic" in name), seed=seed)
        found = {line.split(":")[0] for line in made.findings}
        # a race may also read what is not written yet
        assert want <= found <= want | ({UNWRITTEN} if RACE in want else set()), made.findings


def test_refusals(monkeypatch):
    for text, reason in (
        ("frob.b32 %r5, %r1;", "frob.b32 is not known"),
        ("vote.sync.uni.pred %p1, %p2, -1;", "vote.sync.uni.pred is not known"),
        ("add.s32 %r5, %rd1, 1;", "%rd1 has 64 bits"),
        ("bar.sync 1;", "a barrier with a number"),
    ):
        with pytest.raises(Refused, match=re.escape(reason)):
            read(HEAD + ENTRY.format(text))
    with pytest.raises(Refused, match="version 10.1"):
        read(HEAD.replace("8.0", "10.1") + ENTRY.format(""))


def test_without_a_compiler_or_room(monkeypatch, tmp_path):
    build = machines.library.__wrapped__
    monkeypatch.setattr(machines.wp.config, "kernel_cache_dir", str(tmp_path / "file" / "x"))
    (tmp_path / "file").touch()
    with pytest.raises(Missing, match="the interpreter cannot be kept: .*file"):
        build()
    monkeypatch.setattr(machines.wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(machines, "_FLAGS", "-std=none")
    with pytest.raises(Missing, match="-std=none"):
        build()
    monkeypatch.setattr(machines.shutil, "which", lambda name: None)
    with pytest.raises(Missing, match="no C.. compiler"):
        build()
    monkeypatch.setattr(machines.wp, "get_cuda_toolkit_version", lambda: None)
    with pytest.raises(Missing, match="no NVRTC"):
        build()
    full = OSError(28, "No space left on device")
    monkeypatch.setattr(machines.wp, "compile_aot_module", Mock(side_effect=full))
    with pytest.raises(Missing, match="cannot be kept: .*No space left"):
        launching.programs.__wrapped__(plain_kernel.module, 32)


def test_memory():
    """Widths, signs and vectors; what lanes compute together; atomic operations of two blocks."""
    memory = torch.arange(64, dtype=torch.int32) - 3
    body = """setp.ne.s32 %p1, %r1, 0; @%p1 bra $B;
    ld.global.u8 %r10, [%rd1]; ld.global.s8 %r11, [%rd1]; ld.global.u16 %r12, [%rd1];
    ld.global.s16 %r13, [%rd1]; ld.global.u64 %rd10, [%rd1]; ld.global.s32 %rd11, [%rd1];
    st.global.v4.u32 [%rd1], {%r10, %r11, %r12, %r13}; st.global.v2.u64 [%rd1+16], {%rd10, %rd11};
    st.global.u8 [%rd1+32], %r13; st.global.u16 [%rd1+36], %r13; $B: mov.u32 %r14, 0;"""
    assert not run(body, memory).findings
    assert memory[:8].tolist() == [0xFD, -3, 0xFFFD, -3, -3, -2, -3, -1]
    assert memory[8:10].tolist() == [0xFD, 0xFFFD]
    together = """vote.sync.ballot.b32 %r10, %p1, -1; redux.sync.or.b32 %r11, %r1, -1;
    setp.lt.s32 %p2, %r1, 32; selp.b32 %r12, %r10, %r11, %p2; st.global.u32 [%rd4], %r12;"""
    run(ODD + together, memory)
    assert (memory[:32] == 0x55555555).all() and (memory[32:] == 63).all()
    for name, start, value, want in (
        ("add.u32", 5, "%r1", 5 + 2 * sum(range(64))),
        ("or.b32", 1 << 20, "%r1", (1 << 20) + 63),
        ("min.s32", 7, "-5", -5),
        ("max.s32", -7, "%r1", 63),
    ):
        memory[0] = start
        assert not run(f"atom.global.{name} %r10, [%rd1], {value};", memory, blocks=2).findings
        assert memory[0] == want
    values = torch.full((64,), 0.5)
    assert not run("atom.global.add.f32 %r10, [%rd1], 0f3FC00000;", values, blocks=2).findings
    assert values[0] == 0.5 + 128 * 1.5
    memory[:2] = torch.tensor([-1, 0])
    run("mov.u64 %rd10, 1; atom.global.add.u64 %rd11, [%rd1], %rd10;", memory)
    assert memory[:2].tolist() == [63, 1]


def lanes(body, threads=32, **options):
    """Return each lane's %r10 after a body, in which %r1 is the lane; nothing may be found."""
    memory = torch.zeros(threads, dtype=torch.int32)
    made = run(body + "st.global.u32 [%rd4], %r10;", memory, threads, **options)
    assert not made.findings, made.findings
    return memory.tolist()


@pytest.mark.parametrize("segment", (32, 8))
@pytest.mark.parametrize("by", (0, 1, 5, 16))
@pytest.mark.parametrize("mode", ("up", "down", "bfly", "idx"))
def test_shuffles(mode, by, segment):
    """The lane read is in the lane's segment; else it is the lane itself."""
    last, want = (0 if mode == "up" else segment - 1), []
    for lane in range(32):
        begin = lane - lane % segment
        moved = {"up": lane - by, "down": lane + by, "bfly": lane ^ by, "idx": begin + by % segment}
        inside = mode == "bfly" or begin <= moved[mode]  # of lower segments it can read, too
        inside &= moved[mode] < begin + segment
        want.append((moved[mode] if inside else lane) * 2 + inside)
    c = (32 - segment) << 8 | last
    body = f"""shl.b32 %r5, %r1, 1; shfl.sync.{mode}.b32 %r6|%p1, %r5, {by}, {c}, -1;
    selp.u32 %r7, 1, 0, %p1; or.b32 %r10, %r6, %r7;"""
    for seed in (0, 1):
        assert lanes(body, seed=seed) == want
    body = f"shfl.sync.{mode}.b32 %r10, %r1, {by}, {c}, -1;"
    assert lanes(body) == [x // 2 for x in want]


def test_lanes_of_several_masks():
    """Groups of lanes, each with a mask of its own, do the same at the same place."""
    body = """and.b32 %r5, %r1, 3; match.any.sync.b32 %r6, %r5, -1;
    redux.sync.max.s32 %r7, %r1, %r6; shfl.sync.idx.b32 %r8, %r1, %r5, 31, %r6;
    shl.b32 %r8, %r8, 8; or.b32 %r10, %r7, %r8;"""
    for seed in (0, 1, 2):
        assert lanes(body, seed=seed) == [28 + lane % 4 | (lane % 4) << 8 for lane in range(32)]
    odd = "add.s32 %r5, %r1, -9; redux.sync.max.s32 %r10, %r5, -1;"
    assert lanes(odd, 8 * 4) == [22] * 32
    assert lanes("and.b32 %r5, %r1, 3; match.any.sync.b32 %r10, %r5, -1;") == [
        (0x11111111 << lane % 4) - (1 << 32) * (lane % 4 == 3) for lane in range(32)
    ]


def test_a_shuffle_of_what_nobody_wrote():
    """A shuffle reports unwritten data only in lanes that are in its mask and read one."""
    half = "setp.lt.u32 %p1, %r1, 16; @%p1 mov.u32 %r5, 7;"
    read = "shfl.sync.bfly.b32 %r10, %r5, {}, 31, -1;"
    memory = torch.zeros(32, dtype=torch.int32)
    for by in (16, 1):
        body = f"{half} {read.format(by)} @%p1 st.global.u32 [%rd4], %r10;"
        found = run(body, memory, 32).findings
        assert [line.split(":")[0] for line in found] == [UNWRITTEN] * (by == 16)
    low = "@!%p1 bra $A; shfl.sync.bfly.b32 %r10, %r1, 16, 31, 0xFFFF; $A: mov.u32 %r11, 0;"
    body = f"{half} mov.u32 %r10, 0; {low} @%p1 st.global.u32 [%rd4], %r10;"
    assert [line.split(":")[0] for line in run(body, memory, 32).findings] == [UNWRITTEN]


def test_a_count_at_a_barrier():
    body = ODD + "setp.ne.u32 %p2, %r1, 0; @!%p2 bra $A; $A: bar.red.popc.u32 %r10, 0, %p1;"
    for seed in (0, 1):
        assert lanes(body, 96, seed=seed) == [48] * 96


def test_blocks_and_grids_of_three_dimensions():
    """Threads go by x, then y, then z, and so do blocks."""
    names = ("tid", "ntid", "ctaid", "nctaid")
    mix = "mov.u32 %r12, %{}.{}; mad.lo.s32 %r11, %r11, 7, %r12;"
    body = "mov.u32 %r11, 0;" + "".join(mix.format(*each) for each in product(names, "xyz"))
    body += """mov.u32 %r12, %tid.y; mov.u32 %r13, %tid.z; mad.lo.s32 %r12, %r13, 5, %r12;
    mad.lo.s32 %r12, %r12, 3, %r1; mov.u32 %r13, %ctaid.y; mov.u32 %r14, %ctaid.z;
    mad.lo.s32 %r13, %r14, 3, %r13; mad.lo.s32 %r13, %r13, 2, %r9; mad.lo.s32 %r12, %r13, 60, %r12;
    mul.wide.u32 %rd5, %r12, 4; add.s64 %rd5, %rd1, %rd5; st.global.u32 [%rd5], %r11;"""
    threads, blocks = (3, 5, 4), (2, 3, 2)
    memory, want = torch.zeros(60 * 12, dtype=torch.int32), []
    assert not run(body, memory, threads, blocks).findings
    for block, thread in product(np.ndindex(blocks[::-1]), np.ndindex(threads[::-1])):
        key = 0
        for number in (*thread[::-1], *threads, *block[::-1], *blocks):
            key = (key * 7 + number) % 2**32
        want.append(key - 2**32 * (key >> 31))
    assert memory.tolist() == want
    below = "mov.u32 %r5, %lanemask_lt; popc.b32 %r10, %r5;"
    assert lanes(below, 48) == [k % 32 for k in range(48)]


def test_halves_quotients_and_scopes():
    pack = "cvt.u16.u32 %h1, %r1; mov.b32 %r5, {%h1, 3}; mov.b32 {%h2, %h3}, %r5;"
    assert lanes(pack + "mov.u32 %r10, %r5;") == [lane | 3 << 16 for lane in range(32)]
    unpacked = "cvt.u32.u16 %r6, %h2; cvt.u32.u16 %r7, %h3; mad.lo.s32 %r10, %r6, 8, %r7;"
    assert lanes(pack + unpacked) == [8 * lane + 3 for lane in range(32)]
    numbers = "mov.b32 %r5, 0f40E00000; mov.b32 %r6, 0f40000000;"
    seven_halves = lanes(numbers + "div.approx.ftz.f32 %r10, %r5, %r6;")[0]
    assert np.int32(seven_halves).view(np.float32) == 3.5
    shadowed = ODD + "{ .reg .pred %p1; .reg .b32 r; setp.ne.s32 %p1, %r1, %r1; mov.u32 r, 5; }"
    assert lanes(shadowed + "selp.u32 %r10, 1, 0, %p1;") == [1 - lane % 2 for lane in range(32)]


def test_halves_of_a_word_of_shared_memory():
    """Two lanes may write to the same word, each its own 2 bytes; not each other's."""
    body = """shl.b32 %r5, %r1, 1; add.s32 %r6, %r3, %r5; cvt.u16.u32 %h1, %r1;
    st.shared.u16 [%r6], %h1; {} xor.b32 %r5, %r5, 2; add.s32 %r6, %r3, %r5;
    ld.shared.u16 %h2, [%r6]; cvt.u32.u16 %r10, %h2;"""
    assert lanes(body.format("bar.warp.sync -1;")) == [lane ^ 1 for lane in range(32)]
    memory, store = torch.zeros(32, dtype=torch.int32), "st.global.u32 [%rd4], %r10;"
    found = run(body.format("") + store, memory, 32).findings
    assert {line.split(":")[0] for line in found} <= {RACE, UNWRITTEN} and found


WORDS = [0, 1, 2, 15, 16, 31, 32, 33, 63, 64, 0x7FFF, 0x8000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
WORDS += [0x00000001, 0x007FFFFF, 0x00800000, 0x3F800000, 0x3FC00000, 0xBFC00000, 0x40200000]
WORDS += [0x4F000000, 0xCF000000, 0x7F7FFFFF, 0x7F800000, 0xFF800000, 0x7FC00000, 0x3F807FFF]
LONG = [x << 32 | 0x80000001 for x in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)]
DOUBLES = np.array([0, -0.0, 1, 1 + 2.0**-24, 1 + 3 * 2.0**-24, -3.5, 2.0**-149, 2.0**-127, 1e300])
DOUBLES = [*DOUBLES.view(np.uint64), 0x47EFFFFFE0000000, 0x47EFFFFFF0000000]
DOUBLES += [0x7FF << 52, 0x7FF8 << 48]


def number(bits, kind):
    """The value of a register's bits as a type of PTX reads them."""
    if kind == "f32":
        return np.uint32(bits & 0xFFFFFFFF).view(np.float32)
    if kind == "f64":
        return np.uint64(bits).view(np.float64)
    if kind == "pred":
        return bits & 1
    if kind.endswith("f16"):
        return bits & 0xFFFF
    size = int(kind[1:])
    bits &= (1 << size) - 1
    return bits - (1 << size) if kind[0] == "s" and bits >> (size - 1) else bits


def nearest(x):
    """The float32 that is nearest to a fraction, of two such the even one."""
    near = np.float32(float(x))
    around = [near, np.nextafter(near, np.float32(np.inf)), np.nextafter(near, np.float32(-np.inf))]
    finite = [y for y in around if np.isfinite(y)]
    return min(finite, key=lambda y: (abs(Fraction(float(y)) - x), y.view(np.uint32) & 1))


def fused(a, b, c, down=False):
    if not all(map(np.isfinite, (a, b, c))) or abs(float(a) * float(b) + float(c)) > 3.4e38:
        y = np.float32(float(a) * float(b) + float(c))
        huge = np.isinf(y) and y > 0 and not any(map(np.isinf, (a, b, c)))
        return np.finfo(np.float32).max if down and huge else y
    x = Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))
    if x == 0:
        signs = np.signbit(a) != np.signbit(b), np.signbit(c)
        return np.float32(-0.0 if all(signs) or down and any(signs) else 0.0)
    y = nearest(x)
    return np.nextafter(y, np.float32(-np.inf)) if down and Fraction(float(y)) > x else y


def quotient(a, b):
    return -1 if b == 0 else abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)


def to_integer(low, high):
    return lambda x: 0 if np.isnan(x) else int(min(max(float(x), low), high))


def flushed(x):
    return np.copysign(np.float32(0), x) if isinstance(x, np.float32) and abs(x) < 2.0**-126 else x


def toward_zero(a, b):
    y = fused(a, np.float32(1), b)
    if not np.isfinite([a, b]).all():
        return y
    exact = Fraction(float(a)) + Fraction(float(b))
    if np.isinf(y):
        return np.copysign(np.finfo(np.float32).max, y)
    return np.nextafter(y, np.float32(0)) if abs(Fraction(float(y))) > abs(exact) else y


def permuted(a, b, c):
    bytes_ = (a | b << 32).to_bytes(8, "little")
    chosen = [c >> 4 * i & 15 for i in range(4)]
    signs = [0xFF * (bytes_[k & 7] >> 7) if k & 8 else bytes_[k & 7] for k in chosen]
    return int.from_bytes(signs, "little")


def lowest(a, b):
    return (a if np.signbit(a) else b) if a == b else np.float32(np.fmin(float(a), float(b)))


COMPARISONS = {name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")}
INTEGERS = {
    "add": operator.add,
    "sub": operator.sub,
    "mul.lo": operator.mul,
    "mul.wide": operator.mul,
    "mul.hi": lambda a, b: a * b >> 32,
    "mad.lo": lambda a, b, c: a * b + c,
    "mad.wide": lambda a, b, c: a * b + c,
    "and": operator.and_,
    "or": operator.or_,
    "xor": operator.xor,
    "not": lambda a: ~a,
    "neg": lambda a: -a,
    "mov": lambda a: a,
    "min": min,
    "max": max,
    "shl": lambda a, b: a << min(b, 64),
    "shr": lambda a, b: a >> min(b, 64),
    "div": quotient,
    "rem": lambda a, b: a if b == 0 else a - b * quotient(a, b),
    "selp": lambda a, b, c: a if c & 1 else b,
    "popc": lambda a: bin(a).count("1"),
    "brev": lambda a: int(f"{a:032b}"[::-1], 2),
    "clz": lambda a: 32 - a.bit_length(),
    "bfind": lambda a: a.bit_length() - 1,
    "prmt": permuted,
    "bfind.shiftamt": lambda a: 32 - a.bit_length() if a else -1,
    **{f"setp.{name}": function for name, function in COMPARISONS.items()},
}
FLOAT = {"f32": np.float32, "f64": np.float64}
FLOATS = {
    "add": operator.add,
    "add.rz": toward_zero,
    "copysign": lambda a, b: np.copysign(b, a),
    "sub": operator.sub,
    "mul": operator.mul,
    "div.rn": np.divide,
    "rcp.rn": lambda a: np.float32(1) / a,
    "sqrt.rn": np.sqrt,
    "fma.rn": fused,
    "fma.rm": lambda a, b, c: fused(a, b, c, down=True),
    "min": lowest,
    "max": lambda a, b: -lowest(-a, -b),
    "abs": abs,
    "neg": operator.neg,
    "mov": lambda a: a,
    "selp": INTEGERS["selp"],
    "setp.nan": lambda a, b: np.isnan(a) or np.isnan(b),
    "setp.num": lambda a, b: not (np.isnan(a) or np.isnan(b)),
    "cvt.rpi": np.ceil,
    "cvt.rmi": np.floor,
    "cvt.sat": lambda a: np.float32(0) if np.isnan(a) else np.clip(a, 0, 1) + np.float32(0),
}
for key, compare in COMPARISONS.items():
    FLOATS[f"setp.{key}"] = lambda a, b, f=compare: f(a, b) and not np.isnan([a, b]).any()
    FLOATS[f"setp.{key}u"] = lambda a, b, f=compare: f(a, b) or np.isnan([a, b]).any()
CONVERSIONS = {
    "cvt.rn.bf16.f32": lambda x: int(torch.tensor(x).bfloat16().view(torch.int16)),
    "cvt.rn.f16.f32": lambda x: int(np.float16(x).view(np.uint16)),
    "cvt.f32.f16": lambda x: np.float32(np.uint16(x).view(np.float16)),
    "cvt.f32.bf16": lambda x: np.uint32(x << 16).view(np.float32),
    "cvt.rzi.s32.f32": to_integer(-(2**31), 2**31 - 1),
    "cvt.rzi.u32.f32": to_integer(0, 2**32 - 1),
    "cvt.f64.f32": np.float64,
    "cvt.rn.f32.f64": np.float32,
    "cvt.s64.s32 of 64": lambda x: number(x, "s32"),
    "cvt.u64.u32 of 64": lambda x: x & 0xFFFFFFFF,
    "cvta.shared.u64": lambda x: x | 1 << 56,
    "cvta.to.shared.u64": lambda x: x & ~(1 << 56),
}
# Bounds of the relative error, from the ISA's text or CUDA's tables. (Between .5 and 2 that of lg2
# is of the absolute error, which the interpreter does not draw.)
APPROXIMATE = {
    "ex2.approx.ftz.f32": (np.exp2, 2.0**-22),
    "rcp.approx.ftz.f32": (np.reciprocal, 2.0**-23),
    "sqrt.approx.ftz.f32": (np.sqrt, 2.0**-23),
    "rsqrt.approx.ftz.f32": (lambda x: 1 / np.sqrt(x), 2.0**-22),
    "lg2.approx.ftz.f32": (np.log2, 2.0**-22),
}


LOADED = {  # a register of each kind from the 64 bits of an operand, and 64 bits from it
    "p": ("cvt.u32.u64 %r2{k}, %rd3{k}; setp.ne.u32 {x}, %r2{k}, 0;", "selp.u32 %r20, 1, 0, {x};"),
    "h": ("cvt.u32.u64 %r2{k}, %rd3{k}; cvt.u16.u32 {x}, %r2{k};", "cvt.u32.u16 %r20, {x};"),
    "r": ("cvt.u32.u64 {x}, %rd3{k};", "mov.u32 %r20, {x};"),
    "rd": ("mov.u64 {x}, %rd3{k};", ""),
}


def registers_of(name):
    """The kinds of registers that an operation takes, first that of its result."""

    def kind(word):
        return "p" if word == "pred" else {"16": "h", "64": "rd"}.get(word[-2:], "r")

    first, *words = name.removesuffix(" of 64").split(".")
    kinds = [kind(words[-1])] * len(opcodes()[name][1])
    if first in ("setp", "cvt"):
        kinds[0] = "p" if first == "setp" else kind(words[-2])
    if name.endswith(" of 64"):
        kinds[1] = "rd"
    if first == "selp":
        kinds[3] = "p"
    if first in ("shl", "shr"):
        kinds[2] = "r"
    if words[0] == "wide":
        kinds[::3] = ["rd"] * len(kinds[::3])
    return kinds


def body_of(name):
    """A kernel's body, in which each thread computes an operation on its row of operands."""
    kinds = registers_of(name)
    used = [f"%{kind}1{k}" for k, kind in enumerate(kinds)]
    loads = "".join(
        f"ld.global.u64 %rd3{k}, [%rd6+{8 * k}]; {LOADED[kind][0].format(k=k, x=x)}\n"
        for k, (kind, x) in enumerate(zip(kinds, used))
        if k
    )
    result = used[0] if kinds[0] == "rd" else "%rd39"
    widen = LOADED[kinds[0]][1].format(x=used[0]) + "cvt.u64.u32 %rd39, %r20;"
    return f"""mad.lo.s32 %r5, %r9, 256, %r1; mul.wide.u32 %rd5, %r5, 32; add.s64 %rd6, %rd1, %rd5;
    {loads} {name.removesuffix(" of 64")} {", ".join(used)}; {widen if result == "%rd39" else ""}
    st.global.u64 [%rd6], {result};"""


def computed(name, operands, **options):
    """The results, as bits, of an operation on rows of operands."""
    memory = torch.from_numpy(operands.copy())
    made = run(body_of(name), memory, 256, len(operands) // 256, **options)
    assert not made.findings, made.findings
    return memory.numpy()[:, 0].view(np.uint64)


def operands_of(name):
    values = WORDS + LONG if "Q" in opcodes()[name][1][1:] else WORDS
    values = DOUBLES if name.endswith("f64") else values
    rows = np.zeros((1280, 4), np.int64)
    pairs = [(a, b) for a in values for b in values]
    rng = np.random.default_rng(0)
    third = rng.choice(np.array(values, np.uint64), len(pairs))
    drawn = rng.integers(0, 2**63, (1280 - len(pairs), 3), np.uint64) >> np.uint64(31)
    filled = np.concatenate([np.column_stack([np.array(pairs, np.uint64), third]), drawn])
    rows[:, 1:] = filled.view(np.int64)
    # as registers hold them
    kinds = name.removesuffix(" of 64").split(".")
    if kinds[-1] == "pred":
        rows &= 1
    if kinds[-1][1:] == "16":
        rows &= 0xFFFF
    if kinds[0] == "selp":
        rows[:, 3] &= 1
    return rows


@np.errstate(all="ignore")
def test_operations():
    """Each that computes; what only contract.py writes has no name in PTX."""
    for name in operations():
        if name not in APPROXIMATE:
            check_operation(name)


def operations():
    others = re.compile(r"atom|bar|vote|redux|match|shfl|.* (\*|of 2$|to 2)")
    named = (name for name, (_, operands, _) in opcodes().items() if len(operands) > 1)
    return [name for name in named if not others.match(name)]


def test_operations_are_ptx(tmp_path):
    """Assembled, as a GPU's driver does it: what is compared there is the ISA's, not only ours."""
    ptxas = cuda_tool("ptxas")
    if ptxas is None:
        pytest.skip("no ptxas")
    names = enumerate(operations())
    entries = (ENTRY.replace(" k(", f" k{i}(").format(body_of(name)) for i, name in names)
    path = tmp_path / "k.ptx"
    path.write_text("\n".join([HEAD, *entries]))
    done = ran(ptxas, "--gpu-name=sm_90", "-O0", path, "-o", tmp_path / "k.cubin")
    assert done.returncode == 0, done.stderr


@pytest.mark.gpu
def test_operations_on_a_gpu():
    """Bit for bit as the interpreter, but the approximate units, which stay within their bounds."""
    driver = ctypes.CDLL("libcuda.so.1")

    def do(name, *arguments):
        code = getattr(driver, name)(*arguments)
        assert code == 0, f"{name}: {code}"

    differing = []
    for name in operations():
        rows = operands_of(name)
        memory = torch.from_numpy(rows.copy()).cuda()
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        do("cuModuleLoadData", ctypes.byref(module), (HEAD + ENTRY.format(body_of(name))).encode())
        do("cuModuleGetFunction", ctypes.byref(function), module, b"k")
        address = ctypes.c_uint64(memory.data_ptr())
        params = (ctypes.c_void_p * 1)(ctypes.addressof(address))
        torch.cuda.synchronize()
        do("cuLaunchKernel", function, len(rows) // 256, 1, 1, 256, 1, 1, 0, None, params, None)
        torch.cuda.synchronize()
        got, want = memory.cpu().numpy()[:, 0].view(np.uint64), computed(name, rows)
        same = got == want
        first, *words = name.split(".")
        if words[-2 if first == "cvt" else -1] == "f32" and first != "setp":
            x, y = (v.astype(np.uint32).view(np.float32) for v in (got, want))
            same |= np.isnan(x) & np.isnan(y)
            if name in APPROXIMATE:
                same |= np.abs(x - y) <= (APPROXIMATE[name][1] + 2.0**-24) * np.abs(y)
        differing += [(name, rows[i, 1:], hex(got[i]), hex(want[i])) for i in (~same).nonzero()[0]]
    assert not differing, differing[:20]


def check_operation(name):
    rows, widths = operands_of(name), opcodes()[name][1]
    got = computed(name, rows)
    flush = flushed if ".ftz" in name else lambda x: x
    name = name.replace(".ftz", "")
    first, *words = name.split(".")
    kind = words[-1]
    table = FLOATS if kind in ("f32", "f64") else INTEGERS
    stem = ".".join([first, *words[:-1]])
    plain = re.sub(r"\.(rn|f32)$", "", stem)
    function = CONVERSIONS.get(name) or table.get(stem) or table.get(plain)
    result, source = kind, kind.removesuffix(" of 64")
    if first == "setp":
        result = "pred"
    elif first in ("cvt", "cvta"):
        result, source = words[-2], source
        if name not in CONVERSIONS and (kind != "f32" or result != "f32"):
            function = (lambda a: nearest(Fraction(a))) if result == "f32" else lambda a: a
        if first == "cvta" or result not in ("f32", "f64", "u16", "bf16", "f16"):
            result = "u64" if first == "cvta" else result
    assert function is not None, f"{name} has no oracle"
    if stem in ("mul.wide", "mad.wide"):
        result = kind[0] + "64"
    for row, bits in zip(rows.view(np.uint64).tolist(), got.tolist()):
        given = [flush(number(x, source)) for x in row[1 : len(widths)]]
        if first in ("shl", "shr"):
            given[1] = row[2] & 0xFFFFFFFF
        if stem == "mad.wide":
            given[2] = number(row[3], result)
        if first == "selp":
            given[2] = row[3]
        want = function(*given)
        if result in ("f32", "f64"):
            value, want = number(bits, result), flush(FLOAT[result](want))
            same = np.isnan(value) and np.isnan(want) or value.tobytes() == want.tobytes()
        elif result in ("bf16", "f16") and np.isnan(given[0]):
            same = bits == 0x7FFF
        else:
            size = {"pred": 1, "bf16": 16, "f16": 16}.get(result) or int(result[1:])
            same = bits == int(want) & ((1 << size) - 1)
        assert same, (name, given, hex(bits), want)


@pytest.mark.parametrize("name", APPROXIMATE)
@np.errstate(all="ignore")
def test_approximate_units(name):
    function, bound = APPROXIMATE[name]
    rows = operands_of(name)
    x = rows[:, 1].astype(np.uint32).view(np.float32).astype(np.float64)
    x[np.abs(x) < 2.0**-126] *= 0
    want = function(x)
    normal = np.isfinite(want) & (np.abs(want) >= 2.0**-126) & (np.abs(want) < 2.0**127)
    for approximate in (0, 1, 2):
        got = computed(name, rows, approximate=approximate)
        got = got.astype(np.uint32).view(np.float32).astype(np.float64)
        error = ((got - want) / want)[normal]
        slack = 2.0**-24  # the result is rounded once more
        assert np.abs(error).max() <= (bound if approximate else 0) + slack
        assert approximate != 1 or (error <= slack - 0.4 * bound)[x[normal] != 0].all()
        assert (got == want)[x == 0].all()  # by the ISA's tables; tokens past the end rely on it
        assert not got[np.abs(want) < 2.0**-127].any()
        assert (np.isnan(got) == np.isnan(want)).all()


# What the 32 lanes of a warp ask for: bytes of global memory, sectors, those touched first, passes,
# conflicts, and passes if all lanes were served together.
ASKED = {
    "ld.global.u32 %r7, [%rd4];": (128, 4, 4, 0, 0, 0),
    "ld.global.u32 %r7, [%rd4]; ld.global.u32 %r8, [%rd4];": (256, 8, 4, 0, 0, 0),
    "ld.global.u32 %r7, [%rd1];": (128, 1, 1, 0, 0, 0),
    "shl.b32 %r5, %r1, 5; cvt.u64.u32 %rd5, %r5; add.s64 %rd5, %rd1, %rd5;"
    "ld.global.v4.u32 {%r5, %r6, %r7, %r8}, [%rd5];": (512, 32, 32, 0, 0, 0),
    "st.shared.u32 [%r4], %r1;": (0, 0, 0, 1, 0, 1),
    "st.shared.u32 [%r3], 5;": (0, 0, 0, 1, 0, 1),
    "add.s32 %r5, %r4, %r2; st.shared.u32 [%r5], %r1;": (0, 0, 0, 2, 1, 2),
    "shl.b32 %r5, %r1, 7; and.b32 %r5, %r5, 1023; add.s32 %r5, %r5, %r3;"
    "ld.shared.u32 %r7, [%r5];": (0, 0, 0, 8, 7, 8),
    "add.s32 %r5, %r4, %r2; st.shared.v2.u32 [%r5], {%r1, %r1};": (0, 0, 0, 2, 0, 2),
    "mad.lo.s32 %r5, %r1, 16, %r3; st.shared.v4.b32 [%r5], {0, 1, 2, 3};": (0, 0, 0, 4, 0, 4),
    "mad.lo.s32 %r5, %r1, 16, %r3; st.shared.v2.u32 [%r5], {%r1, %r1};": (0, 0, 0, 4, 2, 4),
    "setp.lt.u32 %p1, %r1, 9; @%p1 st.shared.u32 [%r4], %r1;": (0, 0, 0, 1, 0, 1),
    "mov.u64 %rd9, own; st.local.u32 [%rd9], %r1;": (0, 4, 0, 0, 0, 0),
    "mov.u64 %rd9, own; cvta.local.u64 %rd9, %rd9; st.u64 [%rd9], %rd1;": (0, 8, 0, 0, 0, 0),
    "atom.global.add.u32 %r5, [%rd1], 1;": (128, 1, 1, 0, 0, 0),
    "ld.shared.v4.u32 {%r5, %r6, %r7, %r8}, [%r3];": (0, 0, 0, 4, 0, 1),
}


@pytest.mark.parametrize("body", ASKED)
def test_what_is_asked_of_memory(body):
    memory = torch.zeros(32 * 8, dtype=torch.int32)
    made = run(".local .align 8 .b8 own[8];" + body, memory, threads=32, counting=True)
    program, _ = made.executed["k"]
    asked = [
        dict(zip([name for name, _ in Count._fields_], row))
        for i, row in zip(program.code, made.counts["k"])
        if units()[i.op] in ("load", "store", "atomic") and SPACES[i.space] != "param"
    ]
    names = ("bytes", "sectors", "first", "passes", "conflicts", "together")
    assert tuple(sum(row[name] for row in asked) for name in names) == ASKED[body]


def test_lanes_that_part():
    memory = torch.zeros(64, dtype=torch.int32)
    body = ODD + "@%p1 bra $A; mov.u32 %r8, 0; mov.u32 %r8, 1; $A: st.global.u32 [%rd4], %r1;"
    made = run(body, memory, counting=True)
    program, executed = made.executed["k"]
    lanes, splits = (made.counts["k"][:, k] for k in (0, 1))
    (branch,) = (at for at, text in enumerate(program.text) if "bra" in text)
    assert splits.sum() == splits[branch] == 2, "of two warps"
    assert [*lanes[branch : branch + 4]] == [64, 32, 32, 64] and executed[branch + 3] == 2
    assert not run(body, memory).counts
