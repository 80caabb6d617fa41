"""Image tokens X from a pretrained network (paper §3.2, condition image tokens)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..conventions import IMAGENET_MEAN, IMAGENET_STD
from ..errors import UserError, first_line
from ..untrusted.torch_files import read_torch
from .config import GambaConfig

if TYPE_CHECKING:
    from timm.models.vision_transformer import VisionTransformer

MAX_PARAMETERS = 4 * 10**9  # 16 GB, far above any network of ``timm``


class ImageEncoder(nn.Module):
    """Network from images to tokens, at one image size; made by ``build_encoder``.

    A frozen encoder stays in eval mode and records no graph.

    Attributes:
        channels: C, the channels of a token.
    """

    def __init__(self, network: nn.Module, channels: int, config: GambaConfig) -> None:
        super().__init__()
        self.network = network
        self.channels = channels
        self.name = config.encoder
        self.size = config.encoder_size
        self.resize = config.encoder_resize
        self.frozen = config.encoder_frozen
        network.requires_grad_(not self.frozen)
        self.train(self.training)

    def forward(self, images: Tensor) -> Tensor:
        """Map ``images [B, H, W, 3]`` in [0, 1], resized first, to ``[B, K, channels]``."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            if images.shape[1:3] != (self.size, self.size):
                planes = images.permute(0, 3, 1, 2)
                size = (self.size, self.size)
                smooth = self.resize == "bicubic"
                planes = F.interpolate(planes, size, mode=self.resize, antialias=smooth)
                images = planes.permute(0, 2, 3, 1).clamp(0, 1)  # bicubic overshoots at edges
            return self.network(images)

    def train(self, mode: bool = True) -> ImageEncoder:
        """Set the mode as ``nn.Module.train``; a frozen network stays in eval mode."""
        super().train(mode)
        self.network.train(mode and not self.frozen)
        return self

    def weights(self) -> dict[str, Tensor]:
        """Return the network's weights, with names for ``build_encoder``."""
        network = self.network.vit if isinstance(self.network, _ViT) else self.network
        return {name: value.contiguous() for name, value in network.state_dict().items()}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the network's names and float32 values, as 64 hexadecimal digits.

        A checkpoint stores it instead of a frozen network's weights.
        """
        digest = hashlib.sha256()
        for name, value in sorted(self.network.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().float().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()


class _ViT(nn.Module):
    """timm ViT that normalises its input and returns its last tokens, without registers."""

    mean: Tensor
    std: Tensor

    def __init__(self, vit: VisionTransformer, config: GambaConfig) -> None:
        super().__init__()
        self.vit = vit
        self.class_token = config.encoder_class_token
        known = cast(dict, vit.pretrained_cfg)
        mean = known.get("mean", IMAGENET_MEAN) if config.encoder_normalize else (0.0, 0.0, 0.0)
        std = known.get("std", IMAGENET_STD) if config.encoder_normalize else (1.0, 1.0, 1.0)
        self.register_buffer("mean", torch.tensor(mean), persistent=False)
        self.register_buffer("std", torch.tensor(std), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        planes = ((images - self.mean) / self.std).permute(0, 3, 1, 2)
        tokens = self.vit.forward_features(planes)
        patches = tokens[:, self.vit.num_prefix_tokens :]
        return torch.cat([tokens[:, :1], patches], dim=1) if self.class_token else patches


Weights = str | Path | Mapping[str, Tensor]


def _vgg16(config: GambaConfig, weights: Weights | None) -> tuple[nn.Module, int]:
    from ..vision.vgg import vgg16_features

    if isinstance(weights, Mapping) or str(weights) in ("hub", "random"):
        got = "tensors" if isinstance(weights, Mapping) else f"'{weights}'"
        raise UserError(f"encoder vgg16: takes the cached weights or a file, not {got}")
    network = vgg16_features(weights)
    return network, network.dim


# Encoders that are not ViTs of timm, by name: functions that return a network from images
# ``[B, S, S, 3]`` in [0, 1], S = ``config.encoder_size``, to tokens ``[B, K, C]``, and C. A script
# may add to it (docs/train-your-own.md).
ENCODERS: dict[str, Callable[[GambaConfig, Weights | None], tuple[nn.Module, int]]] = {
    "vgg16": _vgg16
}


def build_encoder(config: GambaConfig, weights: Weights | None) -> ImageEncoder | None:
    """Build the encoder of ``config``, with its weights.

    Args:
        config: the model's configuration.
        weights: for a timm ViT a file (timm's safetensors or .pth, or Meta's DINOv2 .pth), its
            state dict, "hub" to fetch timm's own, or "random" for untrained ones, the same on every
            call. For "vgg16" torchvision's file, or None for the one in the cache.

    Returns:
        The encoder, or None if ``config.encoder`` is "none".

    Raises:
        UserError: the network or file does not exist, the weights do not fit, or required
            ``weights`` are missing.
    """
    if config.encoder == "none":
        return None
    if config.encoder in ENCODERS:
        return ImageEncoder(*ENCODERS[config.encoder](config, weights), config)
    if weights is None:
        raise UserError(
            f"encoder {config.encoder}: its weights must be given: a file, 'hub' to fetch them, "
            "or 'random' for an untrained one"
        )
    if isinstance(weights, Mapping):
        vit = _create_vit(config, pretrained=False)
        _load_vit(vit, dict(weights), f"encoder {config.encoder}")
    elif str(weights) == "random":
        # Checkpoints do not store this network, so its weights must not depend on a global seed.
        with torch.random.fork_rng():
            torch.manual_seed(0)
            vit = _create_vit(config, pretrained=False)
    else:
        vit = _create_vit(config, pretrained=str(weights) == "hub")
        if str(weights) != "hub":
            _load_vit(vit, read_state(Path(weights)), str(weights))
    return ImageEncoder(_ViT(vit, config), vit.num_features, config)


def outline_encoder(config: GambaConfig) -> ImageEncoder | None:
    """Build the encoder of ``config`` on the meta device, without memory for weights.

    Returns:
        An encoder for a model of meta tensors, or None if the model has none.

    Raises:
        UserError: the network does not exist, or is larger than the limit for models.
    """
    if config.encoder == "none" or not config.prepend:
        return None
    if config.encoder == "vgg16":
        from ..vision.weights import WIDTHS

        return ImageEncoder(nn.Identity(), WIDTHS[-1], config)
    if config.encoder in ENCODERS:
        with torch.device("meta"):
            return build_encoder(config, "random")
    with torch.device("meta"):
        vit = _create_vit(config, pretrained=False)
        count = sum(parameter.numel() for parameter in vit.parameters())
        if count > MAX_PARAMETERS:
            raise UserError(f"encoder {config.encoder}: has {count:,} parameters, too many")
        return ImageEncoder(_ViT(vit, config), vit.num_features, config)


def _create_vit(config: GambaConfig, pretrained: bool) -> VisionTransformer:
    import timm
    from timm.models.vision_transformer import VisionTransformer

    name, size = config.encoder, config.encoder_size
    if not timm.is_model(name):
        raise UserError(f"encoder {name}: neither 'none', 'vgg16' nor a model of timm")
    try:
        vit = timm.create_model(name, pretrained=pretrained, img_size=size, num_classes=0)
    except Exception as error:  # timm and its download raise many classes
        reason = first_line(error)
        action = "fetched" if pretrained else f"built for {size}x{size} pixels"
        raise UserError(f"encoder {name}: cannot be {action} ({reason})") from error
    if not isinstance(vit, VisionTransformer):
        raise UserError(f"encoder {name}: not a plain ViT, so it has no list of patch tokens")
    patch = vit.patch_embed.patch_size[0]
    if size % patch:
        raise UserError(f"encoder {name}: encoder_size {size} is not a multiple of {patch}")
    if config.encoder_class_token and not vit.has_class_token:
        raise UserError(f"encoder {name}: has no class token to keep")
    return vit


def _load_vit(vit: VisionTransformer, state: dict[str, Any], path: str) -> None:
    """Load timm's or Meta's weights; timm resizes the positions if the image size differs."""
    from timm.models.vision_transformer import checkpoint_filter_fn

    if "register_tokens" in state:
        state.setdefault("mask_token", None)  # timm detects Meta's layout by this key
    try:
        state = checkpoint_filter_fn(state, vit)
        state = {k: v for k, v in state.items() if not k.startswith("head.")}
        vit.load_state_dict(state)
    except Exception as error:  # a file of another network may break timm's conversion anywhere
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: not weights of this encoder ({reason})") from error
    for name, value in vit.state_dict().items():
        if not value.isfinite().all():
            raise UserError(f"{path}: '{name}' has numbers that are not finite")


def read_state(path: Path) -> dict[str, Any]:
    """Read the tensors of a weights file by name: .safetensors, or a file of ``torch.save``.

    The state dict may be under the key "model" or "state_dict". No code of the file runs.

    Raises:
        UserError: the file does not exist, or is not a file of weights.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file of weights")
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except Exception as error:  # the library's own class, and torch's
            raise UserError(f"{path}: cannot be read as weights") from error
    state = read_torch(path, "cannot be read as weights")
    for key in ("model", "state_dict"):
        if isinstance(state, dict) and isinstance(state.get(key), dict):
            state = state[key]
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise UserError(f"{path}: does not hold a state dict")
    return state
