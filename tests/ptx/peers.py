"""Instruction counts of other libraries' kernels and of ours for the same work."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

from gamba_warp.kernels.cases.raster import LEAVES, orbit_cameras, shell
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.harmonics import sums_seen_from
from gamba_warp.kernels.runtime import tables
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda

from . import counting
from .counting import CHANNELS, GAUSSIANS, SIDE, STATES, WIDTH, Counts, Executed
from .dry_run import MULTIPROCESSORS
from .launch import Interpreter
from .peer_code import PACKAGES, Peers, filled, launch, packed, structure

TILE = 16
TYPES = {torch.float32: "float", torch.bfloat16: "at::BFloat16"}
# By direction, kernels that are launched one after the other.
Kernels = dict[str, list[Executed]]


def listed(counted: Counts) -> Kernels:
    """Return the kernels of ``counting.count``, in the order of their launches."""
    return {direction: [*kernels.values()] for direction, kernels in counted.items()}


def at_full_width(run: Callable[[int], Kernels], channels: int, batch: int) -> Kernels:
    """Return the counts for all channels and sequences, from two runs of one sequence.

    What the channels share, such as B and C, is touched first by one of them only; so the second
    run has twice the channels, and the difference is what more of them add.

    Args:
        run: gives the counts for a number of channels.
        channels: of the first run.
        batch: number of sequences.
    """
    one, two, more = run(channels), run(2 * channels), CHANNELS / channels - 1

    def both(a: Executed, b: Executed) -> Executed:
        less = {name: a.counts.get(name, 0) for name in b.counts}
        counts = {k: batch * (less[k] + more * (x - less[k])) for k, x in b.counts.items()}
        return b._replace(counts=counts)

    return {
        direction: [both(a, b) for a, b in zip(one[direction], two[direction], strict=True)]
        for direction in one
    }


def agree(what: str, ours: Sequence[Tensor], theirs: Sequence[Tensor], limit: float) -> None:
    """Raise a ``ValueError`` unless two kernels computed the same, by relative rms errors."""
    for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        error = (a.double() - b.double()).norm() / a.double().norm()
        if not error <= limit:
            raise ValueError(f"{what}: result {k} differs by {error:.1e}")


# --- the scan


def our_scan(length: int, batch: int, dtype: torch.dtype, channels: int) -> Kernels:
    """Count one sequence, by the kernels that are chosen for ``batch`` of all channels."""
    inputs = counting.scan_inputs(length, channels, dtype)
    run = partial(selective_scan, **inputs, delta_softplus=True)
    with patch.object(scan_cuda, "FORCED", counting.scan_tuning(batch, length)):
        return listed(counting.count(lambda: [run()], inputs.values(), MULTIPROCESSORS))


@functools.cache
def mamba_scan(peers: Peers, length: int, dtype: torch.dtype, channels: int) -> Kernels:
    """Count one sequence by mamba-ssm, with its host code's traits for over 1,024 tokens."""
    folder = peers.source("mamba-ssm") / "csrc" / "selective_scan"
    header = (folder / "selective_scan.h").read_text()
    even = str(length % 2048 == 0).lower()
    text = """#include "selective_scan_{0}_kernel.cuh"
using T = Selective_Scan_{0}_kernel_traits<128, 16, {1}{2}, true, true, true{3}, {4}, float>;
template __global__ void selective_scan_{0}_kernel<T>({5});
"""
    of_state = "MAX_DSTATE * sizeof(T::scan_t)"
    forward = peers.compile(
        "mamba-ssm",
        text.format("fwd", "1, ", even, "", TYPES[dtype], "SSMParamsBase"),
        f"T::kSmemSize + {of_state}",
    )
    backward = peers.compile(
        "mamba-ssm",
        text.format("bwd", "", even, ", true", TYPES[dtype], "SSMParamsBwd"),
        f"T::kSmemSize + {of_state} + (128 + 4 * MAX_DSTATE) * sizeof(float)",
    )
    inputs = counting.scan_inputs(length, channels, dtype)
    y = selective_scan(**inputs, delta_softplus=True)
    dy = torch.randn(y.shape).to(dtype)
    wanted = torch.autograd.grad(y, [*inputs.values()], dy)
    x = {name: value.detach() for name, value in inputs.items()}
    for name in ("u", "delta", "z"):
        x[name] = x[name].mT.contiguous()
    for name in ("B", "C"):
        x[name] = x[name].mT.contiguous()[:, None]
    chunks = -(-length // 2048)
    x |= {"out": torch.empty_like(x["u"]), "out_z": torch.empty_like(x["u"])}
    x["x"] = torch.empty(1, channels, chunks, 2 * STATES)
    axes = dict.fromkeys(x, "batch d l") | {"A": "d dstate", "x": "", "D": "", "delta_bias": ""}
    axes |= dict.fromkeys(("B", "C", "dB", "dC"), "batch group dstate l")
    sizes = dict(batch=1, dim=channels, seqlen=length, dstate=STATES, n_groups=1, n_chunks=chunks)
    sizes |= dict(dim_ngroups_ratio=channels, is_variable_B=True, is_variable_C=True)
    sizes["delta_softplus"] = True

    def run(compiled, kind: str) -> list[Executed]:
        machine = Interpreter(counting=True)
        tensors = {name: (value, axes[name]) for name, value in x.items()}
        params = [filled(structure(header, kind), tensors, **sizes)]
        launch(machine, compiled, params, [*x.values()], (128, 1, 1), (1, channels, 1))
        return [*counting.executed(machine).values()]

    found = {"forward": run(forward, "SSMParamsBase")}
    limit = 1e-4 if dtype == torch.float32 else 1e-2
    agree("mamba-ssm, forward", [y.detach()], [x["out_z"].mT], limit)
    del x["out_z"]
    x["dout"] = dy.mT.contiguous()
    for name in inputs:
        x[f"d{name}"] = torch.zeros_like(
            x[name], dtype=None if name in "u delta z" else torch.float32
        )
        axes[f"d{name}"] = axes[name]
    axes["dout"] = axes["u"]
    found["gradient"] = run(backward, "SSMParamsBwd")
    theirs = [x[f"d{name}"] for name in inputs]
    theirs = [
        g.mT if n in "u delta z" else g[:, 0].mT if n in "BC" else g for n, g in zip(inputs, theirs)
    ]
    agree("mamba-ssm, gradient", wanted, theirs, 10 * limit)
    return found


# --- the convolution


def our_conv(length: int, dtype: torch.dtype, channels: int) -> Kernels:
    """Count one sequence, with bias and SiLU."""
    inputs = counting.conv_inputs(length, channels, dtype)
    run = partial(causal_conv1d, *inputs, activation="silu")
    return listed(counting.count(lambda: [run()], inputs, MULTIPROCESSORS))


def their_conv(peers: Peers, length: int, dtype: torch.dtype, last: bool, channels: int) -> Kernels:
    """Count one sequence by causal-conv1d, channels last or tokens last."""
    folder = peers.source("causal-conv1d") / "csrc"
    header = (folder / "causal_conv1d.h").read_text()
    vector, elements = 16 // dtype.itemsize, 128 // dtype.itemsize
    name = "causal_conv1d_channellast" if last else "causal_conv1d"
    chunks = (64, 128 if length > 128 else 64)  # forward, gradient

    def compiled(direction: str, more: str, kernel_more: str, chunk: int, kind: str):
        text = (folder / f"causal_conv1d_{direction}.cu").read_text()
        text = re.sub(r"^template void .*;$", "", text, flags=re.M)
        of_chunk = f"{chunk}, " if last else ""
        even = str(last or length % vector == 0).lower()
        text += f"""
using T = {name.capitalize()}_{direction}_kernel_traits<
    128, {WIDTH}, {of_chunk}{more}{even}, {TYPES[dtype]}, float>;
template __global__ void {name}_{direction}_kernel<T{kernel_more}>({kind});
"""
        return peers.compile("causal-conv1d", text, "0" if last else "T::kSmemSize")

    forward = compiled("fwd", "", ", false" if last else "", chunks[0], "ConvParamsBase")
    more = ", false, false, false" if last else ", false"
    backward = compiled("bwd", "true, ", more, chunks[1], "ConvParamsBwd")
    leaves = counting.conv_inputs(length, channels, dtype)
    y = causal_conv1d(*leaves, activation="silu")
    dy = torch.randn(y.shape).to(dtype)
    wanted = torch.autograd.grad(y, leaves, dy)

    def laid_out(value: Tensor) -> Tensor:
        return value.detach().clone().mT if last else value.detach().mT.contiguous()

    x = {"x": laid_out(leaves[0]), "weight": leaves[1].detach(), "bias": leaves[2].detach()}
    x["out"] = laid_out(torch.empty_like(y))
    axes = {name: "batch c l" for name in ("x", "out", "dout", "dx")}
    axes |= {name: "c width" for name in ("weight", "dweight", "bias", "dbias")}
    sizes = dict(batch=1, dim=channels, seqlen=length, width=WIDTH, silu_activation=True)

    def run(program, kind: str, chunk: int) -> list[Executed]:
        machine = Interpreter(counting=True)
        params = [filled(structure(header, kind), {k: (v, axes[k]) for k, v in x.items()}, **sizes)]
        blocks = (1, -(-length // chunk), -(-channels // elements)) if last else (1, channels, 1)
        launch(machine, program, params, [*x.values()], (128, 1, 1), blocks)
        return [*counting.executed(machine).values()]

    found = {"forward": run(forward, "ConvParamsBase", chunks[0])}
    limit = 1e-4 if dtype == torch.float32 else 1e-2
    agree("causal-conv1d, forward", [y.detach()], [x["out"].mT], limit)
    x |= {"dout": laid_out(dy), "dx": laid_out(torch.empty_like(y))}
    x |= {"dweight": torch.zeros(channels, WIDTH), "dbias": torch.zeros(channels)}
    found["gradient"] = run(backward, "ConvParamsBwd", chunks[1])
    agree("causal-conv1d, gradient", wanted, [x["dx"].mT, x["dweight"], x["dbias"]], limit)
    return found


# --- the rasterizer

# Our kernels that do what each of theirs does. Both sort by a library.
STAGES = {
    ("projection", "forward"): ("project",),
    ("tile lists", "forward"): ("count", "emit", "in_tile_order"),
    ("projection", "gradient"): ("project_vjp",),
    ("drawing", "forward"): ("record", "composite", "composite_unlisted"),
    ("drawing", "gradient"): ("composite_vjp", "composite_vjp_unlisted", "add_rows"),
}


def our_picture(
    leaves: dict[str, Tensor], cameras: dict, multiprocessors: int
) -> dict[str, Kernels]:
    """Count one view, stage by stage; on few multiprocessors by whole tiles."""
    run = partial(rasterization, **leaves, **cameras)
    counted = counting.count(lambda: run()[:2], leaves.values(), multiprocessors)
    found: dict[str, Kernels] = {}
    for (stage, direction), names in STAGES.items():
        kernels = counted[direction].values()
        found.setdefault(stage, {})[direction] = [x for x in kernels if x.name in names]
    return found


def gsplat_lists(
    peers: Peers, projected: Sequence[Tensor]
) -> tuple[list[Executed], tuple[Tensor, Tensor]]:
    """Count gsplat's kernels of tile lists; tiles' first pairs and the pairs' Gaussians.

    Args:
        peers: the sources.
        projected: means, radii and depths, as gsplat has them.
    """
    side = SIDE // TILE
    bits = (side * side).bit_length()
    common = [0, 1, GAUSSIANS, 0, None, None, *projected]
    sizes = [TILE, side, side, bits, 1]

    def run(entry: str, values: Sequence, number: int = GAUSSIANS) -> list[Executed]:
        blocks = (256, 1, 1), (-(-number // 256), 1, 1)
        return gsplat_kernel(peers, "IntersectTile", f"intersect_{entry}", values, blocks)

    counts = torch.empty(GAUSSIANS, dtype=torch.int32)
    counted = run("tile", [*common, None, *sizes, counts, None, None])
    ends = counts.cumsum(0)
    keys = torch.empty(int(ends[-1]), dtype=torch.int64)
    ids, begins = keys.new_empty(len(keys), dtype=torch.int32), counts.new_empty(1, side, side)
    written = run("tile", [*common, ends, *sizes, None, keys, ids])
    keys, order = keys.sort(stable=True)
    found = run("offset", [len(keys), keys, 1, side * side, bits, begins], len(keys))
    return [*counted, *written, *found], (begins, ids[order])


def gsplat_kernel(
    peers: Peers,
    file: str,
    entry: str,
    values: Sequence[Tensor | float | int | None],
    sizes: tuple[tuple[int, ...], tuple[int, ...]],
    shared: int = 0,
) -> list[Executed]:
    """Count a kernel of gsplat, for 3 channels and float32.

    Args:
        peers: the sources.
        file: of its source.
        entry: the beginning of its name.
        values: its parameters.
        sizes: threads of a block and blocks, three of each.
        shared: bytes of shared memory.
    """
    text = (peers.source("gsplat") / "gsplat" / "cuda" / "csrc" / f"{file}.cu").read_text()
    text = re.sub(r"^__INS__\((?!3\)).*$", "", text, flags=re.M)
    name = f"_ZN6gsplat\\d+{entry}_kernel(If|ILj3Ef)?E"
    compiled = peers.compile("gsplat", text, str(shared), name)
    machine = Interpreter(counting=True)
    tensors = [value for value in values if isinstance(value, Tensor)]
    launch(machine, compiled, packed(compiled[0], values), tensors, *sizes)
    return [*counting.executed(machine).values()]


def gsplat_picture(peers: Peers, leaves: dict[str, Tensor], cameras: dict) -> dict[str, Kernels]:
    """Count the same view by gsplat."""
    files = {
        ("projection", "forward"): ("ProjectionEWA3DGSFused", "projection_ewa_3dgs_fused_fwd"),
        ("projection", "gradient"): ("ProjectionEWA3DGSFused", "projection_ewa_3dgs_fused_bwd"),
        ("drawing", "forward"): ("RasterizeToPixels3DGSFwd", "rasterize_to_pixels_3dgs_fwd"),
        ("drawing", "gradient"): ("RasterizeToPixels3DGSBwd", "rasterize_to_pixels_3dgs_bwd"),
    }
    found: dict[str, Kernels] = {name: {} for name in ("projection", "tile lists", "drawing")}
    sizes = {
        "projection": ((256, 1, 1), (-(-GAUSSIANS // 256), 1, 1)),
        "drawing": ((TILE, TILE, 1), (1, SIDE // TILE, SIDE // TILE)),
    }
    of_pixel = {"forward": 4 + 12 + 12, "gradient": 4 + 12 + 12 + 4 * 3}

    def run(stage: str, direction: str, values: Sequence) -> None:
        shared = TILE * TILE * of_pixel[direction] if stage == "drawing" else 0
        kernel = files[stage, direction]
        found[stage][direction] = gsplat_kernel(peers, *kernel, values, sizes[stage], shared)

    n, x = GAUSSIANS, {name: value.detach() for name, value in leaves.items()}
    viewmats, Ks = cameras["viewmats"], cameras["Ks"]
    radii = torch.empty(n, 2, dtype=torch.int32)
    means2d, depths, conics = torch.empty(n, 2), torch.empty(n), torch.empty(n, 3)
    of_scene = [1, 1, n, x["means"], None, x["quats"], x["scales"]]
    of_camera = [viewmats, Ks, SIDE, SIDE, 0.3]
    outputs = [radii, means2d, depths, conics, None]
    inputs = [*of_scene, x["opacities"], *of_camera, 0.01, 1e10, 0.0, 0]
    run("projection", "forward", [*inputs, *outputs])
    lists, (begins, ids) = gsplat_lists(peers, [means2d, radii, depths])
    found["tile lists"]["forward"] = lists
    colors, alphas = torch.empty(SIDE, SIDE, 3), torch.empty(SIDE, SIDE)
    last = torch.empty(SIDE, SIDE, dtype=torch.int32)
    drawn = [1, n, len(ids), 0, means2d, conics, x["colors"], x["opacities"], None, None]
    drawn += [SIDE, SIDE, TILE, SIDE // TILE, SIDE // TILE, begins, ids]
    run("drawing", "forward", [*drawn, colors, alphas, last])
    torch.manual_seed(1)
    cotangents = [torch.randn_like(colors), torch.randn_like(alphas)]
    grads = [torch.zeros_like(value) for value in (means2d, conics, x["colors"], x["opacities"])]
    run("drawing", "gradient", [*drawn, alphas, last, *cotangents, None, *grads])
    back = [torch.zeros_like(x[name]) for name in ("means", "quats", "scales")]
    zero = torch.zeros_like(depths)
    of_forward = [radii, conics, None, grads[0], zero, grads[1], None]
    run(
        "projection",
        "gradient",
        [*of_scene, *of_camera, 0, *of_forward, back[0], None, back[1], back[2], None],
    )
    renders, ours, _ = rasterization(**leaves, **cameras)
    wanted = torch.autograd.grad(
        [renders[0], ours[0, ..., 0]], [leaves[name] for name in LEAVES], cotangents
    )
    # it cuts Gaussians off at another distance, and alphas at .999
    agree(
        "gsplat, forward", [renders[0].detach(), ours[0, ..., 0].detach()], [colors, alphas], 1e-3
    )
    agree("gsplat, gradient", wanted, [*back, grads[3], grads[2]], 1e-2)
    return found


def both_harmonics(peers: Peers, degree: int = 3) -> tuple[Kernels, Kernels]:
    """Count one view's colours by ours and by gsplat, which is given directions."""
    torch.manual_seed(0)
    terms = (degree + 1) ** 2
    coefficients, means = torch.randn(1, GAUSSIANS, terms, 3), torch.randn(1, GAUSSIANS, 3)
    leaves = [coefficients.requires_grad_(), means.requires_grad_()]
    center = torch.zeros(1, 1, 3)
    run = partial(sums_seen_from, degree, *leaves, center)
    ours = listed(counting.count(lambda: [run()], leaves, MULTIPROCESSORS))
    wanted = run()
    v_colors = torch.randn_like(wanted)
    of = [GAUSSIANS, terms, degree, means.detach(), coefficients.detach(), None]
    sizes = (256, 1, 1), (-(-GAUSSIANS * 3 // 256), 1, 1)
    colors, back = torch.empty_like(wanted), [torch.zeros_like(x) for x in leaves]
    file, theirs = "SphericalHarmonicsCUDA", {}
    for direction, name, values in (
        ("forward", "fwd", [colors]),
        ("gradient", "bwd", [v_colors, *back]),
    ):
        entry = f"spherical_harmonics_{name}"
        theirs[direction] = gsplat_kernel(peers, file, entry, [*of, *values], sizes)
    agree("gsplat, harmonics", [wanted.detach()], [colors], 1e-5)
    agree("gsplat, harmonics", torch.autograd.grad(wanted, leaves, v_colors), back, 1e-4)
    return ours, theirs


# --- the table


def cases(peers: Peers) -> Iterator[tuple[str, str, Kernels, Kernels]]:
    """Yield an operator, a case, and the counts of ours and of theirs."""
    for batch, length, dtype in (
        (16, 2048, torch.float32),
        (16, 2048, torch.bfloat16),
        (16, 16961, torch.bfloat16),
        (1, 2048, torch.bfloat16),
        (1, 16961, torch.bfloat16),
    ):
        ours = at_full_width(partial(our_scan, length, batch, dtype), 64, batch)
        theirs = at_full_width(partial(mamba_scan, peers, length, dtype), 1, batch)
        yield "scan", f"{batch} x {length:,}, {str(dtype)[6:]}", ours, theirs
    for length, dtype in ((2048, torch.float32), (2048, torch.bfloat16), (16961, torch.bfloat16)):
        ours = at_full_width(partial(our_conv, length, dtype), 128, 16)
        for last in (True, False) if length % 8 == 0 else (True,):
            theirs = at_full_width(partial(their_conv, peers, length, dtype, last), 128, 16)
            layout = "channels last" if last else "tokens last"
            yield "convolution", f"16 x {length:,}, {str(dtype)[6:]}, theirs {layout}", ours, theirs
    viewmats, Ks = orbit_cameras(1, SIDE)
    leaves = {name: x.requires_grad_() for name, x in shell(GAUSSIANS).items()}
    cameras = dict(viewmats=viewmats, Ks=Ks, width=SIDE, height=SIDE)
    theirs = gsplat_picture(peers, leaves, cameras)
    for multiprocessors, text in ((0, "whole tiles"), (MULTIPROCESSORS, "quarters of tiles")):
        ours = our_picture(leaves, cameras, multiprocessors)
        for stage in ours:
            if stage == "drawing":
                yield "rasterizer", f"{stage}, {text}", ours[stage], theirs[stage]
            elif not multiprocessors:
                yield "rasterizer", stage, ours[stage], theirs[stage]
    yield "rasterizer", "harmonics of degree 3", *both_harmonics(peers)


def total(kernels: list[Executed]) -> dict[str, float]:
    """Return the sums over launches that follow each other."""
    found = {name: sum(x.counts.get(name, 0) for x in kernels) for name in ("sectors", "first")}
    return {"instructions": sum(counting.instructions(x.counts) for x in kernels), **found}


def compare(folder: Path) -> dict:
    """Count all cases: ``{versions, rows}``, ready for JSON.

    A row has ``op, case, direction``, and of ``ours`` and ``theirs`` "instructions" of warps,
    "sectors", and "first" of them.

    Args:
        folder: for what is downloaded.

    Raises:
        Missing: as ``Peers``.
    """
    rows = []
    for op, case, ours, theirs in cases(Peers(folder)):
        print(f"counted beside others: {op}, {case}")
        for direction in ours:
            both = {"ours": total(ours[direction]), "theirs": total(theirs[direction])}
            rows.append({"op": op, "case": case, "direction": direction, **both})
    return {"versions": PACKAGES | {"nvcc": str(torch.version.cuda)}, "rows": rows}


_TEXT = """## Compared with other libraries
Written by `python -m ptx.counts --peers` ({sources}): sources are compiled with the flags of their
setup.py (but C++20) and the template arguments that their host code chooses, and executed in the
same interpreter on the same inputs; their results agree with ours. Scan and convolution have
{channels:,} channels, {states} states, softplus and gate, {width} weights and SiLU; the rasterizer
one view of {side} x {side} of {gaussians:,} Gaussians.

**Ratios, ours to theirs, forward / gradient: below 1 is less.** Sectors are of 32 bytes of global
memory; **first** counts those that the launch had not touched before. Ours add the rows of
gradients in a fixed order, theirs with atomics. Neither count includes the sort of the lists by a
library and torch's own operations before and after a kernel.

"""


def markdown(document: dict) -> str:
    """Return the section of a page, of the document of ``compare``."""
    sources = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    sizes = dict(channels=CHANNELS, states=STATES, width=WIDTH, side=SIDE, gaussians=GAUSSIANS)
    ratios: dict[tuple[str, str], list[list[str]]] = {}
    for row in document["rows"]:
        ours, theirs = row["ours"], row["theirs"]
        found = [f"{ours[x] / theirs[x]:.2f}" if theirs[x] else "" for x in ours]
        ratios.setdefault((row["op"], row["case"]), []).append(found)
    table = [[*names, *map(" / ".join, zip(*both))] for names, both in ratios.items()]
    header = ["operator", "case", "instructions", "sectors", "first"]
    return _TEXT.format(sources=sources, **sizes) + tables.markdown(header, table) + "\n"
