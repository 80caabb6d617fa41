"""The model's configuration: one frozen dataclass, its presets and its JSON form."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Literal, get_args, get_origin, get_type_hints

from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..errors import UserError

Norm = Literal["layer", "rms"]
Discretization = Literal["mamba", "bilinear", "zoh"]
Background = Literal["white", "black"]


@dataclass(frozen=True, kw_only=True)
class GambaConfig:
    """Everything, apart from the weights, that decides what a Gamba network computes.

    Attributes:
        image_size: side H = W of the input picture, pixels; a multiple of ``patch_size``.
        patch_size: side p of the patches that become 3DGS tokens, pixels; the number of Gaussians
            is L = 4·(H/p)² (paper §3.2).
        width: channels D of a token.
        depth: number of Gamba blocks.
        state_size: SSM states per channel, 1 to 256.
        conv_size: taps of the causal convolution, 2 to 4.
        expand: inner channels of a block per channel of a token.
        dt_rank: rank of the step size's projection; 0 means ceil(width / 16), as in mamba-ssm.
        norm: normalisation before every block and before the decoder.
        discretization: of the selective scan; "mamba" is what mamba-ssm runs, "zoh" and "bilinear"
            are the exact zero-order hold and the paper's appendix.
        embedding_init: standard deviation of the learned embedding E at the start.
        additive_image_tokens: False makes G = E (paper Table 2, "w/o additive 3DGS tokens").
        prepend: False leaves out camera and image tokens (paper Table 2, "w/o Prepending").
        camera_token: whether the camera is prepended; the image tokens may be prepended alone.
        encoder: "none", "vgg16" or the name of a timm ViT, e.g. "vit_base_patch14_reg4_dinov2".
        encoder_size: side of the picture that the encoder sees, pixels.
        encoder_normalize: whether pictures are brought to the mean and deviation of the ViT's
            training.
        encoder_class_token: whether a ViT's class token is kept (register tokens never are).
        encoder_frozen: whether the encoder is left untrained, and out of checkpoints.
        decoder_width: channels of the decoder's shared MLP; 0 means ``width``.
        position_bins: points per axis of the position's softmax (paper: 21).
        position_range: the largest coordinate of the points, ±, object units (paper: 0.5).
        position_init: standard deviation of the position logits at the start.
        scale_init: standard deviation of a Gaussian at the start, object units.
        opacity_init: opacity at the start.
        predict_rotation: whether quaternions are predicted; the paper fixes them.
        distance: distance of the reference camera from the object's centre, object units.
        fov: vertical field of view of the reference camera, degrees.
        background: colour that the input picture is composited on.
    """

    image_size: int = 512
    patch_size: int = 8
    width: int = 512
    depth: int = 14
    state_size: int = 16
    conv_size: int = 4
    expand: int = 2
    dt_rank: int = 0
    norm: Norm = "layer"
    discretization: Discretization = "mamba"
    embedding_init: float = 0.5
    additive_image_tokens: bool = True
    prepend: bool = True
    camera_token: bool = True
    encoder: str = "vit_base_patch14_reg4_dinov2"
    encoder_size: int = 336
    encoder_normalize: bool = True
    encoder_class_token: bool = False
    encoder_frozen: bool = True
    decoder_width: int = 0
    position_bins: int = 21
    position_range: float = 0.5
    position_init: float = 1.5
    scale_init: float = 0.02
    opacity_init: float = 0.5
    predict_rotation: bool = False
    distance: float = DEFAULT_DISTANCE
    fov: float = DEFAULT_FOV
    background: Background = "white"

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for name, kind in hints.items():
            _check_kind(name, getattr(self, name), kind)
        may_be_zero = ("dt_rank", "decoder_width")
        for name, kind in hints.items():
            value = getattr(self, name)
            if kind not in (int, float) or (value == 0 and name in may_be_zero):
                continue
            if not 0 < value < math.inf:
                raise UserError(f"config: {name} is {value}, it must be positive")
        if self.image_size % self.patch_size:
            raise UserError(
                f"config: image_size {self.image_size} is not a multiple of "
                f"patch_size {self.patch_size}"
            )
        limits = {"state_size": (1, 256), "conv_size": (2, 4), "position_bins": (2, 4096)}
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise UserError(f"config: {name} is {getattr(self, name)}, not in {low}..{high}")
        if not self.opacity_init < 1:
            raise UserError(f"config: opacity_init is {self.opacity_init}, not in (0, 1)")
        if self.prepend and self.encoder == "none" and not self.camera_token:
            raise UserError("config: prepend needs a camera token or an encoder")
        if self.encoder == "vgg16" and not self.encoder_frozen:
            raise UserError("config: encoder vgg16 can only be used frozen")

    @property
    def grid_size(self) -> int:
        """H / p, the side of the patch grid."""
        return self.image_size // self.patch_size

    @property
    def num_gaussians(self) -> int:
        """L, the number of 3DGS tokens and of Gaussians."""
        return 4 * self.grid_size**2

    @property
    def inner_width(self) -> int:
        """Channels inside a Mamba block."""
        return self.expand * self.width

    @property
    def step_rank(self) -> int:
        """``dt_rank`` with its default filled in."""
        return self.dt_rank or -(-self.width // 16)

    @property
    def background_color(self) -> float:
        """The background's grey value: 1 (white) or 0 (black)."""
        return 1.0 if self.background == "white" else 0.0

    def to_json(self) -> str:
        """Returns one line of JSON with every field; ``from_json`` reads it back."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str, source: str = "config") -> GambaConfig:
        """Reads what ``to_json`` wrote.

        Args:
            text: a JSON object with exactly the fields of this class.
            source: origin of the text, for the error message.

        Raises:
            UserError: the text is not JSON, a key is unknown or missing, or a value has the wrong
                type or range.
        """
        try:
            values = json.loads(text)
        except ValueError as error:
            raise UserError(f"{source}: the model's configuration is not JSON ({error})") from error
        if not isinstance(values, dict):
            raise UserError(f"{source}: the model's configuration is not a JSON object")
        names = {field.name for field in fields(cls)}
        unknown, missing = sorted(set(values) - names), sorted(names - set(values))
        if unknown or missing:
            parts = [f"unknown {', '.join(unknown)}"] if unknown else []
            parts += [f"missing {', '.join(missing)}"] if missing else []
            raise UserError(f"{source}: the model's configuration has keys {'; '.join(parts)}")
        try:
            return cls(**values)
        except UserError as error:
            raise UserError(f"{source}: {error}") from error


def _check_kind(name: str, value: object, kind: type) -> None:
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise UserError(f"config: {name} is {value!r}, not one of {', '.join(get_args(kind))}")
        return
    fits = isinstance(value, (int, float) if kind is float else kind)
    if not fits or (isinstance(value, bool) and kind is not bool):
        raise UserError(f"config: {name} is {value!r}, it must be of type {kind.__name__}")


Preset = Literal["tiny", "small", "paper"]
PRESETS: dict[Preset, GambaConfig] = {
    # This one trains on two CPU cores; it has 4,096 Gaussians and no image encoder.
    "tiny": GambaConfig(
        image_size=128, patch_size=4, width=128, depth=6, encoder="none", encoder_size=128
    ),
    # This one trains on one small GPU; it has 9,216 Gaussians.
    "small": GambaConfig(
        image_size=192, patch_size=4, width=256, depth=10, encoder="vgg16", encoder_size=192
    ),
    # This is paper §4.1: 16,384 Gaussians, 576 image tokens from DINOv2 with registers.
    "paper": GambaConfig(dt_rank=32),
}
