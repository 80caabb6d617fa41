"""Gaussians and cameras of a rasterizer's case: what each kind does to them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..core.case import Case, generator
from ..core.ranges import DTYPES, fill

_PLAIN_KINDS = (
    "uniform", "needles", "discs", "points", "all sizes", "huge on screen", "around the camera",
    "near plane", "opaque", "faint", "equal depths", "close depths", "heap", "far away", "off axis",
)  # fmt: skip
# kind -> options that it fixes or draws
KINDS: dict[str, dict] = {
    **dict.fromkeys(_PLAIN_KINDS, {}),
    "odd quaternions": {"use_quats": True, "dtype": "float32"},
    "edge of range": {},
    "not finite": {"poison": (1, 2, 9)},
    "empty": {"num": (0, 0, 10), "views": (0, 1)},
}
LEADS = {"none": (), "one": (1,), "two": (2,), "two by one": (2, 1)}
GAUSSIAN = ("means", "quats", "scales", "opacities", "colors")
_DISTANCE = 1.6


def _points(kind: str, batch: int, num: int, g: torch.Generator) -> Tensor:
    """Centres ``[B, N, 3]`` in the first camera's frame (float64)."""
    normal = torch.randn(batch, num, 3, generator=g).double()
    uniform = torch.rand(batch, num, generator=g).double()
    points = 0.3 * normal
    points[..., 2] += _DISTANCE
    if kind == "around the camera":
        sign = torch.where(uniform < 0.5, -1.0, 1.0)
        points = normal * 10 ** (-4 * uniform[..., None])
        points[..., 2] = sign * 10 ** (2 - 6 * torch.rand(batch, num, generator=g).double())
    elif kind == "near plane":
        points[..., 2] = 0.01 * (1 + normal[..., 2] * 10 ** (-8 * uniform))
        points[..., :2] *= 0.01
    elif kind == "equal depths":
        points[..., 2] = _DISTANCE
    elif kind == "close depths":
        points[..., 2] = _DISTANCE * (1 + 1e-7 * normal[..., 2])
    elif kind == "heap":
        points[..., :2] *= 1e-4
    elif kind == "far away":
        points *= 1e4
    return points


def _cameras(o: dict, kind: str, batch: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """``viewmats [B, V, 4, 4]`` (float64) that look at the scene, ``Ks [B, V, 3, 3]``."""
    views, width, height = o["views"], o["width"], o["height"]
    rotation, _ = torch.linalg.qr(torch.randn(batch, views, 3, 3, generator=g).double())
    if kind in ("equal depths", "close depths"):
        rotation = torch.eye(3).double().expand_as(rotation)
    elif views:  # the others near the first
        rotation = rotation[:, :1] @ torch.linalg.matrix_exp(0.1 * (rotation - rotation.mT))
    viewmats = torch.zeros(batch, views, 4, 4).double()
    viewmats[..., :3, :3], viewmats[..., 2, 3], viewmats[..., 3, 3] = rotation, _DISTANCE, 1.0
    if kind == "far away":
        viewmats[..., 2, 3] *= 1e4
    K = torch.tensor([[1.3 * width, 0, 0.55 * width], [0, 0.9 * height, 0.45 * height], [0, 0, 1]])
    Ks = K.repeat(batch, views, 1, 1)
    if kind == "off axis":
        Ks[..., :2, 2] *= 8 * torch.rand(batch, views, 2, generator=g) - 3.5
    return viewmats, Ks


def _shapes(o: dict, kind: str, sizes: tuple[int, int], g: dict) -> dict[str, Tensor | None]:
    """Quaternions, scales (log-normal around 0.06 if the kind asks for nothing), opacities."""
    quats = torch.randn(*sizes, 4, generator=g["quats"])
    if kind == "odd quaternions":  # of any length, 0 included; some have one entry only
        uniform = torch.rand(*sizes, 1, generator=g["quats"])
        quats = torch.nn.functional.normalize(quats, dim=-1) * 10 ** (60 * uniform - 30)
        quats = torch.where(uniform < 0.1, 0.0, quats)
        quats = torch.where(uniform > 0.8, quats * torch.tensor([0.0, 1, 0, 0]), quats)
    uniform = torch.rand(*sizes, 3, generator=g["scales"])
    normal = torch.randn(*sizes, 3, generator=g["scales"])
    first = torch.tensor([1.0, 0.0, 0.0]).expand(*sizes, 3)
    scales = {
        "needles": 10 ** (-5 + (4.5 + 2 * uniform) * first),
        "discs": 10 ** (-5 + (4.5 + uniform) * (1 - first)),
        "points": 1e-9 * torch.exp(normal),
        "all sizes": 10 ** (-9 + 12 * uniform),
        "huge on screen": 10 ** (4 * uniform - 1),
        "edge of range": 10 ** (4 + 12 * uniform),
        "near plane": 10 ** (2 * uniform - 3),
        "around the camera": 10 ** (3 * uniform - 4),
    }.get(kind, 0.06 * torch.exp(0.5 * normal))
    uniform = torch.rand(sizes, generator=g["opacities"])
    opacities = 0.99 * uniform + 0.005
    if kind == "opaque":  # at the clamp, just below and above it, and at 1
        near = o["alpha_max"] + 2e-3 * (uniform - 0.25)
        opacities = torch.where(uniform < 0.5, near, 1 - uniform / 9)
    elif kind == "faint":
        around = o["alpha_min"] * (1 + 10 ** (-7 * uniform))
        around = torch.where(uniform < 0.3, o["alpha_min"] * (0.9 + uniform), around)
        opacities = torch.where(uniform > 0.9, torch.full_like(uniform, o["alpha_min"]), around)
    elif kind in ("huge on screen", "edge of range", "heap"):
        opacities = 0.3 * uniform
    quats = quats if o["use_quats"] else None
    return {"quats": quats, "scales": scales, "opacities": opacities}


def build(case: Case, device: torch.device) -> dict[str, Tensor | None]:
    """The leaves by argument (Ks asks for no gradient), leading dimensions as the case has them."""
    o, kind = case.options, case.kind
    lead, num = LEADS[o["lead"]], o["num"]
    batch = int(torch.tensor(lead).prod()) if lead else 1
    g = {name: generator(case, name) for name in (*GAUSSIAN, "camera", "rest")}
    viewmats, Ks = _cameras(o, kind, batch, g["camera"])
    points = _points(kind, batch, num, g["means"])
    if o["views"]:  # to the world: Rᵀ (p - t)
        points = (points - viewmats[:, :1, :3, 3]) @ viewmats[:, 0, :3, :3]
    colors = (batch, num, 16 if o["sh_degree"] == "3" else 5, 3)
    if o["sh_degree"] == "none":
        colors = (batch, *([o["views"]] if o["colors_per_view"] else []), num, o["channels"])
    made = {
        "means": points.float(),
        **_shapes(o, kind, (batch, num), g),
        "colors": fill(colors, o["colors"], g["colors"]),
    }
    dtype = DTYPES[o["dtype"]]
    limit = torch.finfo(dtype).max
    made = {k: x if x is None else x.clamp(-limit, limit).to(dtype) for k, x in made.items()}
    made |= {"viewmats": viewmats.float(), "Ks": Ks, "backgrounds": None}
    if o["backgrounds"]:
        shape = (batch, o["views"], o["channels"] if o["sh_degree"] == "none" else 3)
        made["backgrounds"] = torch.rand(shape, generator=g["rest"])
    shaped = {k: x if x is None else x.reshape(*lead, *x.shape[1:]) for k, x in made.items()}
    return {
        k: x if x is None else x.to(device).requires_grad_(k != "Ks") for k, x in shaped.items()
    }


def poisoned(case: Case, x: dict[str, Tensor | None]) -> tuple[dict[str, Tensor | None], Tensor]:
    """More Gaussians, each with one number that is not finite.

    Returns:
        The leaves with ``poison`` Gaussians strewn in, and where the old ones are, ``[N]``.
    """
    o, g = case.options, generator(case, "poison")
    num, more = o["num"], o["poison"]
    place = torch.randperm(num + more, generator=g)
    fresh, old = place[num:], place[:num].sort().values
    rows: dict[str, Tensor] = {}  # the axis of the Gaussians first
    for name in GAUSSIAN:
        if (known := x[name]) is not None:
            before = known.detach().cpu().movedim(gaussians_axis(o, name), 0)
            rows[name] = torch.full((num + more, *before.shape[1:]), 0.5, dtype=before.dtype)
            rows[name][old] = before
    names = list(rows)
    for i in fresh.tolist():  # the same entry in all objects and views
        name = names[torch.randint(len(names), (), generator=g)]
        row = rows[name][i]
        if name != "opacities":
            row = row[..., torch.randint(row.shape[-1], (), generator=g)]
        if name == "colors" and o["sh_degree"] != "none":
            row = row[..., 0]  # the first coefficient is always used
        row.fill_((torch.nan, torch.inf, -torch.inf)[torch.randint(3, (), generator=g)])
    made: dict[str, Any] = {**x}
    for name, row in rows.items():
        row = row.movedim(0, gaussians_axis(o, name)).contiguous()
        made[name] = row.to(made[name].device).requires_grad_()
    return made, old


def gaussians_axis(o: dict, name: str) -> int:
    """The dimension of a leaf along which the Gaussians lie."""
    return len(LEADS[o["lead"]]) + (name == "colors" and o["colors_per_view"])
