"""Camera paths about an object."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..cameras import Cameras, intrinsics, orbit
from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..gaussians import Gaussians

SWING = 30.0  # amplitude of a spiral's elevation, degrees
TURNS = 2  # of a spiral


@dataclass(frozen=True)
class Viewpoint:
    """Position of a camera that looks at an object.

    Attributes:
        elevation: degrees; a camera of positive elevation looks down.
        distance: of the camera from the object's centre, object units.
        fov: field of view of the image's shorter side, degrees.
    """

    elevation: float = 0.0
    distance: float = DEFAULT_DISTANCE
    fov: float = DEFAULT_FOV

    @property
    def camera(self) -> tuple[float, float, float]:
        """Distance, field of view and elevation, in the order of ``viewer.page.viewer_page``."""
        return self.distance, self.fov, self.elevation

    def changed(
        self,
        elevation: float | None = None,
        distance: float | None = None,
        fov: float | None = None,
    ) -> Viewpoint:
        """Return the viewpoint with some values replaced; None keeps a value.

        A new field of view without a distance keeps the object's size in the image by moving the
        camera.
        """
        if fov is not None and distance is None:
            before, after = (math.tan(math.radians(angle) / 2) for angle in (self.fov, fov))
            distance = self.distance * before / after
        given = {"elevation": elevation, "distance": distance, "fov": fov}
        return replace(self, **{name: x for name, x in given.items() if x is not None})


FRONT = Viewpoint()


def turntable(frames: int, view: Viewpoint = FRONT, size: int | tuple[int, int] = 256) -> Cameras:
    """Return one full turn about the origin at one elevation; the first camera has azimuth 0.

    Args:
        frames: number of cameras, >= 1.
        view: of the first camera.
        size: side of square images, or width and height, pixels.

    Returns:
        Cameras ``[frames]``, float32 on the CPU, in a world where up is -y (see ``orbit``).
    """
    azimuths = torch.arange(frames) * (360.0 / frames)
    return _around(azimuths, view.elevation, view, size)


def spiral(frames: int, view: Viewpoint = FRONT, size: int | tuple[int, int] = 256) -> Cameras:
    """Return ``TURNS`` turns about the origin with a varying elevation.

    The elevation follows one period of a sine of ``SWING`` degrees about the view's, so that the
    path is closed and shows the object from above and below. Arguments as for ``turntable``.
    """
    fraction = torch.arange(frames) / frames
    rise = view.elevation + SWING * torch.sin(2 * math.pi * fraction)
    return _around(360.0 * TURNS * fraction, rise.clamp(-90, 90), view, size)


def _around(
    azimuths: Tensor, elevation: float | Tensor, view: Viewpoint, size: int | tuple[int, int]
) -> Cameras:
    width, height = (size, size) if isinstance(size, int) else size
    K = intrinsics(width, height, view.fov)
    if width < height:  # the angle applies to the width, so that a centred object is not cropped
        K[[0, 1], [0, 1]] *= width / height
    viewmats = orbit(azimuths, elevation, view.distance)
    return Cameras(viewmats, K.expand(len(azimuths), 3, 3), width, height)


def upright(elevation: float) -> Tensor:
    """Return the rotation ``[3, 3]`` float32 from a camera of this elevation to an upright world.

    Args:
        elevation: of the camera above the object, degrees.

    Returns:
        Rotates points in the camera's axes, about the object's centre, into a world whose up is -y:
        there the camera is ``orbit([0], elevation)``.
    """
    return orbit(torch.zeros(1), elevation)[0, :3, :3].T.contiguous()


def set_up(gaussians: Gaussians, elevation: float) -> Gaussians:
    """Rotate an object from the axes of a camera of this elevation, degrees, to ``upright``."""
    if not elevation:
        return gaussians
    turn = upright(elevation).to(gaussians.means)
    return gaussians.transformed(turn, torch.zeros_like(turn[0]))


def placed(cameras: Cameras, center: Tensor, side: float) -> Cameras:
    """Convert cameras from an object's unit frame to the frame with its position and size.

    Args:
        cameras: ``[V]``, about the origin, of an object with longest side 1.
        center: ``[3]``, the object's centre.
        side: its longest side there.

    Returns:
        Cameras ``[V]`` float64 that see the same image, with depths ``side`` times as long.
    """
    viewmats = cameras.viewmats.double().clone()
    shift = (viewmats[..., :3, :3] @ center.double().cpu()[:, None])[..., 0]
    viewmats[..., :3, 3] = side * viewmats[..., :3, 3] - shift
    return replace(cameras, viewmats=viewmats, Ks=cameras.Ks.double())


def to_unit(cameras: Cameras, center: Tensor, side: float) -> Cameras:
    """Convert cameras from an object's own frame to its unit frame, the inverse of ``placed``."""
    unit = placed(cameras, -center.double() / side, 1 / side)
    return replace(unit, viewmats=unit.viewmats.float(), Ks=unit.Ks.float())
