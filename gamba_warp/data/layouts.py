"""Folder layouts of posed views; all are read into the same ``ObjectFiles``.

- ``transforms``: ``<uid>/transforms.json`` of nerfstudio and Blender: ``w, h, fl_x, fl_y, cx, cy``
  (or ``camera_angle_x``), for all frames or for each, and ``frames`` of ``file_path`` and
  ``transform_matrix`` (camera to world, OpenGL). Without ``w`` and ``h`` the size is that of the
  first image. ``mask_path``, if every frame has one, is the object's alpha. ``gamba data render``
  writes this layout.
- ``nerf``: ``<uid>/transforms_train.json`` and optionally ``transforms_val.json`` and
  ``transforms_test.json`` of the same form: all their frames are views of one object.
- ``gobjaverse``: ``<uid>/campos_512_v4/NNNNN/NNNNN.png`` and ``.json``, whose ``x, y, z, origin``
  are the camera's OpenCV axes and position in the world, which is z-up. Views without one of the
  two files, as in an unfinished download, are skipped.
- ``openlrm``: ``<uid>/rgba/NNN.png``, ``pose/NNN.npy`` (3x4, camera to world, OpenGL) and
  ``intrinsics.npy`` (3x2: focal lengths, principal point, width and height); the world's cube has
  side 2.
"""

from __future__ import annotations

import io
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta, Struct
from PIL import Image

from ..errors import UserError
from ..files import walk
from ..images import IMAGE_SUFFIXES, image_size, load_rgba8, open_image
from ..untrusted.arrays import read_array
from ..untrusted.documents import read_document
from ..untrusted.names import Within, inside

TRANSFORMS = ("transforms.json",)
NERF = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
GOBJAVERSE = "campos_512_v4"
GOBJAVERSE_FOCAL = 1422.222 / 1024  # in heights of the image, if the JSON states no x_fov
MAX_VIEWS = 10_000  # of an object
MAX_SIDE = 16_384  # pixels of a camera
NEAREST, FARTHEST = 1e-3, 1e4  # camera's distance from the object's centre, in the file's units
SHORTEST, LONGEST = 1e-2, 1e3  # focal lengths, in sides of the image
_LAST_ROW = 0.0, 0.0, 0.0, 1.0  # of a pose
_LARGEST = 1e9  # of any number in a camera file
_MAX_TEXT = 500  # letters of a name or of an attribution
_MAX_DEPTH = 64  # levels of nested folders
# Intrinsics that may be given per frame.
_DISTORTIONS = {*("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "b1", "b2", "sk_x", "sk_y")}
_DISTORTIONS |= {*("s1", "s2", "s3", "s4", "distortion_params", "rolling_shutter")}
_DISTORTIONS |= {*("is_fisheye", "equirectangular", "latlong", "orthographic", "is_orthographic")}
_DISTORTIONS |= {f"ftheta_p{i}" for i in range(5)}
_MODELS = "camera_model", "camera_type"
# Camera models of nerfstudio and COLMAP that are pinholes if all distortion is 0.
_PINHOLES = {*("pinhole", "simple_pinhole", "perspective", "opencv", "full_opencv", "radial")}
_PINHOLES |= {"simple_radial"}
_PIXELS = "fl_x", "fl_y", "cx", "cy"
_INTRINSICS = {*("w", "h", "camera_angle_x", "camera_angle_y"), *_PIXELS}
_INTRINSICS |= {*_DISTORTIONS, *_MODELS}
_FIT = 0.02  # tolerance for a simplified mesh, in sides of the cube
IMAGES = (".webp", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class MemoryImage:
    """Image in memory.

    Attributes:
        name: for errors.
        content: of a file; or RGBA ``[H, W, 4]`` uint8; or depth ``[H, W]`` float32 in steps.
        stem: empty, in place of a path's.
    """

    name: str
    content: bytes | np.ndarray
    stem: ClassVar[str] = ""

    def __str__(self) -> str:
        return self.name

    def read(self) -> np.ndarray:
        """Return the pixels of a file, RGBA ``[H, W, 4]`` uint8, or the array.

        Raises:
            UserError: the image is damaged.
        """
        if isinstance(self.content, np.ndarray):
            return self.content
        return load_rgba8(self.name, self.content)

    def open(self) -> AbstractContextManager[Image.Image]:
        """Open it as ``images.open_image``."""
        if isinstance(self.content, np.ndarray):
            return nullcontext(Image.fromarray(self.content))
        return open_image(io.BytesIO(self.content), self.name)


Sizes = list[tuple[int, int] | None]


@dataclass(frozen=True)
class Placement:
    """Transform from a mesh's file to the world of its rendered views.

    A point becomes ``scale · (transform · [x, 1])``: ``applied_scale`` and ``applied_transform`` of
    ``transforms.json``. It includes the rotation to z-up, a rotation of the catalogue and
    ``--stretch``.

    Attributes:
        transform: ``[3, 4]`` float64 with an invertible ``[3, 3]`` part.
        scale: > 0.
    """

    transform: np.ndarray
    scale: float

    def points(self, x: np.ndarray) -> np.ndarray:
        """Transform points ``[N, 3]``."""
        return self.scale * (x @ self.transform[:, :3].T + self.transform[:, 3])

    def fits(self, x: np.ndarray) -> bool:
        """True if ``[N, 3]`` may be the mesh's vertices: they fill the cube of the views.

        Their bounding box is then centred, with a longest side of 1; for a simplified mesh nearly.
        """
        points = self.points(x)
        low, high = points.min(0), points.max(0)
        return bool(np.abs(low + high).max() / 2 <= _FIT and abs((high - low).max() - 1) <= _FIT)


@dataclass
class ObjectFiles:
    """Files and cameras of the views of one object.

    Attributes:
        images: the V images: paths, or images in memory.
        camera_to_world: ``[V, 4, 4]`` float64, OpenGL frame, object units.
        Ks: ``[V, 3, 3]`` float64, in pixels of ``sizes``, or in fractions of the unknown size.
        sizes: width and height of each of the V images as stated by the file, or None.
        masks: V grey images to multiply with the alpha of ``images``, or None.
        depths: the V depth images, or None.
        backs: V images of the last surface's depth, or None.
        depth_unit: length of one step of the depth images, object units.
        name: readable name.
        attribution: creator, licence, source; may be empty.
        placement: of the rendered mesh, or None if unknown.
    """

    images: Sequence[Path | MemoryImage]
    camera_to_world: np.ndarray
    Ks: np.ndarray
    sizes: Sequence[tuple[int, int] | None]
    masks: Sequence[Path | MemoryImage] | None = None
    depths: Sequence[Path | MemoryImage] | None = None
    backs: Sequence[Path | MemoryImage] | None = None
    depth_unit: float = 1.0
    name: str = ""
    attribution: dict[str, str] = field(default_factory=dict)
    placement: Placement | None = None


def _matrix(value: object, source: str, what: str = "the pose") -> np.ndarray:
    """Convert 3x4 or 4x4 nested numbers to a ``[4, 4]`` matrix."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{source}: {what} is not a matrix of numbers") from error
    if matrix.shape not in ((3, 4), (4, 4)):
        raise UserError(f"{source}: {what} has shape {matrix.shape}, expected 3x4 or 4x4")
    return np.concatenate([matrix, [_LAST_ROW]])[:4]


def _is_last_row(row: np.ndarray) -> np.ndarray:
    """Return whether rows ``[.., 4]`` are 0 0 0 1, up to rounding."""
    return np.asarray(np.isclose(row, _LAST_ROW, atol=1e-6).all(-1))


def check_cameras(
    poses: np.ndarray,
    Ks: np.ndarray,
    sizes: Sequence[tuple[int, int] | None],
    names: Sequence[str],
    around_object: bool = True,
) -> None:
    """Check that cameras are plausible.

    Args:
        poses: ``[V, 4, 4]`` float64, camera to world.
        Ks: ``[V, 3, 3]`` float64, in pixels of ``sizes``, or in fractions of the unknown size.
        sizes: V widths and heights, pixels, or None.
        names: names of the V views, for the message.
        around_object: they look at an object at the origin, which bounds their distance.

    Raises:
        UserError: a pose is not a rotation with a position, or a K does not match the size.
    """
    size = np.array([size or (1, 1) for size in sizes])
    with np.errstate(all="ignore"):  # non-finite numbers are reported below
        rotations, distances = poses[:, :3, :3], np.linalg.norm(poses[:, :3, 3], axis=1)
        products = rotations @ rotations.swapaxes(1, 2)
        orthogonal = np.isclose(products, np.eye(3), atol=1e-2).all((1, 2))
        focal, center = Ks[:, (0, 1), (0, 1)] / size, Ks[:, :2, 2] / size
        positive = np.isfinite(Ks).all((1, 2)) & (focal > 0).all(1)
        checks = {
            f"the pose is not finite, or over {_LARGEST:g}": (np.abs(poses) <= _LARGEST).all(
                (1, 2)
            ),
            "the pose's 3x3 part is not a rotation": orthogonal & ~(np.linalg.det(rotations) < 0),
            "the camera is {distance:g} from the object's centre, expected "
            f"{NEAREST:g} to {FARTHEST:g}": (
                (distances >= NEAREST) & (distances <= FARTHEST) | (not around_object)
            ),
            "focal lengths must be positive": positive,
            "focal lengths of {focal[0]:g} and {focal[1]:g} sides of the image, expected "
            f"{SHORTEST:g} to {LONGEST:g}": ((focal >= SHORTEST) & (focal <= LONGEST)).all(1),
            "the principal point is far outside the image": (
                ((center >= -1) & (center <= 2)).all(1)
            ),
            "the pose's last row is not 0 0 0 1": _is_last_row(poses[:, 3]),
        }
    for reason, valid in checks.items():
        if not valid.all():
            view = int(valid.argmin())
            reason = reason.format(distance=distances[view], focal=focal[view])
            raise UserError(f"{names[view]}: {reason}")


def _number(values: dict[str, Any], key: str, source: str) -> float:
    value = values[key]
    if type(value) not in (int, float) or not abs(value) <= _LARGEST:  # excludes bool
        raise UserError(f"{source}: {key} is {repr(value)[:40]}, expected a finite number")
    return float(value)


def read_placement(values: dict[str, Any], source: str) -> Placement | None:
    """Read ``applied_transform`` and ``applied_scale``; None without the first.

    Raises:
        UserError: they are not finite or not invertible.
    """
    if values.get("applied_transform") is None:
        return None
    matrix = _matrix(values["applied_transform"], source, "applied_transform")
    scale = _number({"applied_scale": 1.0, **values}, "applied_scale", source)
    with np.errstate(all="ignore"):  # non-finite numbers are reported here
        valid = (np.abs(matrix) <= _LARGEST).all() and scale > 0 and _is_last_row(matrix[3])
        if not valid or np.linalg.matrix_rank(matrix[:3, :3]) < 3:
            reason = "is not affine, or not invertible"
            raise UserError(f"{source}: applied_transform or applied_scale {reason}")
    return Placement(matrix[:3], scale)


def _side(values: dict[str, Any], key: str, source: str) -> int:
    value = _number(values, key, source)
    if not 1 <= value <= MAX_SIDE or value != int(value):
        raise UserError(f"{source}: {key} is {value:g}, expected whole pixels, 1 to {MAX_SIDE}")
    return int(value)


def _focal(angle: float, source: str) -> float:
    """Focal length, in sides of the image, of a field of view in radians."""
    if not 0 < angle < math.pi:
        raise UserError(f"{source}: a field of view of {angle:g} radians, expected 0 to pi")
    return 0.5 / math.tan(angle / 2)


def _camera_matrix(focal_x: float, focal_y: float, x: float, y: float) -> np.ndarray:
    return np.array([[focal_x, 0, x], [0, focal_y, y], [0, 0, 1.0]])


def _check_lens(values: dict, source: str) -> None:
    """Raise for any camera model but a pinhole, naming the field."""
    for key in _MODELS:
        model = values.get(key)
        if model is not None and str(model).lower() not in _PINHOLES:
            raise UserError(
                f"{source}: {key} is {repr(model)[:40]}; only pinhole cameras are supported, "
                "so the images must be undistorted first"
            )
    for key in sorted(_DISTORTIONS & values.keys()):
        value = values[key]
        if any(value) if isinstance(value, list) else value:
            raise UserError(
                f"{source}: {key} = {repr(value)[:40]}: lens distortion is not supported; "
                "undistort the images first"
            )


def _intrinsics(
    values: dict, source: str, size: Callable[[], tuple[int, int]] | None
) -> tuple[np.ndarray, tuple[int, int] | None]:
    """Read K and the size of one frame; ``size`` returns it if the frame does not state one.

    Without a size K is in fractions of a square image.
    """
    _check_lens(values, source)
    stated = None
    if "w" in values and "h" in values:
        stated = _side(values, "w", source), _side(values, "h", source)
    elif size is not None:
        stated = size()
    width, height = stated or (1, 1)
    if not stated and (pixels := [key for key in _PIXELS if key in values]):
        raise UserError(f"{source}: {pixels[0]} is in pixels, so w and h are needed")
    if "fl_x" in values:
        focal_x = _number(values, "fl_x", source)
    elif "camera_angle_x" in values:
        focal_x = width * _focal(_number(values, "camera_angle_x", source), source)
    else:
        raise UserError(f"{source}: no camera: needs w, h, fl_x (fl_y, cx, cy), or camera_angle_x")
    if "fl_y" in values:
        focal_y = _number(values, "fl_y", source)
    elif "camera_angle_y" in values and "fl_x" not in values:
        focal_y = height * _focal(_number(values, "camera_angle_y", source), source)
    else:
        focal_y = focal_x
    center_x = _number(values, "cx", source) if "cx" in values else width / 2
    center_y = _number(values, "cy", source) if "cy" in values else height / 2
    return _camera_matrix(focal_x, focal_y, center_x, center_y), stated


def read_cameras(path: Path) -> tuple[np.ndarray, np.ndarray, Sizes]:
    """Read the cameras of a file in the form of ``transforms.json``, ignoring its images.

    Returns:
        ``camera_to_world [V, 4, 4]`` float64 (OpenGL), ``Ks [V, 3, 3]`` float64 and the V sizes,
        as in ``ObjectFiles``.

    Raises:
        UserError: the file is invalid; one line says where.
    """
    top, frames = _frames(path, read_document(path, object))
    return _cameras(path, top, frames, None, around_object=False)


def _frames(path: Path | str, top: object) -> tuple[dict, list[dict]]:
    """Check the content of a file; return the values common to all frames, and its frames."""
    if not isinstance(top, dict):
        raise UserError(f"{path}: expected a JSON object")
    frames = top.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: no frames")
    _check_count(len(frames), path)
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise UserError(f"{path}: frame {number}: no transform_matrix")
    return top, frames


def _cameras(
    path: Path | str,
    top: dict,
    frames: list[dict],
    size: Callable[[], tuple[int, int]] | None,
    around_object: bool = True,
) -> tuple[np.ndarray, np.ndarray, Sizes]:
    poses, cameras, names = [], [], [f"{path}: frame {i}" for i in range(len(frames))]
    shared = None  # most files have one camera for all frames
    for frame, source in zip(frames, names):
        poses.append(_matrix(frame["transform_matrix"], source))
        if intrinsics := {key: frame[key] for key in _INTRINSICS & frame.keys()}:
            cameras.append(_intrinsics({**top, **intrinsics}, source, size))
        else:
            shared = shared or _intrinsics(top, source, size)
            cameras.append(shared)
    Ks, sizes = np.stack([K for K, _ in cameras]), [size for _, size in cameras]
    check_cameras(np.stack(poses), Ks, sizes, names, around_object)
    return np.stack(poses), Ks, sizes


_PATHS = ("file_path", "mask_path", "depth_file_path", "back_file_path")


# From a name in a document, and the document's for errors, to the image.
Find = Callable[[Any, str], Path | MemoryImage]


def _images(path: Path | str, frames: list[dict], find: Find) -> dict[str, list]:
    """Files named by the frames, by the name of the field."""
    files: dict[str, list] = {key: [] for key in _PATHS}
    for i, frame in enumerate(frames):
        source = f"{path}: frame {i}"
        if not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise UserError(f"{source}: no file_path")
        for key, paths in files.items():
            if name := frame.get(key):  # programs on Windows write backslashes
                name = name.replace("\\", "/") if isinstance(name, str) else name
                paths.append(find(name, source))
        files["file_path"][-1] = _with_suffix(files["file_path"][-1])
    for key, paths in files.items():
        repeated = next((p for p, n in Counter(paths).items() if n > 1), None)
        if repeated and key != "mask_path":  # frames may share a mask
            name = Path(str(repeated)).name
            raise UserError(f"{path}: two frames name the image {name}")
    if 0 < len(files["mask_path"]) < len(frames):
        raise UserError(f"{path}: {len(files['mask_path'])} of {len(frames)} frames have a mask")
    return files


def _with_suffix(image: Path | MemoryImage) -> Path | MemoryImage:
    """Blender omits the suffix; a dot may then be part of the name."""
    if not isinstance(image, Path) or image.suffix.lower() in IMAGE_SUFFIXES:
        return image
    if os.path.lexists(image):
        return image
    candidates = [image.with_name(image.name + suffix) for suffix in IMAGES]
    return next((p for p in candidates if p.exists()), candidates[1])


def _read_frames(names: tuple[str, ...], folder: Path) -> ObjectFiles:
    """Read one object from the frames of the first of these files, and of others that exist."""
    paths = [folder / name for name in names]
    paths = paths[:1] + [path for path in paths[1:] if os.path.lexists(path)]
    documents = [(path, read_document(path, object), Within(folder).path) for path in paths]
    return object_of(documents)


def object_of(documents: Sequence[tuple[Path | str, object, Find]]) -> ObjectFiles:
    """Make an object of the frames of documents such as ``transforms.json``.

    Args:
        documents: for each its name, its content, and its way from names to images. The common
            values are those of the first.

    Raises:
        UserError: a document is invalid.
    """
    parts = []
    files: dict[str, list] = {key: [] for key in _PATHS}
    top: dict = {}
    for path, content, find in documents:
        common, frames = _frames(path, content)
        top, paths = top or common, _images(path, frames, find)
        first = paths["file_path"][0]
        parts.append(_cameras(path, common, frames, cache(partial(_size_of, first))))
        for key in _PATHS:
            files[key] += paths[key]
    path, count = documents[0][0], len(files["file_path"])
    _check_count(count, path)
    depth_unit = _number({"depth_unit": 1e-3, **top}, "depth_unit", str(path))
    if not 0 < depth_unit <= 1e3:
        raise UserError(f"{path}: depth_unit is {depth_unit:g}, expected above 0, at most 1000")
    attribution = top.get("attribution") or {}
    if not isinstance(attribution, dict):
        attribution = {"text": attribution}
    images, *others = files.values()
    masks, depths, backs = (paths if len(paths) == count else None for paths in others)
    if files["mask_path"] and masks is None:
        raise UserError(f"{path}: {len(files['mask_path'])} of {count} frames have a mask")
    return ObjectFiles(
        images=images,
        camera_to_world=np.concatenate([poses for poses, _, _ in parts]),
        Ks=np.concatenate([Ks for _, Ks, _ in parts]),
        sizes=[size for _, _, sizes in parts for size in sizes],
        masks=masks,
        depths=depths,
        backs=backs,
        depth_unit=depth_unit,
        name=one_line(top.get("name") or ""),
        attribution={one_line(k): one_line(v) for k, v in attribution.items()},
        placement=read_placement(top, str(path)),
    )


def _size_of(image: Path | MemoryImage) -> tuple[int, int]:
    if isinstance(image, Path):
        return image_size(image, turned=False)
    height, width = image.read().shape[:2]
    return width, height


def one_line(value: object) -> str:
    """Convert any value of a field to one line of text."""
    return " ".join(str(value).split())[:_MAX_TEXT]


def _check_count(count: int, path: Path | str) -> None:
    if count > MAX_VIEWS:
        raise UserError(f"{path}: {count} views, at most {MAX_VIEWS} are supported")


_Axis = Annotated[list[float], Meta(min_length=3, max_length=3)]


class _View(Struct):
    """Content of G-Objaverse's ``NNNNN.json``: OpenCV axes, position, angles in radians."""

    x: _Axis
    y: _Axis
    z: _Axis
    origin: _Axis
    x_fov: float | None = None
    y_fov: float | None = None


def _read_gobjaverse(folder: Path) -> ObjectFiles:
    folders = sorted(p for p in (folder / GOBJAVERSE).iterdir() if p.is_dir())
    _check_count(len(folders), folder)
    # A broken link counts as present, and raises when it is read.
    both = [[view / f"{view.name}{suffix}" for suffix in (".json", ".png")] for view in folders]
    views = [view for view, files in zip(folders, both) if all(map(os.path.lexists, files))]
    if not views:
        raise UserError(f"{folder / GOBJAVERSE}: no views with both image and camera")
    aspect = 0.0  # of the first image, opened only if needed
    poses, Ks, names = [], [], [str(view / f"{view.name}.json") for view in views]
    for name in names:
        camera = read_document(name, _View)
        pose = _matrix(list(zip(camera.x, camera.y, camera.z, camera.origin)), name)
        pose[:3, 1:3] *= -1  # OpenCV to OpenGL
        poses.append(pose)
        if not aspect and (camera.x_fov is None or camera.y_fov is None):
            # Pixels are square, the image may not be.
            width, height = _size_of(inside(views[0], f"{views[0].name}.png", name))
            aspect = width / height
        if camera.x_fov is None:
            focal_x = GOBJAVERSE_FOCAL / aspect
        else:
            focal_x = _focal(camera.x_fov, name)
        focal_y = focal_x * aspect if camera.y_fov is None else _focal(camera.y_fov, name)
        Ks.append(_camera_matrix(focal_x, focal_y, 0.5, 0.5))
    check_cameras(np.stack(poses), np.stack(Ks), [None] * len(views), names)
    return ObjectFiles(
        [inside(view, f"{view.name}.png", str(view)) for view in views],
        np.stack(poses),
        np.stack(Ks),
        [None] * len(views),
    )


def _read_openlrm(folder: Path) -> ObjectFiles:
    names = sorted(path.name for path in (folder / "rgba").glob("*.png"))
    if not names:
        raise UserError(f"{folder / 'rgba'}: no views")
    _check_count(len(names), folder)
    within = Within(folder)
    images = [within.path(f"rgba/{name}", str(folder)) for name in names]
    intrinsics = folder / "intrinsics.npy"
    focal, center, size = read_array(intrinsics, (3, 2))
    values = {"width": float(size[0]), "height": float(size[1])}
    width, height = (_side(values, key, str(intrinsics)) for key in values)
    Ks = np.repeat(_camera_matrix(*focal, *center)[None], len(images), 0)
    paths = [folder / "pose" / f"{image.stem}.npy" for image in images]
    poses = np.stack([_matrix(read_array(path, (3, 4)), str(path)) for path in paths])
    sizes = [(width, height)] * len(images)
    check_cameras(poses, Ks, sizes, [f"{intrinsics}, pose/{path.name}" for path in paths])
    poses[:, :3, 3] *= 0.5  # OpenLRM's objects fill a cube of side 2, ours of side 1
    return ObjectFiles(images, poses, Ks, sizes)


# By name: the file or folder that marks an object's folder, and the folder's reader, which raises
# UserError. A script may add to it (docs/train-your-own.md).
LAYOUTS: dict[str, tuple[str, Callable[[Path], ObjectFiles]]] = {
    "transforms": (TRANSFORMS[0], partial(_read_frames, TRANSFORMS)),
    "nerf": (NERF[0], partial(_read_frames, NERF)),
    "gobjaverse": (GOBJAVERSE, _read_gobjaverse),
    "openlrm": ("intrinsics.npy", _read_openlrm),
}


def find_objects(root: Path) -> tuple[str, list[Path], list[Path]]:
    """Find the objects' folders at any depth.

    ``root`` itself may be an object. All have the layout of the first one found. Folders with a
    leading dot are skipped; linked folders are entered (``files.walk``).

    Returns:
        The name of the layout, the objects' folders, sorted, and the other folders searched.

    Raises:
        UserError: the folders are nested too deep.
    """
    marks, layout = {mark: name for name, (mark, _) in LAYOUTS.items()}, ""
    objects, others = [], []
    for folder, subfolders, files in walk(root):
        if folder.count(os.sep) > str(root).count(os.sep) + _MAX_DEPTH:
            raise UserError(f"{root}: its folders are nested deeper than {_MAX_DEPTH}")
        if mark := next((m for m in marks if m in files or m in subfolders), None):
            subfolders.clear()  # objects are not nested
            marks, layout = {mark: marks[mark]}, marks[mark]
            objects.append(Path(folder))
        else:
            others.append(Path(folder))
    return layout, sorted(objects), others
