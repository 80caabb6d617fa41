"""Posed input: pictures, and the cameras that they are seen by, in the world of the model."""

from __future__ import annotations

from ..cameras import Cameras, intrinsics, reference_viewmat


def reference_cameras(count: int, size: int, fov: float, distance: float) -> Cameras:
    """``count`` times the camera that a model's square picture is seen by.

    Args:
        count: of the cameras, ``[count]``.
        size: pixels.
        fov: degrees.
        distance: object units.
    """
    viewmats = reference_viewmat(distance).repeat(count, 1, 1)
    return Cameras(viewmats, intrinsics(size, size, fov).repeat(count, 1, 1), size, size)
