"""Counts of what the kernels execute: those that are kept are those of the kernels."""

import json

import pytest
import torch

from . import counts, peer_code
from .counting import Executed, count
from .machine import Missing, library
from .peers import at_full_width


@pytest.fixture(scope="module")
def document():
    return json.loads(counts.PAGE.with_suffix(".json").read_text())


@pytest.fixture(scope="module")
def kernels(document):
    return {(row["kernel"], row["case"], row["per"][:4]): row for row in document["kernels"]}


def test_the_page_is_of_the_counts(document):
    assert counts.PAGE.read_text() == counts.markdown(document)


@pytest.mark.parametrize("case", [("conv", "bfloat16"), ("raster", "harmonics of degree 3")])
def test_the_counts_are_of_these_kernels(document, case):
    """Made again by ``python -m ptx.counts``."""
    try:
        library()
    except Missing as reason:
        pytest.skip(str(reason))
    if document["versions"] != counts.versions():
        pytest.skip("another compiler made what was counted")
    kept = [row for row in document["kernels"] if (row["op"], row["case"]) == case]
    assert [*counts.rows_of(*case, set())] == kept


def test_known_counts(kernels):
    """Exponentials, products and bytes are those that the sources state."""
    forward, back = (
        kernels[k, "bfloat16", "(b, "]["each"] for k in ("scan_forward", "scan_backward")
    )
    # a state's decay; softplus and gate are of 16 states
    assert forward["special"] == 1 + 4 / 16
    # marks but before the last of 16 groups of tokens, and the walk; softplus, its slope, the gate
    assert back["special"] == 1 + 15 / 16 + 6 / 16
    # u, delta, z, out and 1/64 of the states, in sectors: a warp has 32 channels of 2 bytes
    tensors = 4 * 2 / 32 + 16 * 4 / 64 / 32
    assert tensors / 16 * 32 < forward["first"] < 1.25 * tensors / 16 * 32
    conv = kernels["conv_forward", "float32", "(b, "]["each"]
    # four taps and a bias, and SiLU's two
    assert conv["float"] == 7 and conv["special"] == 2 and conv["first"] == pytest.approx(8, 0.01)
    for row in kernels.values():
        each = row["each"]
        assert each["together"] <= each["passes"] and each["conflicts"] < each["passes"]
        assert 0 < each["first"] <= each["sectors"]


def test_bounds(kernels):
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
        found = kernels[kernel, case, per]["each"][kind]
        assert 0.5 * most < found <= most, (kernel, kind)


def test_what_is_not_executed_is_not_counted():
    found = count(lambda: [], (), 1)
    assert found == {"forward": {}}


def test_ratios_to_others(document):
    """No kernel executes more instructions; a tenth above the ratios when this was written."""
    close = [(case, "forward") for case in ("projection", "tile lists", "1 x 2,048, bfloat16")]
    most = {"scan": 0.77, "convolution": 0.96, "rasterizer": 0.58}
    for row in document["peers"]["rows"]:
        ratio = row["ours"]["instructions"] / row["theirs"]["instructions"]
        limit = 1.0 if (row["case"], row["direction"]) in close else most[row["op"]]
        assert 0 < ratio <= limit, row


HEADER = """struct Base {
    using index_t = uint64_t;
    int batch, dim;  // sizes
    bool even;
    index_t x_batch_stride;
    void *__restrict__ x_ptr;
};
struct More: public Base {
    index_t y_l_stride;
    void * y_ptr;
};"""


def test_parameters_of_a_kernel():
    """Fields lie as a C++ compiler lays them; strides go by the names of axes."""
    x = torch.zeros(3, 5)
    kind = peer_code.structure(HEADER, "More")
    made = kind.from_buffer_copy(
        peer_code.filled(kind, {"x": (x, "batch l"), "y": (x.mT, "l batch")}, dim=7, even=True)
    )
    assert (made.batch, made.dim, made.even) == (0, 7, True)
    assert (made.x_batch_stride, made.y_l_stride) == (5, 1)
    assert made.x_ptr == made.y_ptr == x.data_ptr()
    offsets = [
        getattr(kind, name).offset for name in ("dim", "even", "x_ptr", "y_l_stride", "y_ptr")
    ]
    assert offsets == [4, 8, 24, 32, 40]


def test_all_channels_from_two_runs():
    """Count once for each sequence what channels share."""

    def run(channels):
        counts = {"first": 100 + 3 * channels, "float": 2 * channels}
        return {"forward": [Executed("k", counts)]}

    ((whole,),) = at_full_width(run, 4, 16).values()
    assert whole.counts == {"first": 16 * (100 + 3 * 1024), "float": 16 * 2 * 1024}


def test_without_an_index(monkeypatch, tmp_path):
    """One line says that others' kernels cannot be had."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    try:
        library()
        with pytest.raises(Missing, match="pip: .*nvidia-cuda-nvcc|headers are needed"):
            peer_code.Peers(tmp_path / "peers")
    except Missing as reason:
        pytest.skip(str(reason))
