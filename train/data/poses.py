"""Cameras of rendered views: around an object, each with all of it in the image."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .settings import SPREAD

MARGIN = 0.96  # fraction of the image's half size that the object may reach
NEAREST = 3.0  # least distance, in half sizes of the object along the camera's axes
FRONT = (35.0, 0.0, 20.0)  # degrees: largest azimuth, least and largest elevation of a front view


def look_at_origin(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """Return ``[4, 4]`` camera-to-world, OpenGL frame, of a camera that looks at the origin, z up.

    A camera of azimuth 0 stands at -y (the front, as in Blender); azimuth grows towards +x.

    Args:
        azimuth: degrees.
        elevation: degrees, between -90 and 90.
        distance: object units.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    back = np.array([math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e)])
    right = np.array([math.cos(a), math.sin(a), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(back, right), back
    pose[:3, 3] = distance * back
    return pose


def nearest_distance(points: np.ndarray, pose: np.ndarray, fov: float) -> float:
    """Return the least camera distance along the pose's axis.

    At this distance all points are in a square image, with a margin. A reference view is rescaled
    to distance 1.5; the object then lies within [-0.5, 0.5] on each camera axis, where the model
    can place Gaussians.

    Args:
        points: ``[P, 3]`` in the object's frame.
        pose: ``[4, 4]`` camera to world; only its rotation matters.
        fov: degrees, of the image's side.
    """
    local = points @ pose[:3, :3]
    slope = MARGIN * math.tan(math.radians(fov) / 2)
    in_image = (np.abs(local[:, :2]).max(1) / slope + local[:, 2]).max()
    return float(max(in_image, NEAREST * np.abs(local).max()))


def sample_poses(
    points: np.ndarray,
    views: int,
    fov: float,
    rng: np.random.Generator,
    fronts: int = 1,
    spread: float = SPREAD,
) -> np.ndarray:
    """Draw ``[views, 4, 4]`` camera-to-world matrices, OpenGL frame.

    The first views see the object roughly from the front, see ``FRONT``. The others are spread in
    azimuth by the golden ratio with a random start; nine in ten have an elevation of -10 to 50°,
    the rest one of -30 to 75°.

    Args:
        points: ``[P, 3]`` vertices of the object, which is centred at the origin.
        views: number of views.
        fov: degrees, of the image's side.
        rng: random generator.
        fronts: number of views from the front.
        spread: largest fraction by which a camera stands further away than necessary.
    """
    golden = (math.sqrt(5) - 1) / 2
    start = rng.uniform()
    poses = []
    for view in range(views):
        if view < fronts:
            azimuth, elevation = rng.uniform(-FRONT[0], FRONT[0]), rng.uniform(*FRONT[1:])
        else:
            azimuth = 360 * ((start + view * golden) % 1.0)
            elevation = rng.uniform(-30, 75) if rng.uniform() < 0.1 else rng.uniform(-10, 50)
        pose = look_at_origin(azimuth, elevation, 1.0)
        distance = nearest_distance(points, pose, fov) * rng.uniform(1.0, 1.0 + spread)
        poses.append(look_at_origin(azimuth, elevation, distance))
    return np.stack(poses)


def ring_poses(
    points: np.ndarray, fov: float, elevations: Sequence[float], azimuths: Sequence[float]
) -> np.ndarray:
    """Return ``[V, 4, 4]`` camera-to-world matrices, OpenGL frame, on rings about the object.

    All views of an object have one distance: the least that keeps it inside each image.

    Args:
        points: ``[P, 3]`` vertices of the object, which is centred at the origin.
        fov: degrees, of the image's side.
        elevations: of the rings, degrees; the first ring's views come first.
        azimuths: of each ring's views, degrees.
    """
    angles = [(azimuth, elevation) for elevation in elevations for azimuth in azimuths]
    around = [look_at_origin(azimuth, elevation, 1.0) for azimuth, elevation in angles]
    distance = max(nearest_distance(points, pose, fov) for pose in around)
    return np.stack([look_at_origin(*pair, distance) for pair in angles])


def front_views(poses: np.ndarray) -> list[int]:
    """Indices of the views roughly from the front, see ``FRONT``; always includes the first.

    Args:
        poses: ``[V, 4, 4]`` camera to world, OpenGL frame; the object's centre is the origin.
    """
    x, y, z = np.moveaxis(poses[:, :3, 3], 1, 0)
    azimuth = np.degrees(np.arctan2(x, -y))
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    front = (np.abs(azimuth) <= FRONT[0]) & (elevation >= FRONT[1]) & (elevation <= FRONT[2])
    return sorted({0, *np.flatnonzero(front).tolist()})
