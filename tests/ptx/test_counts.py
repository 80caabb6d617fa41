"""Counts of what the kernels execute: those that are kept are those of the kernels."""

import json

import pytest

from . import counts
from .machine import library

DOCUMENT = json.loads(counts.PAGE.with_suffix(".json").read_text())
KERNELS = {(row["kernel"], row["case"], row["per"][:4]): row for row in DOCUMENT["kernels"]}


@pytest.mark.parametrize("case", [("conv", "bfloat16"), ("raster", "harmonics of degree 3")])
def test_the_counts_are_of_these_kernels(case):
    """Made again by ``python -m ptx.counts``."""
    library()
    if DOCUMENT["versions"] != counts.versions():
        pytest.skip("another compiler made what was counted")
    kept = [row for row in DOCUMENT["kernels"] if (row["op"], row["case"]) == case]
    assert [*counts.rows_of(*case, set())] == kept


def test_known_counts():
    """Exponentials, products and bytes are those that the sources state."""
    names = ("scan_forward", "scan_backward")
    forward, back = (KERNELS[name, "bfloat16", "(b, "]["each"] for name in names)
    # a state's decay; softplus and gate are of 16 states
    assert forward["special"] == 1 + 4 / 16
    # states recomputed but for the last 4 of 64 tokens, and the gradient; softplus, its slope, gate
    assert back["special"] == 1 + 15 / 16 + 6 / 16
    # u, delta, z, out and 1/64 of the states, in sectors: a warp has 32 channels of 2 bytes
    tensors = 4 * 2 / 32 + 16 * 4 / 64 / 32
    assert tensors / 16 * 32 < forward["first"] < 1.25 * tensors / 16 * 32
    conv = KERNELS["conv_forward", "float32", "(b, "]["each"]
    # four taps and a bias, and SiLU's two
    assert conv["float"] == 7 and conv["special"] == 2 and conv["first"] == pytest.approx(8, 0.01)
    for row in KERNELS.values():
        each = row["each"]
        assert each["together"] <= each["passes"] and each["conflicts"] < each["passes"]
        assert 0 < each["first"] <= each["sectors"]


def test_bounds():
    """A tenth above the counts when this was written."""
    for kernel, case, per, kind, most in (
        ("scan_forward", "bfloat16", "(b, ", "all", 15.1),
        ("scan_backward", "bfloat16", "(b, ", "all", 33.6),
        ("scan_backward", "bfloat16", "(b, ", "passes", 8.3),
        ("conv_forward", "bfloat16", "(b, ", "all", 20.9),
        ("conv_backward", "bfloat16", "(b, ", "all", 43.8),
        ("composite", "whole tiles", "pair", "all", 164.0),
        ("composite_vjp", "whole tiles", "pair", "all", 215.0),
    ):
        found = KERNELS[kernel, case, per]["each"][kind]
        assert 0.5 * most < found <= most, (kernel, kind)


def test_ratios_to_others():
    """No kernel executes more instructions; a tenth above the ratios when this was written."""
    close = [(case, "forward") for case in ("projection", "tile lists", "1 x 2,048, bfloat16")]
    most = {"scan": 0.77, "convolution": 0.96, "rasterizer": 0.58}
    for row in DOCUMENT["peers"]["rows"]:
        ratio = row["ours"]["instructions"] / row["theirs"]["instructions"]
        limit = 1.0 if (row["case"], row["direction"]) in close else most[row["op"]]
        assert 0 < ratio <= limit, row
