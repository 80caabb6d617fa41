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
        raise ValueError(f"{name} has shape {list(value.shape)}, allowed is {shapes}")


def _check_options(options: dict) -> None:
    for name in ("width", "height"):
        value = options[name]
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_SIDE:
            raise ValueError(f"{name} is {value!r}, allowed are integers from 1 to {_MAX_SIDE}")
    if not options["near_plane"] > 0:
        raise ValueError(f"near_plane is {options['near_plane']}, allowed is > 0")
    if not options["eps2d"] >= 0:
        raise ValueError(f"eps2d is {options['eps2d']}, allowed is >= 0")
    low, high = options["alpha_min"], options["alpha_max"]
    if not 0 < low <= high < 1:
        raise ValueError(f"alpha_min, alpha_max are {low}, {high}, allowed is 0 < min <= max < 1")
    if not 1e-30 <= options["t_min"] < 1:
        raise ValueError(f"t_min is {options['t_min']}, allowed is 1e-30 <= t_min < 1")
    for name, allowed in (("render_mode", _RENDER_MODES), ("rasterize_mode", _RASTERIZE_MODES)):
        if options[name] not in allowed:
            raise ValueError(f"{name} is {options[name]!r}, allowed are {', '.join(allowed)}")
    degree = options["sh_degree"]
    if degree is not None and degree not in range(_MAX_SH_DEGREE + 1):
        raise ValueError(f"sh_degree is {degree!r}, allowed are None and 0 to {_MAX_SH_DEGREE}")


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
            raise TypeError(f"{name} is {type(value).__name__}, allowed is a tensor")
        if value.dtype not in _DTYPES:
            names = ", ".join(str(d).removeprefix("torch.") for d in _DTYPES)
            raise TypeError(f"{name} has dtype {value.dtype}, allowed are {names}")
        if value.device != device:
            raise ValueError(f"{name} is on {value.device}, means on {device}: allowed is one")
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"means is on {device}, allowed are cpu and cuda")

    means, viewmats, colors = tensors["means"], tensors["viewmats"], tensors["colors"]
    if means.dim() < 2 or means.shape[-1] != 3:
        raise ValueError(f"means has shape {list(means.shape)}, allowed is [.., N, 3]")
    *lead, num, _ = means.shape
    lead = tuple(lead)
    if viewmats.dim() < 3:
        raise ValueError(f"viewmats has shape {list(viewmats.shape)}, allowed is [.., V, 4, 4]")
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
                f"colors has shape {list(colors.shape)}, allowed is [.., N, K, 3] with K >= {least}"
            )
        _want("colors", colors, (*lead, num, coefficients, 3))
    else:
        if channels < 1:
            raise ValueError(
                f"colors has shape {list(colors.shape)}, allowed is [.., N, C], C >= 1"
            )
        _want("colors", colors, (*lead, num, channels), (*lead, views, num, channels))
    if tensors["backgrounds"] is not None:
        _want("backgrounds", tensors["backgrounds"], (*lead, views, channels))
    return lead
