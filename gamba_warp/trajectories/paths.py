"""Paths of cameras about an object, and those that a file holds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from ..cameras import Cameras, intrinsics, orbit
from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..gaussians import Gaussians
from .files import load_path

SWING = 30.0  # degrees by which a spiral rises above its elevation, and falls below it
TURNS = 2  # of a spiral


@dataclass(frozen=True)
class Viewpoint:
    """From where an object is looked at.

    Attributes:
        elevation: degrees; a camera of positive elevation looks down.
        distance: of the camera from the object's centre, object units.
        fov: field of view of the picture's shorter side, degrees.
    """

    elevation: float = 0.0
    distance: float = DEFAULT_DISTANCE
    fov: float = DEFAULT_FOV

    def changed(
        self,
        elevation: float | None = None,
        distance: float | None = None,
        fov: float | None = None,
    ) -> Viewpoint:
        """The viewpoint with what is given; None leaves a number as it is.

        A new field of view without a distance keeps the object as large in the picture as it was,
        so the camera goes nearer or farther.
        """
        if fov is not None and distance is None:
            before, after = (math.tan(math.radians(angle) / 2) for angle in (self.fov, fov))
            distance = self.distance * before / after
        return Viewpoint(
            self.elevation if elevation is None else elevation,
            self.distance if distance is None else distance,
            self.fov if fov is None else fov,
        )


def turntable(
    frames: int,
    elevation: float = 0.0,
    distance: float = DEFAULT_DISTANCE,
    fov: float = DEFAULT_FOV,
    size: int | tuple[int, int] = 256,
) -> Cameras:
    """One full turn about the origin at one elevation; the first camera has azimuth 0.

    Args:
        frames: number of cameras, >= 1.
        elevation: degrees; a camera of positive elevation looks down.
        distance: of the cameras from the origin.
        fov: field of view of the picture's shorter side, degrees.
        size: side of square pictures, or width and height, pixels.

    Returns:
        Cameras ``[frames]``, float32 on the CPU, in a world where up is -y (see ``orbit``).
    """
    azimuths = torch.arange(frames) * (360.0 / frames)
    return _around(azimuths, elevation, distance, fov, size)


def spiral(
    frames: int,
    elevation: float = 0.0,
    distance: float = DEFAULT_DISTANCE,
    fov: float = DEFAULT_FOV,
    size: int | tuple[int, int] = 256,
) -> Cameras:
    """``TURNS`` turns about the origin while the camera rises, falls below, and comes back.

    Its elevation follows one sine of ``SWING`` degrees about ``elevation``, so the last camera is
    followed by the first without a jump, and the object is seen from above and from below.

    Args:
        frames: number of cameras, >= 1.
        elevation: of the first camera, degrees.
        distance: as for ``turntable``.
        fov: as for ``turntable``.
        size: as for ``turntable``.

    Returns:
        Cameras ``[frames]``, as ``turntable``.
    """
    share = torch.arange(frames) / frames
    rise = elevation + SWING * torch.sin(2 * math.pi * share)
    return _around(360.0 * TURNS * share, rise.clamp(-90, 90), distance, fov, size)


def _around(
    azimuths: Tensor,
    elevation: float | Tensor,
    distance: float,
    fov: float,
    size: int | tuple[int, int],
) -> Cameras:
    width, height = (size, size) if isinstance(size, int) else size
    K = intrinsics(width, height, fov)
    if width < height:  # the angle is that of the width: an object in the middle stays whole
        K[[0, 1], [0, 1]] *= width / height
    viewmats = orbit(azimuths, elevation, distance)
    return Cameras(viewmats, K.expand(len(azimuths), 3, 3), width, height)


def read_path(file: str | Path, size: tuple[int, int | None] | None = None) -> Cameras:
    """The cameras of a file, in the frame of the file of Gaussians that it belongs to.

    Args:
        file: one of the forms of ``trajectories.files``.
        size: width and height of the pictures, or the width alone; the file's own if not given.

    Returns:
        Cameras ``[V]`` float64.

    Raises:
        UserError: the file is bad; one line says where.
    """
    return load_path(file, size).cameras


def upright(elevation: float) -> Tensor:
    """The rotation ``[3, 3]`` float32 that sets up what a camera of this elevation saw.

    Args:
        elevation: of the camera above the object, degrees.

    Returns:
        It turns points of the camera's axes, about the object's centre, into a world whose up is
        -y: there the camera is that of ``orbit([0], elevation)``.
    """
    return orbit(torch.zeros(1), elevation)[0, :3, :3].T.contiguous()


def set_up(gaussians: Gaussians, elevation: float) -> Gaussians:
    """An object in the axes of a camera of this elevation, degrees, made ``upright``."""
    if not elevation:
        return gaussians
    turn = upright(elevation).to(gaussians.means)
    return gaussians.transformed(turn, torch.zeros_like(turn[0]))


def placed(cameras: Cameras, center: Tensor, side: float) -> Cameras:
    """Cameras about an object in its unit frame, in the frame where it has its place and size.

    Args:
        cameras: ``[V]``, about the origin, of an object with longest side 1.
        center: ``[3]``, the object's centre.
        side: its longest side there.

    Returns:
        Cameras ``[V]`` float64 that see the same picture, with depths ``side`` times as long.
    """
    viewmats = cameras.viewmats.double().clone()
    shift = (viewmats[..., :3, :3] @ center.double().cpu()[:, None])[..., 0]
    viewmats[..., :3, 3] = side * viewmats[..., :3, 3] - shift
    return replace(cameras, viewmats=viewmats, Ks=cameras.Ks.double())


def to_unit(cameras: Cameras, center: Tensor, side: float) -> Cameras:
    """The inverse of ``placed``: cameras of an object's own frame, in its unit frame; float32."""
    viewmats = cameras.viewmats.double().clone()
    shift = (viewmats[..., :3, :3] @ center.double().cpu()[:, None])[..., 0]
    viewmats[..., :3, 3] = (viewmats[..., :3, 3] + shift) / side
    return replace(cameras, viewmats=viewmats.float(), Ks=cameras.Ks.float())
