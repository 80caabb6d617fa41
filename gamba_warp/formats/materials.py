"""What a mesh's file refers to: materials and textures, of files beside it and of nowhere else.

trimesh parses materials and asks ``side_files`` for the files that they name. Each lies in the
mesh's own folder, is plain and of bounded size, and is a picture of a known format where it is to
be one. What cannot be had is replaced and named; it never stops the mesh.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import UserError
from ..images import FORMATS, check_size, open_picture
from ..untrusted.documents import read_bytes
from ..untrusted.names import inside

GREY = 0.6  # display value of a surface whose colour is not known
MAX_TEXTURE = 2048  # pixels a side; larger ones are halved until they fit
MAX_SIDE_FILE = 256 << 20  # bytes of a file beside the mesh
MAX_SIDE_FILES = 1 << 30  # bytes of all of them, and of all textures as they are kept
_POSTSCRIPT = (b"%!PS", b"\xc5\xd0\xd3\xc6")  # trimesh would let Pillow run another program on it


@dataclass
class Material:
    """How a surface looks.

    Attributes:
        color: ``[4]`` float32 RGBA, linear light, multiplies the texture.
        texture: ``[h, w, 4]`` uint8 RGBA, display (sRGB) values, not premultiplied; or None.
    """

    color: np.ndarray
    texture: np.ndarray | None = None


def to_linear(display: np.ndarray | float) -> np.ndarray:
    """SRGB display values in [0, 1] to linear light (IEC 61966-2-1), any shape, float32."""
    x = np.asarray(display, dtype=np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass
class Budget:
    """What the textures of one file may still take.

    Attributes:
        left: bytes.
    """

    left: int = MAX_SIDE_FILES


def side_files(path: Path, warnings: list[str]):
    """A resolver for trimesh, which finds side files whatever their case, slashes or options.

    What is not found, or is not fit to be read, goes into ``warnings``.
    """
    from trimesh.resolvers import FilePathResolver

    known: dict[str, bytes] = {}

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            if name not in known:
                if sum(map(len, known.values())) > MAX_SIDE_FILES:
                    raise OSError("too many bytes beside the mesh")
                known[name] = _side_file(path, name, warnings)
            return known[name]

    return Resolver(str(path))


def _side_file(path: Path, name: str, warnings: list[str]) -> bytes:
    """What a file beside a mesh holds. Raises OSError, which trimesh takes for a missing one."""
    shown = " ".join(name[:100].split())
    try:
        file = _find_file(path.parent, name)
        if file is None:
            raise UserError(f"{shown}: not found")
        data = read_bytes(file, MAX_SIDE_FILE)
        suffix = file.suffix.lower()
        numbers = path.suffix.lower() == ".gltf" and suffix not in Image.registered_extensions()
        if data.startswith(_POSTSCRIPT):
            raise UserError(f"{shown}: not a picture that can be read")
        if suffix not in (".mtl", ".bin") and not numbers:
            with open_picture(io.BytesIO(data), shown):
                pass
    except UserError as error:
        warnings.append(str(error))
        raise OSError(str(error)) from error
    return data


def _find_file(folder: Path, name: str) -> Path | None:
    """The file of that name in a folder or below it; None without one, or where it is elsewhere."""
    # Options of MTL stand before the name: "-s 1 1 1 -clamp on wood.jpg".
    bare = re.sub(r"^(-\w+\s+(([-+.\d]+|on|off|[rgbmlz])\s+)+)+", "", name[:2000].strip())
    for candidate in (name, bare, Path(bare.replace("\\", "/")).name):
        relative = candidate.strip().strip('"').replace("\\", "/").lstrip("/")
        try:
            place = folder
            for part in inside(folder, relative, "a mesh").relative_to(folder).parts:
                exact = place / part
                if not exact.exists() and place.is_dir():
                    same = [p for p in place.iterdir() if p.name.lower() == part.lower()]
                    exact = same[0] if same else exact
                place = exact
            if place.is_file():
                return inside(folder, place.relative_to(folder).as_posix(), "a mesh")
        except (UserError, OSError):  # over-long, absolute, out of the folder
            continue
    return None


def make_material(source, path: Path, warnings: list[str], budget: Budget) -> Material:
    """Makes our material of one of trimesh's.

    Args:
        source: its material.
        path: the mesh's file.
        warnings: what is missing is added to them, one line each.
        budget: what the textures of one file may still take.
    """
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    if isinstance(source, PBRMaterial):
        texture = _texture(source.baseColorTexture, warnings, budget)
        factor = source.baseColorFactor
        color = np.ones(4)
        if factor is not None and np.shape(factor) == (4,):  # glTF may hold anything there
            color = np.asarray(factor, np.float64) / 255
        if source.alphaMode in (None, "OPAQUE"):
            color[3] = 1.0
            if texture is not None:
                texture[..., 3] = 255
        elif source.alphaMode == "MASK" and texture is not None:
            cut = source.alphaCutoff if isinstance(source.alphaCutoff, (int, float)) else 0.5
            texture[..., 3] = np.where(texture[..., 3] >= 255 * cut, 255, 0)
        return Material(_finite(color), texture)
    grey = Material(np.array([*[to_linear(GREY)] * 3, 1], np.float32))
    # trimesh invents a material where there is none; one from an MTL file has kwargs.
    made_up = path.suffix.lower() == ".obj" and not source.kwargs
    if not isinstance(source, SimpleMaterial) or made_up:
        warnings.append("a part has no material: grey")
        return grey
    texture = _texture(source.image, warnings, budget)
    mask = source.kwargs.get("map_d")
    if texture is not None and mask:
        texture = _with_mask(texture, path.parent, " ".join(mask), warnings)
    color = np.ones(4, np.float32)
    if texture is None:
        if "kd" in source.kwargs:
            color[:3] = to_linear(np.asarray(source.diffuse[:3], np.float32) / 255)
        else:
            color[:3] = grey.color[:3]
    color[3] = _opacity(source.kwargs)
    return Material(_finite(color), texture)


def _finite(color: np.ndarray) -> np.ndarray:
    """A file's colour as float32 in [0, 1]; what is no number there is grey."""
    values = np.where(np.isnan(color), to_linear(GREY), color)
    return np.clip(values, 0.0, 1.0).astype(np.float32)


def _opacity(options: dict) -> float:
    """MTL's ``d`` (1 is opaque) or ``Tr`` (0 is opaque)."""
    for key, sign in (("d", 1), ("tr", -1)):
        try:
            value = float(options[key][-1])
        except (KeyError, IndexError, TypeError, ValueError):
            continue
        return float(np.clip(value if sign > 0 else 1 - value, 0, 1))
    return 1.0


def _texture(image: Image.Image | None, warnings: list[str], budget: Budget) -> np.ndarray | None:
    if image is None:
        return None
    if not isinstance(image, Image.Image):  # glTF's index of a picture may be anything
        warnings.append("a texture: not a picture that can be read")
        return None
    name = image.info.get("file_path", "a texture")
    try:
        # trimesh has opened it, so nothing is decoded yet; one that it made has no format.
        if image.format is not None and image.format not in (*FORMATS, "MPO"):
            raise UserError(f"{name}: not a picture that can be read")
        check_size(image.width, image.height, name)
        image = image.convert("RGBA")
    except UserError as error:
        warnings.append(str(error))
        return None
    except Exception as error:  # decoders raise errors of nearly any type on damaged files
        warnings.append(f"{name}: cannot be decoded ({error})")
        return None
    while max(image.size) > MAX_TEXTURE:
        image = image.reduce(2)
    budget.left -= 4 * image.width * image.height
    if budget.left < 0:
        warnings.append(f"{name}: too many textures, left out")
        return None
    texture = np.array(image)
    if texture[..., 3].max() < 8:  # the alpha channel is unused, the object is not invisible
        texture[..., 3] = 255
    return texture


def _with_mask(texture: np.ndarray, folder: Path, name: str, warnings: list[str]) -> np.ndarray:
    """The texture with its alpha from MTL's ``map_d``: that picture's alpha, or its grey."""
    file = _find_file(folder, name)
    if file is None:
        warnings.append(f"{name}: not found")
        return texture
    try:
        with open_picture(file, name) as image:
            alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema()[0] == 255:
                alpha = image.convert("L")
            alpha = alpha.resize((texture.shape[1], texture.shape[0]))
    except UserError as error:
        warnings.append(str(error))
        return texture
    texture[..., 3] = np.asarray(alpha)
    return texture
