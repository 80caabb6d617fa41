"""Devices, folders and abilities of this machine, and how to install missing parts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import torch
import warp as wp

from ..errors import first_line
from ..kernels.bench.measure import synchronize
from ..kernels.cases.raster import orbit_cameras, raster_case, shell
from ..kernels.cases.scan import make_inputs, scan_case
from ..model.checkpoint import DEFAULT_CHECKPOINT
from ..versions import EXTRA_OF, import_open3d, to_install
from ..vision.weights import FETCH, cache_folder, lpips_available


def devices() -> Iterator[tuple[str, str]]:
    """Yield torch's devices with their properties."""
    yield "cpu", f"{torch.get_num_threads()} threads"
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        memory = properties.total_memory / 2**30
        architecture = f"sm_{properties.major}{properties.minor}"
        yield f"cuda:{index}", f"{properties.name}, {memory:.0f} GiB, {architecture}"
    if not torch.cuda.is_available():
        yield "cuda", "none"


def folders() -> Iterator[tuple[str, str]]:
    """Yield the folders of compiled kernels and fetched weights, with their sizes."""
    wp.init()
    compiled = wp.config.kernel_cache_dir
    assert compiled is not None  # ``wp.init`` sets it
    kept = {"compiled kernels": Path(compiled), "weights": cache_folder()}
    for name, path in kept.items():
        size = sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) / 2**20
        yield name, f"{path} ({size:.0f} MiB)"


def abilities() -> Iterator[tuple[str, str, bool]]:
    """Yield each ability, its state, and True for a fault.

    Missing weights are not a fault; a library that does not work is one.
    """
    for name, check in {"open3d": _open3d, "mp4": _ffmpeg}.items():
        try:
            check()
            yield name, "yes", False
        except ModuleNotFoundError as error:  # of an extra that is not installed
            extra = EXTRA_OF.get(error.name or "")
            how = to_install(extra) if extra else first_line(error)
            yield name, f"no: {how}", extra is None
        except Exception as error:  # a broken installation raises anything
            yield name, f"no: {first_line(error)}", True
    there = DEFAULT_CHECKPOINT.is_file()
    missing = "no shipped model, though it comes with the package; give --checkpoint"
    yield "reconstruct", "yes" if there else missing, False
    yield "lpips", "yes" if lpips_available() else f"no weights here; '{FETCH}' fetches them", False
    yield "sam", "with --sam CHECKPOINT; only busy backgrounds need it", False


def _open3d() -> None:
    import_open3d().geometry.TriangleMesh.create_box()


def _ffmpeg() -> None:
    import imageio_ffmpeg

    imageio_ffmpeg.get_ffmpeg_exe()


def warm_up_kernels() -> Iterator[tuple[str, float, float]]:
    """Run scan and rasterizer forward and backward on small inputs, twice on each device.

    Yields:
        The device's type, the seconds of the first run, which compiles or loads the kernels, and
        those of the second.
    """
    for name in ["cpu", "cuda"][: 1 + torch.cuda.is_available()]:
        device, spans = torch.device(name), []
        for _ in range(2):
            started = time.perf_counter()
            scan_case(make_inputs(1, 32, 32), device, 32).backward()
            raster_case(shell(64), orbit_cameras(1, 32), 32, device).backward()
            synchronize(device)
            spans.append(time.perf_counter() - started)
        yield name, spans[0], spans[1]
