"""Gamba: one image to 3D Gaussians, with NVIDIA Warp kernels.

The public names load when they are used, so ``import gamba_warp`` imports no torch.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from .versions import __version__

_root = Path(__file__).resolve().parent.parent
if (_root / "setup.cfg").is_file():  # a checkout: sub-packages are next to this folder
    __path__.append(str(_root))

from .kernels.lazy import load_when_used  # noqa: E402 (in a checkout it is found only now)

if TYPE_CHECKING:
    from .cameras import Cameras
    from .gaussians import Gaussians
    from .model.checkpoint import load_model
    from .model.config import GambaConfig
    from .model.gamba import Gamba
    from .model.predict import reconstruct
    from .render import render

__all__ = [
    "Cameras",
    "Gamba",
    "GambaConfig",
    "Gaussians",
    "__version__",
    "load_model",
    "reconstruct",
    "render",
]

load_when_used(
    __name__,
    {
        "Cameras": ".cameras",
        "Gamba": ".model.gamba",
        "GambaConfig": ".model.config",
        "Gaussians": ".gaussians",
        "load_model": ".model.checkpoint",
        "reconstruct": ".model.predict",
        "render": ".render",
    },
)
