"""Counts from a disassembly, the loops in it, and the times estimated from them."""

import json
from pathlib import Path

import pytest
from lab.instructions import sass
from lab.instructions.estimate import (
    DEVICES,
    Device,
    Shape,
    Work,
    cycles,
    estimate,
    per_element,
    scan_work,
)
from lab.instructions.page import markdown

from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

DOCS = Path(__file__).resolve().parents[3] / "docs" / "lab" / "benchmarks"

# Two loops, one in the other; a cold part that comes after the end and jumps back; another kernel.
TEXT = """
	.section	.text.mine,"ax",@progbits
.text.mine:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_2:
        /*0010*/                   LDG.E.U16 R2, desc[UR4][R4.64] ;
        /*0020*/              @!P0 BRA `(.L_x_4) ;
.L_x_3:
        /*0030*/                   LDS.128 R8, [R6+0x10] ;
.L_x_1:
        /*0040*/                   FFMA R0, R8, R9, R0 ;
        /*0050*/                   FMUL R10, R8, -1.4426950216293334961 ;
        /*0060*/                   MUFU.EX2 R11, R10 ;
        /*0070*/               @P1 STS.64 [R6], R2 ;
        /*0080*/              @!P2 BRA `(.L_x_1) ;
        /*0090*/                   BAR.SYNC.DEFER_BLOCKING 0x0 ;
        /*00a0*/               @P3 CALL.REL.NOINC `(.L_x_5) ;
        /*00b0*/                   BRA `(.L_x_2) ;
.L_x_5:
        /*00c0*/                   UIADD3 UR4, UR4, 0x1, URZ ;
        /*00d0*/                   STL [R1+0x8], R3 ;
        /*00e0*/                   EXIT ;
.L_x_4:
        /*00f0*/                   F2FP.BF16.F32.PACK_AB R3, R2, R2 ;
        /*0100*/                   BRA `(.L_x_3) ;
.L_x_6:
        /*0110*/                   BRA `(.L_x_6);
	.section	.text.other,"ax",@progbits
.text.other:
        /*0000*/                   SHFL.BFLY PT, R2, R3, 0x1, 0x1f ;
        /*0010*/                   EXIT ;
"""


@pytest.fixture
def code():
    return sass.parse(TEXT, "mine")


def test_instructions_are_told_apart(code):
    assert len(code) == 18
    kinds = sass.counts(code)
    assert kinds == {
        **{"integer": 1, "global": 1, "jump": 7, "shared": 2, "float": 2, "special": 1},
        **{"barrier": 1, "uniform": 1, "local": 1, "convert": 1},
        "passes": 1 + 4 + 2 + 1,
    }  # fmt: skip
    assert [i.always for i in code].count(False) == 4
    assert sass.counts(sass.parse(TEXT, "other"))["shuffle"] == 1
    with pytest.raises(ValueError, match="no kernel its"):
        sass.parse(TEXT, "its")


def test_loops_are_found(code):
    """The cold part after the end belongs to the outer loop, though its jump back is no loop."""
    (outer,) = sass.find_loops(code)
    assert outer.body == {*range(1, 12), 15, 16} and outer.first == 1
    (inner,) = outer.inside
    assert inner.body == {*range(4, 9)} and not inner.inside
    assert sass.innermost(code) == inner.body


def test_turns_are_those_of_ptx(code):
    """The same loops in PTX, of other instructions: what its loops turn, ours do."""

    def ptx(*jumps):
        found = [sass.Instruction("add", True, None) for _ in range(12)]
        for at, target in jumps:
            found[at] = sass.Instruction("BRA", False, target)
        return found

    once = sass.counts(code)
    nest = ptx((7, 3), (9, 1))
    times = [1, 10, 10, 40, 40, 40, 40, 40, 10, 10, 1, 1]
    total = sass.executed(code, nest, times)
    assert total["special"] == 40 and total["float"] == 80
    assert total["global"] == 10 and total["convert"] == 10
    assert total["uniform"] == once["uniform"] == 1
    assert total["passes"] == 10 * (1 + 4) + 40 * 2 + 1
    assert sass.executed(code, nest, [1] * 12) == once
    half = [1, 10, 10, 40, 40, 20, 20, 40, 10, 10, 1, 1]  # a branch that half of the warps skip
    assert sass.executed(code, nest, half)["special"] == 32
    # a loop that only PTX has, before the others: its turns are of what is around the loops
    more = sass.executed(code, ptx((0, 0), (7, 3), (9, 1)), [7, *times[1:]])
    assert more["special"] == 40 and more["uniform"] == 3


def test_a_self_jump_is_no_turn(code):
    """Padding at the end jumps to itself and is never reached."""
    assert all(17 not in loop.body for loop in sass.find_loops(code))


def test_the_busiest_unit_sets_the_time():
    device = Device("a toy", 10, 1e9, 1e12, 128)
    work = Work(blocks=11, elements=4 * 32 * 50, traffic=2e6)
    counted = {"float": 400, "special": 40, "integer": 100, "multiply": 20, "together": 70}
    counted |= {"sectors": 80, "own": 40, "first": 16, "passes": 90, "bytes": 1000}
    each = per_element({kind: 11 * 4 * number for kind, number in counted.items()}, work)
    assert each["all"] == pytest.approx(560 / 50) and each["passes"] == pytest.approx(90 / 50)
    found = estimate(device, work, each)
    warps = 2 * 4  # the eleventh block is a second one for somebody
    assert found["issue"] == pytest.approx(1e3 * warps * 560 / 4 / 1e9)
    assert found["special"] == pytest.approx(1e3 * warps * 40 * 2 / 1e9)
    assert found["float32"] == pytest.approx(1e3 * warps * (400 / 4 + 20 / 2) / 1e9)
    assert found["integer"] == pytest.approx(1e3 * warps * 100 / 2 / 1e9)
    assert found["L1"] == pytest.approx(1e3 * warps * (70 + 120 / 4) / 1e9)
    assert found["dram"] == pytest.approx(2e-3)
    assert (found["ms"], found["limit"]) == (found["dram"], "dram")
    many = each | {"float": 1e5, "all": 1e5}
    assert estimate(device, work, many)["limit"] == "issue"
    assert estimate(DEVICES[80], work, many)["limit"] == "float32"  # two cycles for a warp
    # of a multiprocessor's share of the memory, 100 bytes per cycle
    assert cycles(device, {"first": 50})["dram"] == pytest.approx(50 * 32 / 100)


def test_the_work_of_the_scan():
    shape = Shape(16, 16961, 1024, 16, 2)
    forward, back = (scan_work(k, shape, Tuning()) for k in ("scan_forward", "scan_backward"))
    tokens = 266 * 64  # whole chunks
    for work in (forward, back):
        assert (work.blocks, work.elements) == (256, tokens * 64 * 16)
    each = 16 * 16961 * 1024
    matrices = 16 * 16961 * 2 * 16
    assert forward.traffic == each * (4 * 2 + 1) + matrices * 2
    assert back.traffic == each * (7 * 2 + 1) + matrices * (2 + 4 * 16)
    cut = Tuning(segments=7, back_segments=5)
    one = scan_work("summarise_backward", Shape(1, 16961, 1024, 16, 2), cut)
    assert (one.blocks, one.elements) == (16 * 4, 54 * 64 * 64 * 16), "the last needs no summary"
    first = scan_work("scan_forward", Shape(1, 16961, 1024, 16, 2), cut)
    assert (first.blocks, first.elements) == (16 * 6, 38 * 64 * 64 * 16)
    assert first.traffic == 16961 * (1024 * 2 * 2 + 16 * 2)
    assert scan_work("carry", shape, cut) is None


def rows(kernel, case):
    document = json.loads((DOCS / "static.json").read_text())
    found = [r for r in document["kernels"] if (r["kernel"], r["case"]) == (kernel, case)]
    return {row["arch"]: row for row in found}


def test_the_scan_is_within_its_budget():
    """Of 16 sequences in bfloat16; the report is made again when the kernels change."""
    forward, back = rows("scan_forward", "bfloat16"), rows("scan_backward", "bfloat16")
    if "estimate" not in forward["sm_90"]:
        pytest.skip("the report was made without a disassembler")
    times = [r["sm_90"]["estimate"]["ms"] for r in (forward, back)]
    assert 0.5 < times[0] <= 1.9 and times[1] <= 4.0
    for found in (forward, back):
        for row in found.values():
            assert row["estimate"]["ms"] >= row["estimate"]["dram"] > 0
            assert row["per_element"]["special"] >= 1  # the exponential
            assert row["reloads"] <= 4  # none but of the place of the marks


def test_a_page_without_counts_says_so():
    document = json.loads((DOCS / "static.json").read_text())
    for row in document["kernels"]:
        row.pop("loop", None), row.pop("estimate", None)
    text = markdown(document)
    assert "No disassembler was found" in text and "Least times" not in text
