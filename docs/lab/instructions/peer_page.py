"""Page of the comparison with other libraries, and of estimates beside measured times."""

from __future__ import annotations

from gamba_warp.kernels.runtime import tables

from .estimate import SCHEDULERS, SECTOR, Device
from .peers import CHANNELS, H200, STATES, WIDTH

# Medians on an H200 from docs/gpu.md, milliseconds: forward, and with the gradient.
MEASURED = {
    "16 x 16,961, bfloat16": {"ours": (2.66, 12.2), "theirs": (9.61, 43.4)},
    "1 x 16,961, bfloat16": {"ours": (0.53, 2.23), "theirs": (0.75, 3.27)},
    "16 x 16,961, bfloat16, theirs channels last": {"ours": (0.32, 0.90), "theirs": (0.38, None)},
}
# Times by others with device, shape and type: causal-conv1d's gradient, of 4 sequences of 4,128
# channels, bfloat16, tokens last, by the number of tokens, milliseconds (its pull request 88). An
# RTX PRO 6000 has 188 multiprocessors, 2.6 GHz and 1.79 TB/s by its data sheet.
PUBLISHED, PUBLISHED_CHANNELS = {2048: 0.120, 4096: 0.275, 16384: 1.085}, 4 * 4128
PUBLISHED_CASE = "16 x 2,048, bfloat16, theirs tokens last"
RTX = Device("RTX PRO 6000", 188, 2.6e9, 1.792e12, 128)

_TEXT = """## Compared with other libraries
Written by `make instructions PEERS=1`: the sources of {packages} were
compiled by nvcc {nvcc}, with the flags of their setup.py (but C++20) and the template arguments
that their host code chooses, and executed in the same interpreter on the same inputs; their results
agree with ours. The scan and the convolution have {channels:,} channels, the scan {states} states,
softplus and gate, the convolution {width} weights and SiLU; the rasterizer draws the view of above.

**Ratios, ours to theirs: below 1 is less.** **least** is the time of an H200 if its busiest unit
works in every cycle, in milliseconds. Products are contracted with sums, and moves left out, in
theirs as in ours. A library sorts for the lists, which is not executed: the row has the bytes that
its passes of 8 bits move, six of them over gsplat's pairs, two over ours and four over Gaussians.
Ours add the rows of gradients in a fixed order, theirs with atomics.
torch's own operations before and after a kernel are counted in neither: zeros, sums of parts, the
directions of gsplat's harmonics.

"""
_CALIBRATION = """
### Estimates beside measured times
Times on an H200 ([gpu.md](../../gpu.md)) and times that others published with device, shape and
type, over the estimates (causal-conv1d's pull request 88; none was found for the other kernels).
The scan takes {scan} times its estimate, the convolution {convolution} times. The times of one
sequence include what the host does for a call; ours are of the kernels of 26 November 2026, since
when the gradient of the scan executes fewer instructions.

"""


def markdown(document: dict) -> str:
    """Section of a page, of the document of ``compare``."""
    versions = dict(document["versions"])
    nvcc = versions.pop("nvcc")
    packages = ", ".join(f"{name} {version}" for name, version in versions.items())
    found = _TEXT.format(
        packages=packages, nvcc=nvcc, channels=CHANNELS, states=STATES, width=WIDTH
    )
    table = []
    for row in document["rows"]:
        ours, theirs = row["ours"], row["theirs"]
        ratios = [f"{ours[x] / theirs[x]:.2f}" if theirs[x] else "" for x in ours]
        times = [f"{both['ms']:.3g}" for both in (ours, theirs)]
        table.append([row["op"], row["case"], row["direction"], *ratios, *times])
    header = ["operator", "case", "direction", "instructions", "sectors", "first", "least"]
    found += tables.markdown([*header, "ours", "theirs"], table) + "\n"
    timed: list[tuple] = []
    for case, of in MEASURED.items():
        rows = [row for row in document["rows"] if row["case"] == case]
        for whose, measured in of.items():
            estimate = 0.0
            for row, direction, time in zip(rows, ("forward", "with gradients"), measured):
                estimate += row[whose]["ms"]
                if time is not None:
                    timed.append((row["op"], case, direction, whose, H200.name, time, estimate))
    (back,) = (
        row["theirs"]
        for row in document["rows"]
        if (row["case"], row["direction"]) == (PUBLISHED_CASE, "gradient")
    )
    for length, time in PUBLISHED.items():
        more = length * PUBLISHED_CHANNELS / (16 * 2048 * CHANNELS)
        issue = back["instructions"] / (SCHEDULERS * RTX.multiprocessors * RTX.clock)
        estimate = 1e3 * more * max(back["first"] * SECTOR / RTX.bandwidth, issue)
        case = f"4 x {length:,}, bfloat16, 4,128 channels, tokens last"
        timed.append(("convolution", case, "gradient", "theirs", RTX.name, time, estimate))
    factors: dict[str, list[float]] = {}
    for op, *_, time, estimate in timed:
        factors.setdefault(op, []).append(time / estimate)
    spans = {op: f"{min(x):.1f} to {max(x):.1f}" for op, x in factors.items()}
    table = [
        [*names, f"{time:.3g}", f"{estimate:.3g}", f"{time / estimate:.1f}"]
        for *names, time, estimate in timed
    ]
    header = ["operator", "case", "direction", "whose", "device", "measured, ms", "estimate, ms"]
    found += _CALIBRATION.format(**spans)
    return found + tables.markdown([*header, "factor"], table) + "\n"
