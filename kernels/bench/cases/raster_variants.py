"""What the cases of the rasterizer share: scenes, variants and limits."""

from __future__ import annotations

from functools import partial

from ..core.case import Settings, Variant
from .raster_scene import Scene, orbit_cameras, shell

# Allowed relative rms error to float64; a knob that trades accuracy is allowed the more it trades.
FORWARD_LIMIT, BACKWARD_LIMIT, TRADE_LIMIT = 1e-4, 1e-3, 10.0
BOTH = "forward+backward"
COUNT = 16384
_SIZE = 512


def make_scene(
    settings: Settings,
    scale: float = 1.0,
    count: int | None = None,
    size: int | None = None,
    views: int = 1,
) -> Scene:
    """The shell; a quick run has an eighth of the Gaussians and a quarter of the pixels."""
    quick = settings.level == "quick"
    count = count or (COUNT // 8 if quick else COUNT)
    size = size or (_SIZE // 2 if quick else _SIZE)
    return Scene(shell(count, scale), *orbit_cameras(views, size), size, settings.device)


def sizes_of(scene: Scene) -> dict[str, int]:
    """A scene's sizes, for tables and charts."""
    count, views = scene.gaussians["opacities"].shape[-1], scene.viewmats.shape[:-2].numel()
    return {"N": count, "side": scene.size, "views": views}


def make_variant(
    scene: Scene, name: str, direction: str = "forward", limit: float | None = None, **changes
) -> Variant:
    """A variant that calls the operator on a scene."""
    backward = direction == BOTH
    return Variant(
        name=name,
        run=scene.backward if backward else scene.forward,
        check=partial(scene.check, backward),
        limit=limit or (BACKWARD_LIMIT if backward else FORWARD_LIMIT),
        oracle=scene.oracle(backward),
        direction=direction,
        parameters=sizes_of(scene),
        work=partial(scene.work, backward),
        **changes,
    )


def make_pair(scene: Scene, name: str, **changes) -> list[Variant]:
    """Forward, and forward with all gradients."""
    return [make_variant(scene, name, direction, **changes) for direction in ("forward", BOTH)]
