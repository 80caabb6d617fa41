"""Camera files: NeRF's transforms.json, which is also written, and nerfstudio's camera path.

- ``transforms.json``: ``frames`` of ``transform_matrix``, read like ``data.layouts``; and ``fps``,
  an addition of this project.
- nerfstudio's camera path: ``camera_path`` of ``camera_to_world`` (16 numbers by rows, OpenGL) and
  ``fov`` (degrees, vertical); ``render_width, render_height, fps, seconds``.

All are in the frame of the Gaussians' file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta, Struct

from ..cameras import Cameras, from_opengl
from ..data.layouts import check_cameras, read_cameras
from ..errors import UserError
from ..files import write_text
from ..untrusted.documents import parse_document, read_bytes

MAX_FRAMES = 10_000
MAX_SIDE = 16_384  # pixels in a file
DEFAULT_SIDE = 512  # pixels, without a size from file or caller

_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
_Fov = Annotated[float, Meta(ge=0.1, le=170)]
_Rate = Annotated[float, Meta(gt=0, le=1000)]


class _Speed(Struct):
    fps: _Rate | None = None


class _NerfstudioCamera(Struct):
    camera_to_world: Annotated[list[_Number], Meta(min_length=16, max_length=16)]
    fov: _Fov


class _Nerfstudio(Struct):
    camera_path: Annotated[list[_NerfstudioCamera], Meta(min_length=1, max_length=MAX_FRAMES)]
    render_width: Annotated[float, Meta(ge=1, le=MAX_SIDE)]
    render_height: Annotated[float, Meta(ge=1, le=MAX_SIDE)]
    camera_type: str = "perspective"
    fps: _Rate | None = None
    seconds: Annotated[float, Meta(gt=0, le=1e6)] | None = None


@dataclass
class CameraPath:
    """Sequence of cameras.

    Attributes:
        cameras: ``[V]`` float64.
        fps: images per second from the file, or None.
    """

    cameras: Cameras
    fps: float | None = None


def load_path(file: str | Path, size: tuple[int, int | None] | None = None) -> CameraPath:
    """Read a file of cameras in any of the formats above.

    Args:
        file: JSON of at most 64 MB.
        size: width and height of the images, or only the width, which keeps the aspect ratio.
            Another ratio keeps the vertical field of view, and shows more or less at the sides.
            None is the file's own size.

    Raises:
        UserError: the file is invalid, of unknown format, or its cameras differ in size; one line
            names the place.
    """
    source, data = str(file), read_bytes(file)
    value = parse_document(data, object, source)
    value = value if isinstance(value, dict) else {}
    if "camera_path" in value:
        path = _of_nerfstudio(parse_document(data, _Nerfstudio, source), source)
    elif "frames" in value:
        rate = parse_document(data, _Speed, source).fps
        path = CameraPath(_of_transforms(Path(file), source), rate)
    else:
        raise UserError(
            f"{source}: not a known camera file: it has neither frames (transforms.json) "
            "nor a camera_path (nerfstudio)"
        )
    return path if size is None else CameraPath(_sized(path.cameras, *size), path.fps)


def save_path(
    file: str | Path, cameras: Cameras, fps: float | None = None, extra: Sequence[dict] = ()
) -> None:
    """Write cameras as a ``transforms.json``, atomically.

    Args:
        file: the ``.json``.
        cameras: ``[V]``.
        fps: images per second.
        extra: further fields of each of the V frames, such as the name of its image.

    Raises:
        UserError: the file cannot be written.
    """
    head: dict[str, Any] = {"w": cameras.width, "h": cameras.height}
    head |= {} if fps is None else {"fps": fps}
    poses = torch.linalg.inv(cameras.viewmats.double())
    poses[..., 1:3] *= -1  # the columns of OpenGL's y and z
    frames: list[dict[str, Any]] = [{"transform_matrix": pose} for pose in poses.tolist()]
    for frame, K in zip(frames, cameras.Ks.tolist(), strict=True):
        frame |= {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    for frame, more in zip(frames, extra):
        frame |= more
    lines = ",\n".join("  " + json.dumps(frame, allow_nan=False) for frame in frames)
    write_text(file, f'{json.dumps(head)[:-1]},\n "frames": [\n{lines}\n]}}\n')


def _of_nerfstudio(path: _Nerfstudio, source: str) -> CameraPath:
    if path.camera_type.lower() not in ("perspective", "pinhole"):
        kind = repr(path.camera_type)[:40]
        raise UserError(f"{source}: camera_type is {kind}; only perspective is rendered")
    width, height = round(path.render_width), round(path.render_height)
    fovs = torch.tensor([posed.fov for posed in path.camera_path], dtype=torch.float64)
    Ks = torch.eye(3, dtype=torch.float64).repeat(len(fovs), 1, 1)
    Ks[:, 0, 0] = Ks[:, 1, 1] = 0.5 * height / torch.tan(torch.deg2rad(fovs) / 2)
    Ks[:, 0, 2], Ks[:, 1, 2] = width / 2, height / 2
    names = [f"{source}: frame {number}" for number in range(len(Ks))]
    poses = np.reshape([posed.camera_to_world for posed in path.camera_path], (-1, 4, 4))
    sizes = [(width, height)] * len(poses)
    check_cameras(poses, Ks.numpy(), sizes, names, around_object=False)
    rate = path.fps
    if path.seconds is not None:  # like nerfstudio: the length counts, not the rate
        rate = min(1000.0, len(poses) / path.seconds)
    return CameraPath(Cameras(from_opengl(torch.from_numpy(poses)), Ks, width, height), rate)


def _of_transforms(file: Path, source: str) -> Cameras:
    poses, Ks, sizes = read_cameras(file)
    stated = sorted({size or (DEFAULT_SIDE, DEFAULT_SIDE) for size in sizes})
    if len(stated) > 1:
        names = " and ".join(f"{width}x{height}" for width, height in stated[:2])
        raise UserError(f"{source}: cameras of different sizes ({names}); a path has one size")
    ((width, height),) = stated
    for K, size in zip(Ks, sizes):
        if size is None:  # in fractions of the image's side
            K[:2] *= DEFAULT_SIDE
    views = from_opengl(torch.from_numpy(poses))
    return Cameras(views, torch.from_numpy(Ks), width, height)


def _sized(cameras: Cameras, width: int, height: int | None) -> Cameras:
    """Return the cameras for images of another size, with the same vertical field of view."""
    if height is None:
        height = max(1, round(cameras.height * width / cameras.width))
    scale = height / cameras.height
    Ks = cameras.Ks.clone()
    Ks[:, :2] *= scale
    Ks[:, 0, 2] += (width - scale * cameras.width) / 2
    return Cameras(cameras.viewmats, Ks, width, height)
