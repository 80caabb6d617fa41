"""Matting networks: location, fetching and inference.

Files and folders are those of rembg, so its copies are used. rembg itself is not used: its first
import compiles numba functions for minutes (docs/reconstruct.md).

A file is an untrusted graph, which onnxruntime reads and runs in native code. It may crash, hang or
exhaust memory, so ``matte.py`` calls ``alpha_of`` in a child process.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urljoin, urlsplit

import numpy as np
from PIL import Image

from ..batch import progress_bar
from ..errors import UserError, first_line

_FROM = "https://github.com/danielgatis/rembg/releases/download/v0.0.0"
_SECONDS = 20  # timeout of the network
_OPEN = 1024  # side of a dynamic input, pixels
_SIDES = (32, 2048)  # smallest and largest side of an input, pixels
_U2NET = 320  # up to this side: U2-Net and similar, with ImageNet's normalisation
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Published(NamedTuple):
    """A model published by rembg.

    Attributes:
        name: of the model; its file is ``NAME.onnx``.
        sha256: of the file with rembg's MD5 sum.
        megabytes: size of the file.
        licence: of the weights.
    """

    name: str
    megabytes: int
    sha256: str
    licence: str = "Apache 2.0"

    @property
    def address(self) -> str:
        """URL of the file."""
        return f"{_FROM}/{self.name}.onnx"


# The first is fetched; of the cached ones, the first is used.
PUBLISHED = (
    Published(
        "isnet-general-use",
        179,
        "60920e99c45464f2ba57bee2ad08c919a52bbf852739e96947fbb4358c0d964a",
    ),
    Published("u2net", 176, "8d10d2f3bb75ae3b6d527c77944fc5e7dcd94b29809d47a739a7a728a912b491"),
    Published("silueta", 44, "75da6c8d2f8096ec743d071951be73b4a8bc7b3e51d9a6625d63644f90ffeedb"),
    Published("u2netp", 5, "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"),
)


def _homes() -> tuple[Path, Path]:
    """Return rembg's folder and its former one, both of which rembg searches."""
    chosen, data = os.environ.get("U2NET_HOME"), os.environ.get("XDG_DATA_HOME")
    if chosen:
        return Path(chosen).expanduser(), Path(chosen).expanduser()
    new = os.environ.get("REMBG_HOME") or (f"{data}/rembg" if data else "~/.rembg")
    return Path(os.path.expanduser(new)), Path(os.path.expanduser(f"{data or '~'}/.u2net"))


def cached() -> Path | None:
    """Return the best published model in rembg's folders; None without one."""
    home, former = _homes()
    for model in PUBLISHED:
        file = f"{model.name}.onnx"
        for path in (home / "models" / model.name / file, former / file):
            if path.is_file():
                return path
    return None


def may_fetch() -> bool:
    """Return True if network access is allowed: unless ``GAMBA_OFFLINE`` is set."""
    return os.environ.get("GAMBA_OFFLINE", "0") in ("", "0")


def fetch(model: Published, address: str) -> Path:
    """Fetch a model into rembg's folder, with its progress on stderr.

    The file gets its name only when it is complete and its digest is right.

    Args:
        model: to fetch.
        address: https URL of the file; any copy, because its digest is compared.

    Raises:
        ModuleNotFoundError: pooch is not installed.
        UserError: the network is unavailable, the digest is wrong, or the file cannot be written.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    bar: Any = progress_bar(total=model.megabytes * 10**6, unit="B", unit_scale=True)
    # Any, because pooch's types allow neither such a bar nor keyword arguments.
    downloader: Any = pooch.HTTPDownloader(
        progressbar=bar, timeout=_SECONDS, hooks={"response": _stays_secure}
    )
    try:
        path = pooch.retrieve(
            address,
            known_hash=f"sha256:{model.sha256}",
            fname=f"{model.name}.onnx",
            path=_homes()[0] / "models" / model.name,
            downloader=downloader,
        )
    except Exception as error:  # of requests, of urllib3, of the disk, and a ValueError of pooch
        reason = first_line(error)[:200]
        # requests nests several errors
        names = {type(error).__name__, type(error.__context__).__name__}
        if names & {"ConnectionError", "ConnectTimeout", "ReadTimeout", "ProxyError", "SSLError"}:
            reason = f"{urlsplit(address).hostname} cannot be reached"
        raise UserError(reason) from error
    return Path(path)


def _stays_secure(response: Any, **options: Any) -> None:
    """Refuse a redirect away from https; a hook that requests calls before it follows one."""
    if response.is_redirect:
        goal = urljoin(response.url, response.headers["location"])
        if urlsplit(goal).scheme != "https":
            raise ValueError(f"it is redirected to {goal[:100]}, which is not https")


def alpha_of(task: tuple[str, tuple[int, int], np.ndarray | None, int]) -> np.ndarray | None:
    """Run a network on one image.

    Args:
        task: the model's file; its size and mtime, as a cache key; RGB ``[H, W, 3]`` uint8, or None
            to check the file only; and the number of threads.

    Returns:
        The network's alpha ``[h, w]`` float32 in [0, 1], h and w of its input; None without an
        image.

    Raises:
        UserError: the file is not a matting network, or its output is not finite.
    """
    path, version, rgb, threads = task
    session, size, names = _opened(path, version, threads)
    if rgb is None:
        return None
    batch = _input(rgb, size)
    try:
        out = np.asarray(session.run([names[1]], {names[0]: batch})[0], np.float32)
    except Exception as error:  # onnxruntime has many error types
        raise UserError(f"{path}: cannot be run ({first_line(error)})") from error
    alpha = out.reshape(-1)[: size[0] * size[1]]
    if out.shape[-2:] != size or not np.isfinite(alpha).all():
        raise UserError(f"{path}: not a matting model (it gives {list(out.shape)}, or no numbers)")
    alpha = alpha.reshape(size)
    if alpha.min() < -0.01 or alpha.max() > 1.01:  # its last layer is not a sigmoid
        alpha = 1 / (1 + np.exp(-np.clip(alpha, -30, 30)))
    return np.clip(alpha, 0, 1)


@lru_cache(1)
def _opened(
    path: str, version: tuple[int, int], threads: int
) -> tuple[Any, tuple[int, int], tuple[str, str]]:
    """Return the session, the input's size (height, width), and the names of input and output."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised anyway
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs, outputs = session.get_inputs(), session.get_outputs()
    except Exception as error:
        raise UserError(f"{path}: not a model in ONNX ({first_line(error)})") from error
    shape = list(inputs[0].shape) if len(inputs) == 1 and outputs else []
    if len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
        raise UserError(f"{path}: not a matting model (it takes no image of three colours)")
    height, width = (side if isinstance(side, int) else _OPEN for side in shape[2:])
    if not all(_SIDES[0] <= side <= _SIDES[1] for side in (height, width)):
        raise UserError(f"{path}: takes images of {width}x{height}; sides may be {_SIDES}")
    return session, (height, width), (inputs[0].name, outputs[0].name)


def _input(rgb: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Normalise to ``[1, 3, h, w]`` float32 as in training: U2-Net by ImageNet's statistics."""
    small = Image.fromarray(rgb).resize((size[1], size[0]), Image.Resampling.LANCZOS)
    values = np.asarray(small, np.float32) / max(1, int(np.asarray(small).max()))
    if max(size) <= _U2NET:
        values = (values - np.array(_MEAN, np.float32)) / np.array(_SPREAD, np.float32)
    else:
        values = values - np.float32(0.5)
    return np.ascontiguousarray(values.transpose(2, 0, 1)[None])
