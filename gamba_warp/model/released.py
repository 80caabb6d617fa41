"""Import of the authors' public weights: the preset ``released``, and the mapping of names.

Their world has y up and z towards the camera, ours y down and z away from it (OpenCV). The two
differ by the signs of y and z, and so do rays and centres. The import changes the weights
accordingly: the channels of the rays change their sign, and the position's points of y and z, which
are symmetric about 0, their order. The network itself needs no change.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..errors import UserError
from .checkpoint import outline
from .config import PRESETS, GambaConfig
from .encoders import Weights, read_state
from .gamba import Gamba

DEPTH = PRESETS["released"].depth  # blocks of the published network
_ROOT, _ENCODER = "model.", "model.map_image.model."
_BLOCK = "transformer.layers.{}."
# Their names to ours, of a block and of the rest.
_IN_BLOCK = {
    "cond_affine.weight": "project_image.weight",
    "cond_affine.bias": "project_image.bias",
    "mamba_block.norm.weight": "norm.weight",
    "mamba_block.norm.bias": "norm.bias",
    **{
        f"mamba_block.mixer.{name}": f"mamba.{name}"
        for name in (
            "A_log", "D", "in_proj.weight", "x_proj.weight", "dt_proj.weight", "dt_proj.bias",
            "out_proj.weight",
        )
    },
    "mamba_block.mixer.conv1d.weight": "mamba.conv_weight",
    "mamba_block.mixer.conv1d.bias": "mamba.conv_bias",
}  # fmt: skip
_NAMES = {
    "stem_layer.weight": "tokens.patchify.weight",
    "stem_layer.bias": "tokens.patchify.bias",
    "transformer.pos_embed": "tokens.embedding",
    "transformer.norm_f.weight": "norm.weight",
}
for _theirs, _ours in (
    ("mlp_net.layers.0", "mlp.0"), ("mlp_net.layers.2", "mlp.2"), ("gs_layer.xyz", "position"),
    ("gs_layer.opacity", "opacity"), ("gs_layer.scale", "scale"), ("gs_layer.rgb", "color"),
):  # fmt: skip
    for _end in ("weight", "bias"):
        _NAMES[f"decoder.{_theirs}.{_end}"] = f"decoder.{_ours}.{_end}"
_COORDS, _STEM = "decoder.coords", "stem_layer.weight"
_WRAPPERS = re.compile(r"(?<![^.])(?:module|_orig_mod)\.")
# DINOv2 with registers, by the channels of its tokens.
_VITS = {
    channels: f"vit_{size}_patch14_reg4_dinov2"
    for channels, size in ((384, "small"), (768, "base"), (1024, "large"), (1536, "giant"))
}
# Channels of a pixel (RGB, o × d, d) that change their sign between the two worlds.
_FLIPPED = [4, 5, 7, 8]


def load_released(
    path: str | Path, encoder_weights: Weights | None = None, depth: int = DEPTH
) -> Gamba:
    """Load the authors' file of weights as a model with the peculiarities of their code.

    Args:
        path: a file of their training, in any float dtype, with or without DINOv2's weights under
            ``model.map_image``.
        encoder_weights: as for ``build_encoder``, instead of those in the file.
        depth: the expected number of blocks.

    Returns:
        The model, float32 on the CPU, in eval mode.

    Raises:
        UserError: the file is missing, of another network, or lacks DINOv2's weights and none are
            given.
    """
    path = Path(path)
    state = _plain_names(read_state(path), str(path))
    encoder = {
        name.removeprefix(_ENCODER): value.float() if isinstance(value, Tensor) else value
        for name, value in state.items()
        if name.startswith(_ENCODER)
    }
    config, weights = convert_released(state, str(path), depth)
    if encoder_weights is None and not encoder:
        raise UserError(
            f"{path}: has no image encoder (model.map_image); give a file of DINOv2's weights"
        )
    model = Gamba(config, encoder if encoder_weights is None else encoder_weights)
    model.load_stored_state(weights)
    return model.eval()


def convert_released(
    state: dict[str, Any], path: str, depth: int = DEPTH
) -> tuple[GambaConfig, dict[str, Tensor]]:
    """Convert their state dict to a configuration and weights with our names.

    Args:
        state: their state dict, its names behind any prefix. Tensors of the image encoder, and
            those without the prefix, are ignored. ``module.`` and ``_orig_mod.``, added to names
            by training on several GPUs and by torch's compiler, are removed.
        path: for the error message.
        depth: the expected number of blocks: missing last blocks cannot be detected otherwise.

    Returns:
        The preset ``released`` at the sizes of the tensors, and a float32 state for
        ``load_stored_state``.

    Raises:
        UserError: a tensor is missing, unknown, not finite or of an impossible shape.
    """
    tensors: dict[str, Tensor] = {}
    stored = torch.float32
    for name, value in _plain_names(state, path).items():
        if not name.startswith(_ROOT) or name.startswith(_ENCODER):
            continue
        if not isinstance(value, Tensor) or not value.is_floating_point():
            raise UserError(f"{path}: '{name[:100]}' is not a tensor of floating-point numbers")
        stored = value.dtype if name == _ROOT + _COORDS else stored
        value = value.float()
        if not value.isfinite().all():
            raise UserError(f"{path}: '{name[:100]}' has numbers that are not finite")
        tensors[name.removeprefix(_ROOT)] = value
    try:
        config = _config(tensors, stored)
        if config.depth != depth:
            raise UserError(
                f"holds {config.depth} blocks, not {depth}: a part is missing, or it is another "
                f"network, which --depth {config.depth} accepts"
            )
        weights = _rename(tensors, config.depth)
        shapes = {name: value.shape for name, value in weights.items()}
        outline(config).check_stored_state(shapes)  # before allocating memory
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except KeyError as error:
        raise UserError(f"{path}: not the released network: no tensor {error.args[0]!r}") from error
    except ValueError as error:
        raise UserError(f"{path}: not the released network: {error}") from error
    if tensors:
        first = sorted(tensors)[0][:100]
        raise UserError(f"{path}: has an unknown tensor '{_ROOT}{first}' ({len(tensors)} in total)")
    return config, weights


def _plain_names(state: dict[str, Any], path: str) -> dict[str, Any]:
    """Restore the names of their code: without the parts of wrappers, and below ``model.``.

    The prefix of the network's own tensors may be any.
    """
    plain = {_WRAPPERS.sub("", name): value for name, value in state.items()}
    if len(plain) < len(state):
        raise UserError(f"{path}: has a tensor twice, with 'module.' or '_orig_mod.' and without")
    roots = [name.removesuffix(_STEM) for name in plain if name.endswith(_STEM)]
    root = min(roots, key=len, default=_ROOT)
    return {
        _ROOT + name.removeprefix(root): value
        for name, value in plain.items()
        if name.startswith(root)
    }


def released_names(depth: int) -> dict[str, str]:
    """Map their names of tensors, without ``model.``, to ours, for ``depth`` blocks."""
    names = dict(_NAMES)
    for n in range(depth):
        names |= {f"{_BLOCK.format(n)}{k}": f"blocks.{n}.{v}" for k, v in _IN_BLOCK.items()}
    return names


def _shape(tensors: dict[str, Tensor], name: str, axes: int) -> list[int]:
    shape = list(tensors[name].shape)
    if len(shape) != axes:
        raise ValueError(f"'{name}' has shape {shape}, not {axes} axes")
    return shape


def _config(tensors: dict[str, Tensor], stored: torch.dtype) -> GambaConfig:
    """Preset at the sizes of the tensors, with their points, stored in the given dtype."""
    width, _, patch, _ = _shape(tensors, "stem_layer.weight", 4)
    tokens, _ = _shape(tensors, "transformer.pos_embed", 2)
    block = _BLOCK.format(0)
    _, channels = _shape(tensors, block + "cond_affine.weight", 2)
    inner, states = _shape(tensors, block + "mamba_block.mixer.A_log", 2)
    _, _, taps = _shape(tensors, block + "mamba_block.mixer.conv1d.weight", 3)
    _, rank = _shape(tensors, block + "mamba_block.mixer.dt_proj.weight", 2)
    hidden, _ = _shape(tensors, "decoder.mlp_net.layers.0.weight", 2)
    bins = _shape(tensors, _COORDS, 2)[1]
    points = tensors.pop(_COORDS)
    limit = _decimal(points[0, -1].to(stored)) if points.numel() else 0.0
    even = torch.linspace(-limit, limit, bins, dtype=torch.float32)
    # Rounding moves the evenly spaced points by at most half a unit in the last place of the
    # largest: 0.0016 in bfloat16 at 0.4, where the points are 0.04 apart. 1e-6 covers the error of
    # the sum that made a float32 point.
    near = max(1e-6, limit * torch.finfo(stored).eps)
    if points.shape[0] != 3 or bins < 2 or not torch.allclose(points, even, rtol=0, atol=near):
        raise ValueError(f"'{_COORDS}' is not the same evenly spaced points on three axes")
    grid = round((tokens / 4) ** 0.5)
    if tokens != 4 * grid**2 or not grid:
        raise ValueError(f"'transformer.pos_embed' has {tokens} tokens, not four for each patch")
    if channels not in _VITS:
        raise ValueError(f"'{block}cond_affine.weight' takes {channels} channels, not DINOv2's")
    names = (re.match(r"transformer\.layers\.(\d{1,4})\.", name) for name in tensors)
    depth = 1 + max(int(match[1]) for match in names if match)
    fields = vars(PRESETS["released"]) | {
        "image_size": grid * patch,
        "patch_size": patch,
        "width": width,
        "depth": depth,
        "state_size": states,
        "conv_size": taps,
        "expand": max(1, inner // max(1, width)),
        "dt_rank": rank,
        "encoder": _VITS[channels],
        "decoder_width": hidden,
        "position_bins": bins,
        "position_range": limit,
    }
    return GambaConfig(**fields)


def _decimal(value: Tensor) -> float:
    """Shortest decimal that is stored as this number: 0.4 for bfloat16's 0.400390625."""
    numbers = (float(f"{float(value):.{digits}g}") for digits in range(1, 18))
    return next(x for x in numbers if float(torch.tensor(x).to(value.dtype)) == float(value))


def _rename(tensors: dict[str, Tensor], depth: int) -> dict[str, Tensor]:
    """Move their tensors out of ``tensors``, with our names and in our world."""
    weights = {ours: tensors.pop(theirs) for theirs, ours in released_names(depth).items()}
    for n in range(depth):
        weights[f"blocks.{n}.mamba.conv_weight"] = weights[f"blocks.{n}.mamba.conv_weight"][:, 0]
    stem = weights["tokens.patchify.weight"].clone()
    if stem.shape[1] != 9:
        raise ValueError(f"'stem_layer.weight' takes {stem.shape[1]} channels, not 9")
    stem[:, _FLIPPED] *= -1
    weights["tokens.patchify.weight"] = stem
    for end in ("weight", "bias"):
        x, *others = weights[f"decoder.position.{end}"].tensor_split(3)
        weights[f"decoder.position.{end}"] = torch.cat([x, *(part.flip(0) for part in others)])
    return weights
