"""The folder layouts of posed views that can be read; all give the same ``ObjectFiles``.

- ``transforms``: ``<uid>/transforms.json`` as nerfstudio and Blender write it: ``w, h, fl_x, fl_y,
  cx, cy`` (or ``camera_angle_x``), for all frames or for each, and ``frames`` of ``file_path`` and
  ``transform_matrix`` (camera to world, OpenGL). ``gamba data render`` writes this layout.
- ``gobjaverse``: ``<uid>/campos_512_v4/NNNNN/NNNNN.png`` and ``.json``, whose ``x, y, z, origin``
  are the camera's OpenCV axes and position in the world.
- ``openlrm``: ``<uid>/rgba/NNN.png``, ``pose/NNN.npy`` (3x4, camera to world, OpenGL) and
  ``intrinsics.npy`` (3x2: focal lengths, principal point, width and height); the world's cube has
  side 2.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import UserError

GOBJAVERSE = "campos_512_v4"
GOBJAVERSE_FOCAL = 1422.222 / 1024  # in heights of the picture, if the JSON states no x_fov
PICTURES = (".webp", ".png", ".jpg", ".jpeg")


@dataclass
class ObjectFiles:
    """Where the views of one object lie, and their cameras.

    Attributes:
        images: paths of the V pictures.
        camera_to_world: ``[V, 4, 4]`` float64, OpenGL frame, object units.
        Ks: ``[V, 3, 3]`` float64, in pixels of ``sizes``, or in fractions of the unknown size.
        sizes: width and height of each of the V pictures as the file states them, or None.
        depths: paths of the V depth pictures, or None.
        depth_unit: length of one step of the depth pictures, object units.
        name: name for people.
        attribution: creator, licence, source; may be empty.
    """

    images: list[Path]
    camera_to_world: np.ndarray
    Ks: np.ndarray
    sizes: Sequence[tuple[int, int] | None]
    depths: list[Path] | None = None
    depth_unit: float = 1.0
    name: str = ""
    attribution: dict[str, str] = field(default_factory=dict)


def read_json(path: Path) -> dict:
    """Reads a JSON object.

    Raises:
        UserError: the file is missing, is not JSON, or holds no object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # JSON and UTF-8 errors both
        raise UserError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: expected a JSON object")
    return value


def _pose(value: object, source: str) -> np.ndarray:
    """Makes a ``[4, 4]`` camera-to-world matrix from 3x4 or 4x4 nested numbers, and checks it."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{source}: the pose is not a matrix of numbers") from error
    if matrix.shape not in ((3, 4), (4, 4)):
        raise UserError(f"{source}: the pose has shape {matrix.shape}, expected 3x4 or 4x4")
    if not np.isfinite(matrix).all():
        raise UserError(f"{source}: the pose is not finite")
    pose = np.eye(4)
    pose[:3] = matrix[:3]
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) or np.linalg.det(rotation) < 0:
        raise UserError(f"{source}: the pose's 3x3 part is not a rotation")
    return pose


def _number(values: dict, key: str, source: str) -> float:
    value = values[key]
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise UserError(f"{source}: {key} is {value!r}, expected a finite number")
    return float(value)


def _intrinsics(frame: dict, top: dict, source: str) -> tuple[np.ndarray, tuple[int, int] | None]:
    """Reads K and the size of one frame; without a stated size K is in fractions of it."""
    values = {**top, **frame}
    for key in ("k1", "k2", "k3", "p1", "p2"):
        if values.get(key):
            raise UserError(f"{source}: {key} = {values[key]}: lens distortion is not supported")
    sized = "w" in values and "h" in values
    width = _number(values, "w", source) if sized else 1.0
    height = _number(values, "h", source) if sized else 1.0
    if "fl_x" in values and sized:
        focal_x = _number(values, "fl_x", source)
        focal_y = _number(values, "fl_y", source) if "fl_y" in values else focal_x
    elif "camera_angle_x" in values:
        focal_x = 0.5 * width / math.tan(_number(values, "camera_angle_x", source) / 2)
        focal_y = focal_x
    else:
        raise UserError(f"{source}: no camera: needs w, h, fl_x (fl_y, cx, cy), or camera_angle_x")
    if min(width, height, focal_x, focal_y) <= 0:
        raise UserError(f"{source}: width, height and focal lengths must be positive")
    center_x = _number(values, "cx", source) if sized and "cx" in values else width / 2
    center_y = _number(values, "cy", source) if sized and "cy" in values else height / 2
    K = np.array([[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1.0]])
    return K, (int(width), int(height)) if sized else None


def _picture(folder: Path, name: object, source: str) -> Path:
    """Finds the frame's file, of whose name Blender leaves the suffix out."""
    if not isinstance(name, str) or not name:
        raise UserError(f"{source}: no file_path")
    path = folder / name
    if path.suffix:
        return path
    found = [path.with_name(path.name + suffix) for suffix in PICTURES]
    return next((p for p in found if p.exists()), found[1])


def _read_transforms(folder: Path) -> ObjectFiles:
    path = folder / "transforms.json"
    top = read_json(path)
    frames = top.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: no frames")
    images, depths, poses, Ks, sizes = [], [], [], [], []
    for i, frame in enumerate(frames):
        source = f"{path}: frame {i}"
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise UserError(f"{source}: no transform_matrix")
        images.append(_picture(folder, frame.get("file_path"), source))
        poses.append(_pose(frame["transform_matrix"], source))
        K, size = _intrinsics(frame, top, source)
        Ks.append(K)
        sizes.append(size)
        if frame.get("depth_file_path"):
            depths.append(folder / frame["depth_file_path"])
    attribution = top.get("attribution") or {}
    if not isinstance(attribution, dict):
        attribution = {"text": str(attribution)}
    return ObjectFiles(
        images=images,
        camera_to_world=np.stack(poses),
        Ks=np.stack(Ks),
        sizes=sizes,
        depths=depths if len(depths) == len(frames) else None,
        depth_unit=_number({"depth_unit": 1e-3, **top}, "depth_unit", str(path)),
        name=str(top.get("name") or ""),
        attribution={str(k): str(v) for k, v in attribution.items()},
    )


def _read_gobjaverse(folder: Path) -> ObjectFiles:
    views = sorted(p for p in (folder / GOBJAVERSE).iterdir() if p.is_dir())
    if not views:
        raise UserError(f"{folder / GOBJAVERSE}: no views")
    poses, Ks = [], []
    for view in views:
        path = view / f"{view.name}.json"
        camera = read_json(path)
        missing = [key for key in ("x", "y", "z", "origin") if key not in camera]
        if missing:
            raise UserError(f"{path}: no {', '.join(missing)}")
        axes = [camera["x"], camera["y"], camera["z"], camera["origin"]]
        if not all(isinstance(axis, list) and len(axis) == 3 for axis in axes):
            raise UserError(f"{path}: x, y, z and origin must be three numbers each")
        pose = _pose(np.transpose(axes).tolist(), str(path))
        pose[:3, 1:3] *= -1  # OpenCV to OpenGL
        poses.append(pose)
        focal_x = focal_y = GOBJAVERSE_FOCAL
        if "x_fov" in camera:
            focal_x = focal_y = 0.5 / math.tan(_number(camera, "x_fov", str(path)) / 2)
        if "y_fov" in camera:
            focal_y = 0.5 / math.tan(_number(camera, "y_fov", str(path)) / 2)
        Ks.append(np.array([[focal_x, 0, 0.5], [0, focal_y, 0.5], [0, 0, 1.0]]))
    images = [view / f"{view.name}.png" for view in views]
    return ObjectFiles(images, np.stack(poses), np.stack(Ks), [None] * len(views))


def _load_array(path: Path, shape: tuple[int, int]) -> np.ndarray:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise UserError(f"{path}: expected {shape[0]}x{shape[1]} finite numbers, got {array.shape}")
    return array.astype(np.float64)


def _read_openlrm(folder: Path) -> ObjectFiles:
    images = sorted((folder / "rgba").glob("*.png"))
    if not images:
        raise UserError(f"{folder / 'rgba'}: no views")
    focal, center, size = _load_array(folder / "intrinsics.npy", (3, 2))
    K = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1.0]])
    poses = []
    for image in images:
        path = folder / "pose" / f"{image.stem}.npy"
        pose = _pose(_load_array(path, (3, 4)), str(path))
        pose[:3, 3] *= 0.5  # its objects fill a cube of side 2, ours of side 1
        poses.append(pose)
    sizes = [(int(size[0]), int(size[1]))] * len(images)
    return ObjectFiles(images, np.stack(poses), np.repeat(K[None], len(images), 0), sizes)


# Each layout has the name that marks an object's folder, and the folder's reader.
LAYOUTS: dict[str, tuple[str, Callable[[Path], ObjectFiles]]] = {
    "transforms": ("transforms.json", _read_transforms),
    "gobjaverse": (GOBJAVERSE, _read_gobjaverse),
    "openlrm": ("intrinsics.npy", _read_openlrm),
}


def find_objects(root: Path, layout: str) -> tuple[str, list[Path]]:
    """Finds the layout's name and the objects' folders, sorted, at any depth.

    ``root`` itself may be an object. ``layout`` "auto" takes the layout of the first object found.
    Folders with a leading dot are passed over.
    """
    marks = {mark: name for name, (mark, _) in LAYOUTS.items() if layout in ("auto", name)}
    found = []
    for name, folder in _walk(root, marks):
        marks = {mark: n for mark, n in marks.items() if n == name}
        found.append(folder)
        layout = name
    return layout, sorted(found)


def _walk(root: Path, marks: dict[str, str]) -> Iterator[tuple[str, Path]]:
    for folder, subfolders, files in os.walk(root):
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        mark = next((m for m in marks if m in files or m in subfolders), None)
        if mark is not None:
            subfolders.clear()  # an object holds no objects
            yield marks[mark], Path(folder)
