"""Configuration of the model: one frozen dataclass, its presets and its JSON form."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..errors import UserError
from ..untrusted.ranges import Meta, check_kinds, check_values

Norm = Literal["layer", "rms"]
Discretization = Literal["mamba", "bilinear", "zoh"]
Background = Literal["white", "black"]
Mixer = Literal["mamba", "attention"]
ImageTokens = Literal["prefix", "mixed"]
FinalNorm = Literal["same", "layer", "rms"]
Orders = Literal["backward", "mirrored"]
PositionWeights = Literal["softmax", "unit"]
Resize = Literal["bicubic", "bilinear"]
Back = Literal["learned", "opaque"]

# Fields missing in older files; the defaults describe their models.
_ADDED_LATER = {
    "decoder",
    *(f"ray_{name}" for name in ("cells", "coarse", "layers", "features", "hidden")),
    *(f"ray_{name}" for name in ("depth", "offset", "back")),
    *("final_norm", "scan_orders", "encoder_resize", "position_weights", "scale_factor"),
    *("mixer", "attention_heads", "attention_mlp", "mixed_tokens"),
    *("triplane_size", "triplane_features", "image_tokens", "num_orders"),
}

# Far above any trained model; files with larger values are rejected.
MAX_GAUSSIANS = 1 << 20
MAX_INNER_WIDTH = 1 << 15


@dataclass(frozen=True, kw_only=True)
class GambaConfig:
    """Architecture of a Gamba network: everything but the weights.

    Attributes:
        image_size: side H = W of the input image, pixels; a multiple of ``patch_size``.
        patch_size: side p of the patches that become 3DGS tokens, pixels; the number of Gaussians
            is L = 4·(H/p)² (paper §3.2), in general ``num_orders``·(H/p)².
        width: channels D of a token.
        depth: number of Gamba blocks.
        state_size: SSM states per channel, 1 to 256.
        conv_size: taps of the causal convolution, 2 to 4.
        expand: inner channels of a block per channel of a token; 32,768 inner channels at most.
        dt_rank: rank of the step size's projection; 0 means ceil(width / 16), as in mamba-ssm.
        mixer: token mixer of a block: "mamba", or "attention", a pre-norm transformer block of the
            same width (paper, question Q2) with the fields ``attention_*``.
        attention_heads: number of attention heads, a divisor of ``width``; 0 means one per 64
            channels, at least one.
        attention_mlp: hidden channels of a transformer block's MLP per channel of a token; 32,768
            at most. With 1 the block has about as many parameters as one of Mamba at expand 2.
        norm: normalisation before every block.
        final_norm: normalisation before the decoder; "same" as before the blocks.
        discretization: of the selective scan; "mamba" as in mamba-ssm, "zoh" and "bilinear" are the
            exact zero-order hold and the paper's appendix.
        scan_orders: the four orders of the patches: rows, columns, and "backward" both of them from
            the end (paper §3.2), or "mirrored" each row from its end and each column from its end.
        num_orders: number of these orders, from the first; each gives every patch a token.
        embedding_init: standard deviation of the learned embedding E at the start.
        additive_image_tokens: False makes G = E (paper Table 2, "w/o additive 3DGS tokens").
        mixed_tokens: True adds image tokens of patches of twice the side to the first quarter of
            the tokens; the others are only E (paper, answer A4). Needs an even number of patches a
            side.
        prepend: False leaves out camera and image tokens (paper Table 2, "w/o Prepending").
        image_tokens: position of the image tokens: "prefix" prepends them, "mixed" spreads them
            evenly among the 3DGS tokens (``model.parts.block.mixed_positions``). No difference for
            attention, which is invariant to the order.
        camera_token: prepend the camera; the image tokens may be prepended without it.
        encoder: "none", "vgg16" or the name of a timm ViT, e.g. "vit_base_patch14_reg4_dinov2".
        encoder_size: side of the encoder's input, pixels.
        encoder_resize: resizing to that size: "bicubic", antialiased, or "bilinear" between the
            four nearest pixels.
        encoder_normalize: normalise images to the mean and deviation of the ViT's training.
        encoder_class_token: keep a ViT's class token (register tokens are always dropped).
        encoder_frozen: do not train the encoder, and leave it out of checkpoints.
        decoder_width: channels of the decoder's shared MLP; 0 means ``width``.
        position_bins: points per axis of the position's softmax (paper: 21).
        position_weights: weights of the points from their logits: "softmax" (paper), or "unit", a
            vector of length 1: a coordinate may then be sqrt(bins / 3) times ``position_range``.
        position_range: the largest coordinate of the points, ±, object units (paper: 0.5).
        position_init: standard deviation of the position logits at the start.
        scale_factor: factor from a softplus to a standard deviation, object units.
        scale_init: standard deviation of a Gaussian at the start, object units.
        opacity_init: opacity at the start.
        predict_rotation: predict quaternions; the paper fixes them.
        decoder: "bins" is the paper's, one Gaussian a token; "rays" puts Gaussians on the rays of
            the input's pixels (``model.parts.rays``), with the fields ``ray_*``; "triplane" takes
            colours from three planes made by a second branch of blocks
            (``model.parts.triplane``; paper, question Q3).
        triplane_size: cells a side of a plane.
        triplane_features: channels of a plane.
        ray_cells: cells a side of a patch; divides ``patch_size``.
        ray_coarse: cells a side of a patch with their own features from the tokens; the features of
            ``ray_cells`` are interpolated from them. Divides ``ray_cells``; 0 means ``ray_cells``.
        ray_layers: Gaussians of a cell: the front one, and those for hidden parts.
        ray_features: channels of a cell's features.
        ray_hidden: channels of a layer between these and the Gaussians; 0 for no such layer.
        ray_depth: largest depth of a Gaussian before or behind the object's centre, object units.
        ray_offset: largest offset of a Gaussian from its ray on each axis, object units.
        ray_back: opacity of the last layer: "learned" per Gaussian, starting almost transparent, or
            "opaque" like its cell. Needs two layers.
        distance: distance of the reference camera from the object's centre, object units.
        fov: vertical field of view of the reference camera, degrees.
        background: background colour of the input image.
    """

    image_size: Annotated[int, Meta(ge=1, le=4096)] = 512
    patch_size: Annotated[int, Meta(ge=1, le=256)] = 8
    width: Annotated[int, Meta(ge=1, le=8192)] = 512
    depth: Annotated[int, Meta(ge=1, le=256)] = 14
    state_size: Annotated[int, Meta(ge=1, le=256)] = 16
    conv_size: Annotated[int, Meta(ge=2, le=4)] = 4
    expand: Annotated[int, Meta(ge=1, le=64)] = 2
    dt_rank: Annotated[int, Meta(ge=0, le=8192)] = 0
    mixer: Mixer = "mamba"
    attention_heads: Annotated[int, Meta(ge=0, le=8192)] = 0
    attention_mlp: Annotated[int, Meta(ge=1, le=64)] = 4
    norm: Norm = "layer"
    final_norm: FinalNorm = "same"
    scan_orders: Orders = "backward"
    num_orders: Annotated[int, Meta(ge=1, le=4)] = 4
    discretization: Discretization = "mamba"
    embedding_init: Annotated[float, Meta(gt=0, le=100)] = 0.5
    additive_image_tokens: bool = True
    mixed_tokens: bool = False
    prepend: bool = True
    image_tokens: ImageTokens = "prefix"
    camera_token: bool = True
    encoder: str = "vit_base_patch14_reg4_dinov2"
    encoder_size: Annotated[int, Meta(ge=1, le=4096)] = 336
    encoder_resize: Resize = "bicubic"
    encoder_normalize: bool = True
    encoder_class_token: bool = False
    encoder_frozen: bool = True
    decoder_width: Annotated[int, Meta(ge=0, le=8192)] = 0
    position_bins: Annotated[int, Meta(ge=2, le=4096)] = 21
    position_weights: PositionWeights = "softmax"
    position_range: Annotated[float, Meta(ge=1e-3, le=100)] = 0.5
    position_init: Annotated[float, Meta(gt=0, le=100)] = 1.5
    scale_factor: Annotated[float, Meta(ge=1e-3, le=100)] = 1.0
    scale_init: Annotated[float, Meta(ge=1e-6, le=10)] = 0.02
    opacity_init: Annotated[float, Meta(ge=1e-6, le=1 - 1e-6)] = 0.5
    predict_rotation: bool = False
    decoder: str = "bins"
    triplane_size: Annotated[int, Meta(ge=2, le=256)] = 32
    triplane_features: Annotated[int, Meta(ge=1, le=1024)] = 80
    ray_cells: Annotated[int, Meta(ge=1, le=256)] = 4
    ray_coarse: Annotated[int, Meta(ge=0, le=256)] = 0
    ray_layers: Annotated[int, Meta(ge=1, le=16)] = 4
    ray_features: Annotated[int, Meta(ge=1, le=1024)] = 48
    ray_hidden: Annotated[int, Meta(ge=0, le=1024)] = 0
    ray_depth: Annotated[float, Meta(ge=1e-3, le=100)] = 0.5
    ray_offset: Annotated[float, Meta(ge=1e-6, le=100)] = 0.3
    ray_back: Back = "learned"
    distance: Annotated[float, Meta(ge=1e-2, le=1000)] = DEFAULT_DISTANCE
    fov: Annotated[float, Meta(ge=0.1, le=179)] = DEFAULT_FOV
    background: Background = "white"

    def __post_init__(self) -> None:
        check_kinds(vars(self), type(self), "config: {} is".format)
        check_values(vars(self), type(self), "config: {} is".format)
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,100}", self.encoder):
            raise UserError(f"config: encoder is {self.encoder[:100]!r}, not a network's name")
        self._check_relations()
        limits = {
            "num_gaussians": MAX_GAUSSIANS,
            "inner_width": MAX_INNER_WIDTH,
            "mlp_width": MAX_INNER_WIDTH,
        }
        for name, limit in limits.items():
            if getattr(self, name) > limit:
                raise UserError(f"config: {name} is {getattr(self, name):,}, over {limit:,}")

    def _check_relations(self) -> None:
        """Raise for inconsistent fields."""
        rays, attention = self.decoder == "rays", self.mixer == "attention"
        multiples = {
            ("image_size", "patch_size"): True,
            ("patch_size", "ray_cells"): rays,
            ("ray_cells", "ray_coarse"): rays and self.ray_coarse > 0,
            ("width", "num_heads"): attention,
        }
        for (whole, part), asked in multiples.items():
            if asked and getattr(self, whole) % getattr(self, part):
                raise UserError(
                    f"config: {whole} {getattr(self, whole)} is not a multiple of "
                    f"{part} {getattr(self, part)}"
                )
        if rays and self.ray_back == "opaque" and self.ray_layers < 2:
            raise UserError("config: ray_back opaque needs two ray_layers, the front and the back")
        if self.prepend and self.encoder == "none" and not self.camera_token:
            raise UserError("config: prepend needs a camera token or an encoder")
        if self.image_tokens == "mixed" and not self.prepend:
            raise UserError("config: image_tokens mixed needs prepend")
        if self.mixed_tokens and (rays or not self.additive_image_tokens):
            raise UserError("config: mixed_tokens needs additive_image_tokens, and no decoder rays")
        if self.mixed_tokens and self.grid_size % 2:
            raise UserError(f"config: mixed_tokens needs an even grid, not {self.grid_size}²")
        if self.encoder == "vgg16" and not self.encoder_frozen:
            raise UserError("config: encoder vgg16 can only be used frozen")

    @property
    def grid_size(self) -> int:
        """H / p, the side of the patch grid."""
        return self.image_size // self.patch_size

    @property
    def token_patch(self) -> int:
        """Side of the patches that 3DGS tokens encode, pixels."""
        return self.patch_size * (2 if self.mixed_tokens else 1)

    @property
    def num_tokens(self) -> int:
        """L, the number of 3DGS tokens."""
        return self.num_orders * self.grid_size**2

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians: L, or with "rays" the number for an image without background."""
        if self.decoder == "rays":
            return self.ray_layers * (self.grid_size * self.ray_cells) ** 2
        return self.num_tokens

    @property
    def input_channels(self) -> int:
        """Channels of the images that the network takes: RGB, or with "rays" RGBA."""
        return 4 if self.decoder == "rays" else 3

    @property
    def pixel_channels(self) -> int:
        """Channels of a pixel in a 3DGS token: the image's, and its Plücker ray."""
        return self.input_channels + 6

    @property
    def inner_width(self) -> int:
        """Channels inside a Mamba block."""
        return self.expand * self.width

    @property
    def num_heads(self) -> int:
        """``attention_heads`` with its default filled in."""
        return self.attention_heads or max(1, self.width // 64)

    @property
    def mlp_width(self) -> int:
        """Channels inside the MLP of a transformer block."""
        return self.attention_mlp * self.width

    @property
    def step_rank(self) -> int:
        """``dt_rank`` with its default filled in."""
        return self.dt_rank or -(-self.width // 16)

    @property
    def background_color(self) -> float:
        """Grey value of the background: 1 (white) or 0 (black)."""
        return 1.0 if self.background == "white" else 0.0

    def to_json(self) -> str:
        """Return one line of JSON with every field; ``from_json`` reads it back."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str | bytes, source: str = "config") -> GambaConfig:
        """Read the JSON of ``to_json``.

        Args:
            text: a JSON object with exactly the fields of this class.
            source: origin of the text, for the error message.

        Raises:
            UserError: the text is not JSON, a key is unknown or missing, or a value has the wrong
                type or range.
        """
        from ..untrusted.documents import parse_document  # `make gpu` has no msgspec

        where = f"{source}: the model's configuration"
        values = parse_document(text, dict[str, Any], where)
        names = {field.name for field in fields(cls)}
        unknown, missing = sorted(set(values) - names), sorted(names - set(values) - _ADDED_LATER)
        if unknown or missing:
            parts = [f"unknown {_shortened(unknown)}"] if unknown else []
            parts += [f"missing {_shortened(missing)}"] if missing else []
            raise UserError(f"{where} has keys {'; '.join(parts)}")
        try:
            return cls(**values)
        except UserError as error:
            raise UserError(f"{source}: {error}") from error


def _shortened(names: list[str]) -> str:
    """Join the first names of a list of any length from an untrusted file."""
    shown = [name if name.isidentifier() else repr(name[:40]) for name in names[:8]]
    return ", ".join(shown) + (", ..." if len(names) > 8 else "")


Preset = Literal["tiny", "rays", "small", "paper", "released"]
PRESETS: dict[Preset, GambaConfig] = {
    # Trains on two CPU cores; 4,096 Gaussians and no image encoder.
    "tiny": GambaConfig(
        image_size=128, patch_size=4, width=128, depth=6, encoder="none", encoder_size=128
    ),
    # Trains on two CPU cores, too: three Gaussians on the ray of each pixel of the object.
    "rays": GambaConfig(
        image_size=128,
        width=192,
        depth=8,
        encoder="none",
        encoder_size=128,
        decoder="rays",
        ray_cells=8,
        ray_coarse=4,
        ray_layers=3,
        ray_features=48,
        ray_hidden=64,
        ray_back="opaque",
    ),
    # Trains on one small GPU; 9,216 Gaussians.
    "small": GambaConfig(
        image_size=192, patch_size=4, width=256, depth=10, encoder="vgg16", encoder_size=192
    ),
    # Paper §4.1: 16,384 Gaussians, 576 image tokens from DINOv2 with registers.
    "paper": GambaConfig(dt_rank=32),
    # The authors' public code and weights (``gamba import-released``).
    "released": GambaConfig(
        final_norm="rms",
        scan_orders="mirrored",
        dt_rank=32,
        camera_token=False,
        encoder_resize="bilinear",
        encoder_normalize=False,
        encoder_class_token=True,
        decoder_width=128,
        position_weights="unit",
        position_range=0.4,
        scale_factor=0.1,
        scale_init=0.0153,
        opacity_init=0.1,
    ),
}
