"""Instruction counts of other libraries' kernels and of ours for the same work."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from gamba_warp.kernels.cases.raster import LEAVES
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.harmonics import sums_seen_from
from gamba_warp.kernels.runtime import tables
from gamba_warp.kernels.selective_scan import selective_scan

from . import counting
from .counting import CHANNELS, GAUSSIANS, SIDE, STATES, WIDTH, Counts, Executed
from .dry_run import MULTIPROCESSORS
from .peer_code import PACKAGES, Peers, execute, filled, packed

TILE, SIDES = 16, SIDE // 16
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

    return {way: [both(a, b) for a, b in zip(one[way], two[way], strict=True)] for way in one}


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
    return listed(counting.count_scan(inputs, counting.scan_tuning(batch, length)))


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
    of_state = "T::kSmemSize + MAX_DSTATE * sizeof(T::scan_t)"

    def compiled(way: str, more: str, last: str, kind: str, shared: str):
        filled_in = text.format(way, more, even, last, TYPES[dtype], kind)
        return peers.compile("mamba-ssm", filled_in, of_state + shared)

    forward = compiled("fwd", "1, ", "", "SSMParamsBase", "")
    more = " + (128 + 4 * MAX_DSTATE) * sizeof(float)"
    backward = compiled("bwd", "", ", true", "SSMParamsBwd", more)
    inputs = counting.scan_inputs(length, channels, dtype)
    y = selective_scan(**inputs, delta_softplus=True)
    dy = torch.randn(y.shape).to(dtype)
    wanted = torch.autograd.grad(y, [*inputs.values()], dy)
    x = {name: value.detach() for name, value in inputs.items()}
    for name in ("u", "delta", "z", "B", "C"):
        x[name] = x[name].mT.contiguous()[:, None if name in "BC" else slice(None)]
    chunks = -(-length // 2048)
    x |= {"out": torch.empty_like(x["u"]), "out_z": torch.empty_like(x["u"])}
    x["x"] = torch.empty(1, channels, chunks, 2 * STATES)
    axes = dict.fromkeys(x, "batch d l") | {"A": "d dstate", "x": "", "D": "", "delta_bias": ""}
    axes |= dict.fromkeys(("B", "C", "dB", "dC"), "batch group dstate l")
    sizes = dict(batch=1, dim=channels, seqlen=length, dstate=STATES, n_groups=1, n_chunks=chunks)
    sizes |= dict(dim_ngroups_ratio=channels, delta_softplus=True)
    sizes |= dict(is_variable_B=True, is_variable_C=True)

    def ran(compiled, kind: str) -> list[Executed]:
        params = [filled(header, kind, x, axes, **sizes)]
        return execute(compiled, params, [*x.values()], (128, 1, 1), (1, channels, 1))

    found = {"forward": ran(forward, "SSMParamsBase")}
    limit = 1e-4 if dtype == torch.float32 else 1e-2
    agree("mamba-ssm, forward", [y.detach()], [x["out_z"].mT], limit)
    del x["out_z"]
    x["dout"] = dy.mT.contiguous()
    axes |= {f"d{name}": axes[name] for name in ("out", *inputs)}
    for name in inputs:
        kind = dtype if name in ("u", "delta", "z") else torch.float32
        x[f"d{name}"] = torch.zeros_like(x[name], dtype=kind)
    found["gradient"] = ran(backward, "SSMParamsBwd")
    theirs = (x[f"d{name}"] for name in inputs)
    theirs = [g[:, 0].mT if g.ndim == 4 else g.mT if g.ndim == 3 else g for g in theirs]
    agree("mamba-ssm, gradient", wanted, theirs, 10 * limit)
    return found


# --- the convolution


def our_conv(length: int, dtype: torch.dtype, channels: int) -> Kernels:
    """Count one sequence."""
    return listed(counting.count_conv(length, channels, dtype))


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

    def ran(program, kind: str, chunk: int) -> list[Executed]:
        params = [filled(header, kind, x, axes, **sizes)]
        blocks = (1, -(-length // chunk), -(-channels // elements)) if last else (1, channels, 1)
        return execute(program, params, [*x.values()], (128, 1, 1), blocks)

    found = {"forward": ran(forward, "ConvParamsBase", chunks[0])}
    limit = 1e-4 if dtype == torch.float32 else 1e-2
    agree("causal-conv1d, forward", [y.detach()], [x["out"].mT], limit)
    x |= {"dout": laid_out(dy), "dx": laid_out(torch.empty_like(y))}
    x |= {"dweight": torch.zeros(channels, WIDTH), "dbias": torch.zeros(channels)}
    found["gradient"] = ran(backward, "ConvParamsBwd", chunks[1])
    agree("causal-conv1d, gradient", wanted, [x["dx"].mT, x["dweight"], x["dbias"]], limit)
    return found


# --- the rasterizer

# Our kernels that do what each of theirs does. Both sort by a library.
STAGES = {
    ("projection", "forward"): ("project",),
    ("tile lists", "forward"): ("count", "emit", "in_tile_order"),
    ("projection", "gradient"): ("project_vjp",),
    ("drawing", "forward"): ("record", "composite"),
    ("drawing", "gradient"): ("composite_vjp", "add_rows"),
}


def our_image(leaves: dict, cameras: dict, multiprocessors: int) -> dict[str, Kernels]:
    """Count one view, stage by stage; on few multiprocessors by whole tiles."""
    run = partial(rasterization, **leaves, **cameras)
    counted = counting.count(lambda: run()[:2], leaves.values(), multiprocessors)
    found: dict[str, Kernels] = {}
    for (stage, direction), names in STAGES.items():
        kernels = counted[direction].values()
        found.setdefault(stage, {})[direction] = [x for x in kernels if x.name in names]
    return found


def gsplat_lists(peers: Peers, projected: Sequence) -> tuple[list[Executed], Tensor, Tensor]:
    """Count gsplat's kernels of tile lists; tiles' first pairs and the pairs' Gaussians.

    Args:
        peers: the sources.
        projected: means, radii and depths, as gsplat has them.
    """
    bits = (SIDES * SIDES).bit_length()
    common = [0, 1, GAUSSIANS, 0, None, None, *projected]
    sizes = [TILE, SIDES, SIDES, bits, 1]

    def run(entry: str, values: Sequence, number: int = GAUSSIANS) -> list[Executed]:
        blocks = (256, 1, 1), (-(-number // 256), 1, 1)
        return gsplat_kernel(peers, "IntersectTile", f"intersect_{entry}", values, blocks)

    counts = torch.empty(GAUSSIANS, dtype=torch.int32)
    counted = run("tile", [*common, None, *sizes, counts, None, None])
    ends = counts.cumsum(0)
    keys = torch.empty(int(ends[-1]), dtype=torch.int64)
    ids, begins = keys.new_empty(len(keys), dtype=torch.int32), counts.new_empty(1, SIDES, SIDES)
    written = run("tile", [*common, ends, *sizes, None, keys, ids])
    keys, order = keys.sort(stable=True)
    found = run("offset", [len(keys), keys, 1, SIDES * SIDES, bits, begins], len(keys))
    return [*counted, *written, *found], begins, ids[order]


def gsplat_kernel(peers: Peers, file: str, entry: str, values: Sequence, sizes, shared: int = 0):
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
    tensors = [value for value in values if isinstance(value, Tensor)]
    return execute(compiled, packed(compiled[0], values), tensors, *sizes)


def gsplat_image(peers: Peers, leaves: dict[str, Tensor], cameras: dict) -> dict[str, Kernels]:
    """Count the same view by gsplat."""
    n, x = GAUSSIANS, {name: value.detach() for name, value in leaves.items()}

    def project(way: str, values: Sequence) -> list[Executed]:
        sizes, entry = ((256, 1, 1), (-(-n // 256), 1, 1)), f"projection_ewa_3dgs_fused_{way}"
        return gsplat_kernel(peers, "ProjectionEWA3DGSFused", entry, values, sizes)

    def draw(way: str, values: Sequence, of_pixel: int) -> list[Executed]:
        file, entry = f"RasterizeToPixels3DGS{way.title()}", f"rasterize_to_pixels_3dgs_{way}"
        sizes = (TILE, TILE, 1), (1, SIDES, SIDES)
        return gsplat_kernel(peers, file, entry, values, sizes, TILE * TILE * of_pixel)

    radii = torch.empty(n, 2, dtype=torch.int32)
    means2d, depths, conics = torch.empty(n, 2), torch.empty(n), torch.empty(n, 3)
    of_scene = [1, 1, n, x["means"], None, x["quats"], x["scales"]]
    of_camera = [cameras["viewmats"], cameras["Ks"], SIDE, SIDE, 0.3]
    inputs = [*of_scene, x["opacities"], *of_camera, 0.01, 1e10, 0.0, 0]
    projection = {"forward": project("fwd", [*inputs, radii, means2d, depths, conics, None])}
    lists, begins, ids = gsplat_lists(peers, [means2d, radii, depths])
    colors, alphas = torch.empty(SIDE, SIDE, 3), torch.empty(SIDE, SIDE)
    last = torch.empty(SIDE, SIDE, dtype=torch.int32)
    drawn = [1, n, len(ids), 0, means2d, conics, x["colors"], x["opacities"], None, None]
    drawn += [SIDE, SIDE, TILE, SIDES, SIDES, begins, ids]
    drawing = {"forward": draw("fwd", [*drawn, colors, alphas, last], 4 + 12 + 12)}
    torch.manual_seed(1)
    cotangents = [torch.randn_like(colors), torch.randn_like(alphas)]
    grads = [torch.zeros_like(value) for value in (means2d, conics, x["colors"], x["opacities"])]
    values = [*drawn, alphas, last, *cotangents, None, *grads]
    drawing["gradient"] = draw("bwd", values, 4 + 12 + 12 + 4 * 3)
    back = [torch.zeros_like(x[name]) for name in ("means", "quats", "scales")]
    of_forward = [radii, conics, None, grads[0], torch.zeros_like(depths), grads[1], None]
    values = [*of_scene, *of_camera, 0, *of_forward, back[0], None, back[1], back[2], None]
    projection["gradient"] = project("bwd", values)
    renders, ours, _ = rasterization(**leaves, **cameras)
    images = [renders[0], ours[0, ..., 0]]
    wanted = torch.autograd.grad(images, [leaves[name] for name in LEAVES], cotangents)
    # it cuts Gaussians off at another distance, and alphas at .999
    agree("gsplat, forward", [y.detach() for y in images], [colors, alphas], 1e-3)
    agree("gsplat, gradient", wanted, [*back, grads[3], grads[2]], 1e-2)
    return {"projection": projection, "tile lists": {"forward": lists}, "drawing": drawing}


def both_harmonics(peers: Peers, degree: int = 3) -> tuple[Kernels, Kernels]:
    """Count one view's colours by ours and by gsplat, which is given directions."""
    torch.manual_seed(0)
    terms = (degree + 1) ** 2
    coefficients, means = torch.randn(1, GAUSSIANS, terms, 3), torch.randn(1, GAUSSIANS, 3)
    leaves = [coefficients.requires_grad_(), means.requires_grad_()]
    sums = partial(sums_seen_from, degree, *leaves, torch.zeros(1, 1, 3))
    ours = listed(counting.count(sums, leaves, MULTIPROCESSORS))
    wanted = sums()
    v_colors = torch.randn_like(wanted)
    of = [GAUSSIANS, terms, degree, means.detach(), coefficients.detach(), None]
    sizes = (256, 1, 1), (-(-GAUSSIANS * 3 // 256), 1, 1)
    colors, back = torch.empty_like(wanted), [torch.zeros_like(x) for x in leaves]

    def run(way: str, *values: Tensor) -> list[Executed]:
        entry = f"spherical_harmonics_{way}"
        return gsplat_kernel(peers, "SphericalHarmonicsCUDA", entry, [*of, *values], sizes)

    theirs = {"forward": run("fwd", colors), "gradient": run("bwd", v_colors, *back)}
    agree("gsplat, harmonics", [wanted.detach()], [colors], 1e-5)
    agree("gsplat, harmonics", torch.autograd.grad(wanted, leaves, v_colors), back, 1e-4)
    return ours, theirs


# --- the table


def cases(peers: Peers) -> Iterator[tuple[str, str, Kernels, Kernels]]:
    """Yield an operator, a case, and the counts of ours and of theirs."""
    lengths = (2048, torch.float32), (2048, torch.bfloat16), (16961, torch.bfloat16)
    for batch, (length, dtype) in [*((16, x) for x in lengths), *((1, x) for x in lengths[1:])]:
        ours = at_full_width(partial(our_scan, length, batch, dtype), 64, batch)
        theirs = at_full_width(partial(mamba_scan, peers, length, dtype), 1, batch)
        yield "scan", f"{batch} x {length:,}, {str(dtype)[6:]}", ours, theirs
    for length, dtype in lengths:
        ours = at_full_width(partial(our_conv, length, dtype), 128, 16)
        for last in (True, False) if length % 8 == 0 else (True,):
            theirs = at_full_width(partial(their_conv, peers, length, dtype, last), 128, 16)
            layout = "channels last" if last else "tokens last"
            yield "convolution", f"16 x {length:,}, {str(dtype)[6:]}, theirs {layout}", ours, theirs
    leaves, cameras = counting.scene()
    theirs = gsplat_image(peers, leaves, cameras)
    for multiprocessors, text in ((0, "whole tiles"), (MULTIPROCESSORS, "quarters of tiles")):
        ours = our_image(leaves, cameras, multiprocessors)
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


def table(document: dict) -> str:
    """Return the ratios of a document of ``compare``."""
    ratios: dict[tuple[str, str], list[list[str]]] = {}
    for row in document["rows"]:
        ours, theirs = row["ours"], row["theirs"]
        found = [f"{ours[x] / theirs[x]:.2f}" if theirs[x] else "" for x in ours]
        ratios.setdefault((row["op"], row["case"]), []).append(found)
    rows = [[*names, *map(" / ".join, zip(*both))] for names, both in ratios.items()]
    return tables.markdown(["operator", "case", "instructions", "sectors", "first"], rows) + "\n"
