"""Checks of the arguments of ``rasterization``, before any launch."""

from typing import Any

import torch
from torch import Tensor

_DTYPES = (torch.float32, torch.bfloat16, torch.float16)
_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_RASTERIZE_MODES = ("classic", "antialiased")
_MAX_SIDE = 2**15  # pixels
_MAX_SH_DEGREE = 3


def _want(name: str, value: Tensor, *allowed: tuple) -> None:
    if tuple(value.shape) not in allowed:
        shapes = " or ".join(str(list(shape)) for shape in allowed)
        raise ValueError(f"{name} must have shape {shapes}, got {list(value.shape)}")


def _check_options(options: dict) -> None:
    for name in ("width", "height"):
        value = options[name]
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_SIDE:
            raise ValueError(f"{name} must be an integer from 1 to {_MAX_SIDE}, got {value!r}")
    if not options["near_plane"] > 0:
        raise ValueError(f"near_plane must be > 0, got {options['near_plane']}")
    if not options["eps2d"] >= 0:
        raise ValueError(f"eps2d must be >= 0, got {options['eps2d']}")
    low, high = options["alpha_min"], options["alpha_max"]
    if not 0 < low <= high < 1:
        raise ValueError(
            f"alpha_min and alpha_max must satisfy 0 < min <= max < 1, got {low}, {high}"
        )
    if not 1e-30 <= options["t_min"] < 1:
        raise ValueError(f"t_min must be in [1e-30, 1), got {options['t_min']}")
    for name, allowed in (("render_mode", _RENDER_MODES), ("rasterize_mode", _RASTERIZE_MODES)):
        if options[name] not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {options[name]!r}")
    degree = options["sh_degree"]
    if degree is not None and degree not in range(_MAX_SH_DEGREE + 1):
        raise ValueError(f"sh_degree must be None or 0 to {_MAX_SH_DEGREE}, got {degree!r}")


def check_inputs(tensors: dict[str, Any], options: dict) -> tuple[int, ...]:
    """Checks the arguments of ``rasterization`` by name.

    Returns:
        The leading batch dimensions.

    Raises:
        TypeError: no tensor, or another dtype.
        ValueError: a shape, device or option that is not allowed.
    """
    _check_options(options)
    device = getattr(tensors["means"], "device", None)
    for name, value in tensors.items():
        if value is None and name in ("quats", "backgrounds"):
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
        if value.dtype not in _DTYPES:
            names = ", ".join(str(d).removeprefix("torch.") for d in _DTYPES)
            raise TypeError(f"{name} must have dtype {names}, got {value.dtype}")
        if value.device != device:
            raise ValueError(f"{name} must be on {device}, as means, got {value.device}")
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"means must be on cpu or cuda, got {device}")

    means, viewmats, colors = tensors["means"], tensors["viewmats"], tensors["colors"]
    if means.dim() < 2 or means.shape[-1] != 3:
        raise ValueError(f"means must have shape [.., N, 3], got {list(means.shape)}")
    *lead, num, _ = means.shape
    lead = tuple(lead)
    if viewmats.dim() < 3:
        raise ValueError(f"viewmats must have shape [.., V, 4, 4], got {list(viewmats.shape)}")
    views = viewmats.shape[-3]
    _want("scales", tensors["scales"], (*lead, num, 3))
    _want("opacities", tensors["opacities"], (*lead, num))
    _want("viewmats", viewmats, (*lead, views, 4, 4))
    _want("Ks", tensors["Ks"], (*lead, views, 3, 3))
    if tensors["quats"] is not None:
        _want("quats", tensors["quats"], (*lead, num, 4))
    channels = colors.shape[-1] if colors.dim() else 0
    if options["sh_degree"] is not None:
        least = (options["sh_degree"] + 1) ** 2
        coefficients = colors.shape[-2] if colors.dim() >= 2 else 0
        if coefficients < least:
            raise ValueError(
                f"colors must have shape [.., N, K, 3] with K >= {least}, got {list(colors.shape)}"
            )
        _want("colors", colors, (*lead, num, coefficients, 3))
    else:
        if channels < 1:
            raise ValueError(f"colors must have shape [.., N, C], C >= 1, got {list(colors.shape)}")
        _want("colors", colors, (*lead, num, channels), (*lead, views, num, channels))
    if tensors["backgrounds"] is not None:
        _want("backgrounds", tensors["backgrounds"], (*lead, views, channels))
    return lead
