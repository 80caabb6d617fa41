"""Camera files: our own, NeRF's transforms.json, and nerfstudio's camera path.

- ours (``gamba-cameras``): ``width, height``, optional ``fps``, and ``frames`` of ``viewmat`` (4x4,
  world to camera, OpenCV) and ``K`` (3x3, pixels) or ``fov`` (degrees, vertical), which may also be
  given once for all frames.
- ``transforms.json``: ``frames`` of ``transform_matrix``, read like ``data.layouts``.
- nerfstudio's camera path: ``camera_path`` of ``camera_to_world`` (16 numbers by rows, OpenGL) and
  ``fov`` (degrees, vertical); ``render_width, render_height, fps, seconds``.

All are in the frame of the Gaussians' file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from msgspec import Meta, Struct
from torch import Tensor

from ..cameras import Cameras, from_opengl
from ..data.layouts import read_cameras
from ..errors import UserError
from ..files import write_text
from ..untrusted.documents import parse_document, read_bytes

FORMAT = "gamba-cameras"
MAX_FRAMES = 10_000
MAX_SIDE = 16_384  # pixels in a file
DEFAULT_SIDE = 512  # pixels, without a size from file or caller
_SHORTEST, _LONGEST = 1e-2, 1e3  # focal lengths, in sides of the picture

_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
_Triple = Annotated[list[_Number], Meta(min_length=3, max_length=3)]
_Four = Annotated[list[_Number], Meta(min_length=4, max_length=4)]
_Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
_Fov = Annotated[float, Meta(ge=0.1, le=170)]
_Rate = Annotated[float, Meta(gt=0, le=1000)]


class _Frame(Struct):
    viewmat: Annotated[list[_Four], Meta(min_length=4, max_length=4)]
    K: Annotated[list[_Triple], Meta(min_length=3, max_length=3)] | None = None
    fov: _Fov | None = None


class _GambaCameras(Struct):
    width: _Side
    height: _Side
    frames: Annotated[list[_Frame], Meta(min_length=1, max_length=MAX_FRAMES)]
    format: Literal["gamba-cameras"]
    version: Literal[1] = 1
    fps: _Rate | None = None
    fov: _Fov | None = None


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
        fps: pictures per second from the file, or None.
    """

    cameras: Cameras
    fps: float | None = None


def load_path(file: str | Path, size: tuple[int, int | None] | None = None) -> CameraPath:
    """Read a file of cameras in any of the formats above.

    Args:
        file: JSON of at most 64 MB.
        size: width and height of the pictures, or only the width, which keeps the aspect ratio.
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
    elif value.get("format") == FORMAT:
        path = _ours(parse_document(data, _GambaCameras, source), source)
    elif "frames" in value:
        path = _of_transforms(Path(file), source)
    else:
        raise UserError(
            f"{source}: not a known camera file: it has neither frames (gamba, transforms.json) "
            "nor a camera_path (nerfstudio)"
        )
    _check(path.cameras, source)
    return path if size is None else CameraPath(_sized(path.cameras, *size), path.fps)


def save_path(
    file: str | Path, cameras: Cameras, fps: float | None = None, extra: Sequence[dict] = ()
) -> None:
    """Write cameras in our own format, atomically.

    Args:
        file: the ``.json``.
        cameras: ``[V]``.
        fps: pictures per second.
        extra: further fields of each of the V frames, such as the name of its picture.

    Raises:
        UserError: the file cannot be written.
    """
    head: dict[str, Any] = {"format": FORMAT, "version": 1}
    head |= {"width": cameras.width, "height": cameras.height}
    head |= {} if fps is None else {"fps": fps}
    rows = zip(cameras.viewmats.double().tolist(), cameras.Ks.double().tolist(), strict=True)
    frames = [{"viewmat": viewmat, "K": K} for viewmat, K in rows]
    for frame, more in zip(frames, extra):
        frame |= more
    lines = ",\n".join("  " + json.dumps(frame, allow_nan=False) for frame in frames)
    write_text(file, f'{json.dumps(head)[:-1]},\n "frames": [\n{lines}\n]}}\n')


def _ours(path: _GambaCameras, source: str) -> CameraPath:
    width, height, Ks = path.width, path.height, []
    for number, frame in enumerate(path.frames):
        fov = path.fov if frame.fov is None else frame.fov
        if frame.K is not None:
            Ks.append(_tensor(frame.K))
        elif fov is not None:
            Ks.append(_centred(width, height, fov))
        else:
            raise UserError(f"{source}: frame {number} has neither K nor fov")
    viewmats = _tensor([frame.viewmat for frame in path.frames])
    return CameraPath(Cameras(viewmats, torch.stack(Ks), width, height), path.fps)


def _of_nerfstudio(path: _Nerfstudio, source: str) -> CameraPath:
    if path.camera_type.lower() not in ("perspective", "pinhole"):
        kind = repr(path.camera_type)[:40]
        raise UserError(f"{source}: camera_type is {kind}; only perspective is rendered")
    width, height = round(path.render_width), round(path.render_height)
    poses = _tensor([posed.camera_to_world for posed in path.camera_path]).view(-1, 4, 4)
    Ks = torch.stack([_centred(width, height, posed.fov) for posed in path.camera_path])
    _check_rotations(poses, source)
    rate = path.fps
    if path.seconds is not None:  # like nerfstudio: the length counts, not the rate
        rate = min(1000.0, len(poses) / path.seconds)
    return CameraPath(Cameras(from_opengl(poses), Ks, width, height), rate)


def _of_transforms(file: Path, source: str) -> CameraPath:
    poses, Ks, sizes = read_cameras(file)
    stated = sorted({size or (DEFAULT_SIDE, DEFAULT_SIDE) for size in sizes})
    if len(stated) > 1:
        names = " and ".join(f"{width}x{height}" for width, height in stated[:2])
        raise UserError(f"{source}: cameras of different sizes ({names}); a path has one size")
    ((width, height),) = stated
    for K, size in zip(Ks, sizes):
        if size is None:  # in fractions of the picture's side
            K[:2] *= DEFAULT_SIDE
    views = from_opengl(torch.from_numpy(poses))
    return CameraPath(Cameras(views, torch.from_numpy(Ks), width, height))


def _tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _centred(width: int, height: int, fov: float) -> Tensor:
    focal = 0.5 * height / torch.tan(torch.deg2rad(_tensor(fov)) / 2)
    return _tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _check(cameras: Cameras, source: str) -> None:
    """Refuse invalid cameras."""
    _check_rotations(cameras.viewmats, source)
    size = _tensor([cameras.width, cameras.height])
    for number, K in enumerate(cameras.Ks):
        focal, center = K.diagonal()[:2] / size, K[:2, 2] / size
        if not bool(((focal >= _SHORTEST) & (focal <= _LONGEST)).all()):
            raise UserError(
                f"{source}: frame {number}: focal lengths of {focal[0]:g} and {focal[1]:g} sides "
                f"of the picture, expected {_SHORTEST:g} to {_LONGEST:g}"
            )
        if not bool(((center >= -1) & (center <= 2)).all()):
            raise UserError(f"{source}: frame {number}: the principal point is far outside")
        if K[[0, 1, 2, 2], [1, 0, 0, 1]].any() or K[2, 2] != 1:
            raise UserError(f"{source}: frame {number}: K has skew, or its last row is not 0 0 1")


def _check_rotations(matrices: Tensor, source: str) -> None:
    """Refuse matrices ``[V, 4, 4]`` that are not rigid motions."""
    rotation = matrices[:, :3, :3]
    unit = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2)) < 1e-2
    last = (matrices[:, 3] - _tensor([0, 0, 0, 1])).abs().amax(1) < 1e-6
    right = unit & last & (torch.linalg.det(rotation) > 0)
    if not bool(right.all()):
        number = int((~right).nonzero()[0])
        raise UserError(
            f"{source}: frame {number}: the matrix is not a rotation with a translation "
            "(its last row is 0 0 0 1, and it neither scales nor mirrors)"
        )


def _sized(cameras: Cameras, width: int, height: int | None) -> Cameras:
    """Return the cameras for pictures of another size, with the same vertical field of view."""
    if height is None:
        height = max(1, round(cameras.height * width / cameras.width))
    scale = height / cameras.height
    Ks = cameras.Ks.clone()
    Ks[:, :2] *= scale
    Ks[:, 0, 2] += (width - scale * cameras.width) / 2
    return Cameras(cameras.viewmats, Ks, width, height)
