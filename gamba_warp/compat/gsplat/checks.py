"""What the calls with gsplat's signatures refuse, each in one line that names the argument."""

from __future__ import annotations

from enum import Enum
from typing import Any

from torch import Tensor

from gamba_warp.kernels.rasterize.checks import NOT_HERE

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_RASTERIZE_MODES = ("classic", "antialiased")
MAX_SIDE = 2**15  # pixels
MAX_SH_DEGREE = 4

# Options of ``rasterization`` that ask for what is not here, with the one value that asks for
# nothing. Those of the second part came after gsplat 1.5.3.
_OWN = ("absgrad", "covars")  # what only ``gamba_warp.kernels.rasterization`` does not have
_NEUTRAL: dict[str, Any] = {
    **{name: value for name, value in NOT_HERE.items() if name not in _OWN},
    "macro_tile": False,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "ut_params": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}


class RollingShutterType(Enum):
    """The shutters of gsplat's cameras; every pixel at once, ``GLOBAL``, is the one we have."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


def only(name: str, value: Any, allowed: Any) -> None:
    """Refuses an option that asks for what is not here.

    Args:
        name: of the argument.
        value: what it got.
        allowed: the one value that asks for nothing.

    Raises:
        ValueError: it got another one.
    """
    if isinstance(value, Tensor) or value != allowed:
        got = "a tensor" if isinstance(value, Tensor) else repr(value)
        raise ValueError(f"{name} is {got}, which is not supported: allowed is {allowed!r}")


def shape(name: str, value: Any, *allowed: tuple[int, ...]) -> None:
    """Refuses a tensor of another shape.

    Args:
        name: of the argument.
        value: what it got.
        allowed: the shapes that it may have.

    Raises:
        TypeError: it is no tensor.
        ValueError: it has another shape.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is {type(value).__name__}, allowed is a tensor")
    if tuple(value.shape) not in allowed:
        shapes = " or ".join(str(list(size)) for size in allowed)
        raise ValueError(f"{name} has shape {list(value.shape)}, allowed is {shapes}")


def positive(**numbers: float) -> None:
    """Refuses numbers that are not above 0, by their names.

    Raises:
        ValueError: one is not.
    """
    for name, value in numbers.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}, allowed is > 0")


def side(**pixels: int) -> None:
    """Refuses sizes of a picture that are no integers from 1 to 32,768, by their names.

    Raises:
        ValueError: one is not.
    """
    for name, value in pixels.items():
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_SIDE:
            raise ValueError(f"{name} is {value!r}, allowed are integers from 1 to {MAX_SIDE}")


def cameras(
    lead: tuple[int, ...], num: int, tensors: dict[str, Any], width: int, height: int
) -> None:
    """Checks what a projection is given beside the means.

    Args:
        lead: batch dimensions, which all tensors have.
        num: of Gaussians.
        tensors: ``viewmats`` and ``Ks``, and the others where they are not None.
        width: pixels.
        height: pixels.

    Raises:
        TypeError: one is no tensor.
        ValueError: one has another shape or device.
    """
    side(width=width, height=height)
    viewmats = tensors["viewmats"]
    views = viewmats.shape[-3] if isinstance(viewmats, Tensor) and viewmats.dim() > 2 else 1
    sizes = {
        "quats": (num, 4), "scales": (num, 3), "opacities": (num,), "viewmats": (views, 4, 4),
        "Ks": (views, 3, 3),
    }  # fmt: skip
    for name, value in tensors.items():
        if value is not None and name in sizes:
            shape(name, value, (*lead, *sizes[name]))
    one_device(tensors)


def one_device(tensors: dict[str, Any]) -> None:
    """Refuses tensors of several devices, or of one that has no kernels.

    Raises:
        ValueError: they are on more than one, or on one that is neither a CPU nor CUDA.
    """
    devices = {x.device for x in tensors.values() if isinstance(x, Tensor)}
    if len(devices) > 1 or not {device.type for device in devices} <= {"cpu", "cuda"}:
        names = ", ".join(sorted(map(str, devices)))
        raise ValueError(f"{', '.join(tensors)} are on {names}: allowed is one, cpu or cuda")


def means_of(means: Any) -> tuple[tuple[int, ...], int]:
    """The batch dimensions and the number of Gaussians.

    Raises:
        TypeError: it is no tensor.
        ValueError: it is not ``[.., N, 3]``.
    """
    if not isinstance(means, Tensor):
        raise TypeError(f"means is {type(means).__name__}, allowed is a tensor")
    if means.dim() < 2 or means.shape[-1] != 3:
        raise ValueError(f"means has shape {list(means.shape)}, allowed is [.., N, 3]")
    return tuple(means.shape[:-2]), means.shape[-2]


def rasterization_arguments(a: dict[str, Any]) -> tuple[int, ...]:
    """Checks the arguments of ``rasterization`` by name.

    Returns:
        The leading batch dimensions.

    Raises:
        TypeError: no tensor where one is asked for.
        ValueError: a shape, device or option that is not allowed.
    """
    for name, allowed in _NEUTRAL.items():
        only(name, a[name], allowed)
    shutter = a["rolling_shutter"]
    only("rolling_shutter", getattr(shutter, "name", shutter), "GLOBAL")
    for name, allowed in (("render_mode", RENDER_MODES), ("rasterize_mode", _RASTERIZE_MODES)):
        if a[name] not in allowed:
            raise ValueError(f"{name} is {a[name]!r}, allowed are {', '.join(allowed)}")
    positive(near_plane=a["near_plane"], eps2d=a["eps2d"])
    lead, num = means_of(a["means"])
    names = ["opacities", "viewmats", "Ks", *([] if a["covars"] is not None else _SHAPE)]
    for name in names:
        if not isinstance(a[name], Tensor):
            raise TypeError(f"{name} is {type(a[name]).__name__}, allowed is a tensor")
    tensors = {name: a[name] for name in (*names, "means", "covars", "colors", "backgrounds")}
    cameras(lead, num, tensors, a["width"], a["height"])
    if a["covars"] is not None:
        shape("covars", a["covars"], (*lead, num, 3, 3))
    _colors(a, lead, num)
    return lead


_SHAPE = ("quats", "scales")


def _colors(a: dict[str, Any], lead: tuple[int, ...], num: int) -> None:
    colors, degree, views = a["colors"], a["sh_degree"], a["viewmats"].shape[-3]
    if degree is not None and degree not in range(MAX_SH_DEGREE + 1):
        allowed = f"None and 0 to {MAX_SH_DEGREE}"
        raise ValueError(f"sh_degree is {degree!r}, allowed are {allowed}")
    if colors is None and a["render_mode"] in ("D", "ED"):
        return
    if not isinstance(colors, Tensor):
        modes = "a tensor (None in the modes D and ED)"
        raise TypeError(f"colors is {type(colors).__name__}, allowed is {modes}")
    tail = tuple(colors.shape[-1 if degree is None else -2 :])
    shape("colors", colors, (*lead, num, *tail), (*lead, views, num, *tail))
    if degree is not None and tail[0] < (degree + 1) ** 2:
        least = f"[.., N, K, D] with K >= {(degree + 1) ** 2}"
        raise ValueError(f"colors has shape {list(colors.shape)}, allowed is {least}")
    if tail[-1] < 1:
        raise ValueError(f"colors has shape {list(colors.shape)}, allowed is at least one channel")
    if a["backgrounds"] is not None and "RGB" in a["render_mode"]:
        shape("backgrounds", a["backgrounds"], (*lead, views, tail[-1]))
