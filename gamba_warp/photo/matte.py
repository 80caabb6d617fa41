"""Mattes of a trained network, run in a child process, and the choice and fetching of its file."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import torch

from ..data.preprocess import resize
from ..errors import UserError, first_line
from ..images import to_uint8
from ..untrusted.children import Failed, run_each
from ..versions import require, to_install
from . import models

MAX_MODEL = 2 << 30  # bytes of a model's file; rembg's largest has 1.1 GB
_SECONDS = 300.0  # for one image; it takes about six on two cores
_MEMORY = 8 << 30  # bytes; ISNet takes two gigabytes


class NoMatte(Exception):
    """Error of a missing or failed matting model; the text is one line."""


class Matte:
    """A matting network.

    Args:
        file: an ISNet or U2-Net in ONNX, or the URL of a copy of one of rembg's, which is fetched;
            None: one of rembg's, from its cache or fetched.
        fetch: allow network access.
        say: called with a line before anything is fetched.

    Raises:
        UserError: ``file`` is missing, cannot be fetched, or is not a matting model.
        ModuleNotFoundError: ``file`` is given, and onnxruntime is not installed.
        NoMatte: no file is given, and the model or onnxruntime is missing.
    """

    def __init__(
        self, file: str | Path | None = None, fetch: bool = True, say: Callable[[str], None] = print
    ) -> None:
        if find_spec("onnxruntime") is None:
            if file is not None:
                require("onnxruntime")
            raise NoMatte(f"onnxruntime is not installed: {to_install('photo')}")
        self._given = file is not None
        if file is None or str(file).startswith(("https://", "http://")):
            self.path = _fetched(None if file is None else str(file), fetch or self._given, say)
        else:
            self.path = Path(file)
        self._version = (0, 0)
        if self._given:
            if not self.path.is_file():
                reason = "not a plain file" if self.path.exists() else "no such file"
                raise UserError(f"--matte-model {self.path}: {reason}")
            status = os.stat(self.path)
            if status.st_size > MAX_MODEL:
                raise UserError(f"--matte-model {self.path}: is over {MAX_MODEL >> 30} GB")
            self._version = status.st_size, status.st_mtime_ns
            self._run(None)

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Return alpha ``[H, W]`` float32 in [0, 1] of RGB ``[H, W, 3]`` in [0, 1].

        Raises:
            UserError: a given file fails.
            NoMatte: rembg's file fails.
        """
        alpha = self._run(to_uint8(rgb))
        assert alpha is not None
        return resize(alpha[..., None], *rgb.shape[:2])[..., 0].clip(0, 1)

    def _run(self, rgb: np.ndarray | None) -> np.ndarray | None:
        task = (str(self.path.absolute()), self._version, rgb, torch.get_num_threads())
        try:
            ((_, value),) = run_each(models.alpha_of, [task], seconds=_SECONDS, memory=_MEMORY)
        except RuntimeError as error:  # no child process could be started
            value = Failed(first_line(error))
        if not isinstance(value, Failed):
            return value
        reason = value.reason.removeprefix(f"{task[0]}: ")
        if self._given:
            raise UserError(f"--matte-model {self.path}: {reason}")
        raise NoMatte(f"{self.path}: {reason}")


def _fetched(address: str | None, fetch: bool, say: Callable[[str], None]) -> Path:
    """Return the file of a URL; without one rembg's, from its cache or fetched.

    Raises:
        UserError: the URL cannot be fetched.
        ModuleNotFoundError: pooch, which fetches it, is not installed.
        NoMatte: no URL is given, and the file is unavailable.
    """
    if address is None and (path := models.cached()) is not None:
        return path
    if address is not None and not address.startswith("https://"):
        raise UserError(f"--matte-model {address}: only addresses of https are fetched")
    known = {f"{model.name}.onnx": model for model in models.PUBLISHED}
    name = next(iter(known)) if address is None else urlsplit(address).path.rpartition("/")[2]
    if name not in known:
        names = ", ".join(known)
        raise UserError(f"--matte-model {address}: an address must end in one of {names}")
    model = known[name]
    if not models.may_fetch() or not fetch:
        reason = "GAMBA_OFFLINE forbids fetching it" if fetch else "it may not be fetched"
    elif address is None and find_spec("pooch") is None:
        raise NoMatte(f"pooch, which fetches it, is not installed: {to_install('photo')}")
    else:
        require("pooch")
        url = address or model.address
        say(f"fetching a matting model once, {model.megabytes} MB, from {url}")
        try:
            return models.fetch(model, url)
        except UserError as error:
            reason = str(error)
    if address is not None:
        raise UserError(f"--matte-model {address}: {reason}")
    how = f"no matting model is here; give --matte-model a copy or its address, of {model.address}"
    raise NoMatte(f"{how} ({reason})")


def to_stderr(line: str) -> None:
    """Print a line on stderr, which is no error."""
    print(f"note: {line}", file=sys.stderr, flush=True)
