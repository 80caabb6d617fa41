"""Settings of rendered views, importable by the commands without slow modules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from msgspec import Meta

from gamba_warp.conventions import DEFAULT_FOV

if TYPE_CHECKING:
    import numpy as np

Up = Literal["auto", "y", "z"]
SPREAD = 0.2  # default of the largest fraction by which a distance exceeds the least one
# Fields of view of 20° to 70°, one per object, log-uniform.
VARIED_CAMERAS: dict[str, Any] = {"fov": 37.4, "fov_spread": 1.87, "spread": 0.3}


@dataclass(frozen=True)
class Settings:
    """Settings that determine the pixels; stored in every ``transforms.json``.

    Attributes:
        views: Number of views of an object.
        size: Pixels a side.
        fov: Vertical field of view, degrees.
        seed: Seed of cameras and lights, which also depend on the object's uid.
        depth: Also write 16-bit depth images, of the first and of the last surface.
        format: Format of the images; both are lossless.
        up: The axis that points up in the files; auto: y for .obj, .glb and .gltf, z for others.
        fronts: Number of views from the front, the first ones.
        spread: Largest fraction by which a camera stands further away than necessary.
        stretch: Stretch each object along each axis by a factor between 1 / STRETCH and STRETCH.
        fov_spread: Draw each object's field of view between FOV / FOV_SPREAD and FOV * FOV_SPREAD.
        light: randomized makes the lights of the objects differ more.
        poses: "drawn", or "gso": that evaluation's poses, the input view first.
    """

    views: Annotated[int, Meta(ge=1, le=10_000)] = 24
    size: Annotated[int, Meta(ge=8, le=4096)] = 128
    fov: Annotated[float, Meta(ge=5, le=120)] = DEFAULT_FOV
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    depth: bool = False
    format: Literal["webp-lossless", "png"] = "webp-lossless"
    up: Up = "auto"
    fronts: Annotated[int, Meta(ge=0, le=10_000)] = 1
    spread: Annotated[float, Meta(ge=0, le=10)] = SPREAD
    stretch: Annotated[float, Meta(ge=1, le=10)] = 1.0
    fov_spread: Annotated[float, Meta(ge=1, le=4)] = 1.0
    light: Literal["default", "randomized"] = "default"
    poses: tyro.conf.Suppress[Literal["drawn", "gso"]] = "drawn"

    def drawn(self, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """Draw the stretch along the file's axes ``[3]`` and the field of view of an object."""
        import numpy as np  # not at the top: `--help` of a command shows these fields

        stretch = np.exp(rng.uniform(-1, 1, 3) * np.log(self.stretch))
        fov = self.fov * float(np.exp(rng.uniform(-1, 1) * np.log(self.fov_spread)))
        return stretch, fov
