"""Materials and textures of meshes, read only from the mesh's own folder.

The files are plain, of bounded size, and images of a known format. Missing or unreadable ones are
replaced and named; they never stop the mesh.
"""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from unicodedata import normalize

import numpy as np
from PIL import Image

from ..color_spaces import to_linear
from ..errors import UserError
from ..images import FORMATS, open_image, to_rgba
from ..untrusted.documents import read_bytes
from ..untrusted.names import inside

GREY = 0.6  # display value of a surface whose colour is not known
MAX_TEXTURE = 2048  # pixels a side; larger ones are halved until they fit
MAX_SIDE_FILE = 256 << 20  # bytes of a file in the mesh's folder
MAX_SIDE_FILES = 1 << 30  # bytes of all of them, and of all textures in memory
# Bytes to which the images of a mesh may be decoded: a plain one has few bytes in its file.
FREE_PIXELS, PIXELS_PER_BYTE = 192 << 20, 64
_UNSEEN = 8  # of 255: the alpha channel of a texture without a larger alpha is ignored
# Options of MTL stand before the name: "-s 1 1 1 -clamp on wood.jpg".
_OPTIONS = re.compile(r"^(-\w+\s+(([-+.\d]+|on|off|[rgbmlz])\s+)+)+")
_MOVING = re.compile(r"-([sot])((?:\s+[-+.\d]+)+)\s")
_AS_IT_IS = {"s": r"(\s+1(\.0*)?)+", "o": r"(\s+0(\.0*)?)+", "t": r"(\s+0(\.0*)?)+"}


@dataclass
class Material:
    """Colour of a surface.

    Attributes:
        color: ``[4]`` float32 RGBA, linear light, multiplies the texture.
        texture: ``[h, w, 4]`` uint8 RGBA, display (sRGB) values, not premultiplied; or None.
    """

    color: np.ndarray
    texture: np.ndarray | None = None


def plain(color: np.ndarray) -> np.ndarray:
    """Return a file's linear colour as float32 in [0, 1]; NaN becomes grey."""
    values = np.where(np.isnan(color), to_linear(GREY), color)
    return np.clip(values, 0.0, 1.0).astype(np.float32)


@dataclass
class SideFiles:
    """Files in a mesh's folder, found in any case, with any slashes or options; its warnings."""

    path: Path  # the mesh's file
    warnings: list[str] = field(default_factory=list)  # missing or unread content, one line each
    omitted: list[str] = field(default_factory=list)  # the warnings that concern the shape
    left: int = MAX_SIDE_FILES  # bytes that side files may still have
    texels: int = MAX_SIDE_FILES  # bytes that textures may still take
    pixels: int = FREE_PIXELS  # bytes to which images may still be decoded
    root: Path | None = None  # the folder in which files are read; None: the mesh's own

    def omit(self, what: str) -> None:
        """Warn of unread content that changes the shape."""
        self.warnings.append(what)
        self.omitted.append(what)

    def read(self, *names: str) -> bytes:
        """Read the first of these files that exists. Raises UserError."""
        root = self.root or self.path.parent
        file = _find_file(self.path.parent, root, *names)
        if file is None:
            target = os.path.normpath(self.path.parent / names[0].replace("\\", "/"))
            outside = ".." in names[0] and root not in Path(target).parents
            what = f"outside of {root}, not read" if outside else "not found"
            raise UserError(f"{_shown(names[0])}: {what}")
        data = read_bytes(file, min(MAX_SIDE_FILE, max(self.left, 0)))
        self.left -= len(data)
        return data

    def claim(self, size: int, name: str) -> bool:
        """Count ``size`` bytes of pixels; False, and a warning, if there are too many."""
        self.pixels -= size
        if self.pixels < 0:
            self.warnings.append(f"{name}: too many pixels for the size of its file, left out")
        return self.pixels >= 0

    def image(self, name: str, profiled: bool = True) -> np.ndarray | None:
        """Return the image that an MTL file names, as ``texture`` does."""
        shown = _shown(name)
        for option, values in _MOVING.findall(name[:2000]):
            if not re.fullmatch(_AS_IT_IS[option], values):
                self.warnings.append(f"{shown}: the option -{option} is not read")
        try:
            return self.texture(self.read(name), shown, profiled)
        except UserError as error:
            self.warnings.append(str(error))
            return None

    def texture(
        self, data: bytes | memoryview, name: str, profiled: bool = False
    ) -> np.ndarray | None:
        """Decode an image to ``[h, w, 4]`` uint8 RGBA; None, and a warning, if that fails.

        Colour profiles are used if ``profiled``; glTF 2.0 ignores them (3.8.3, images).
        """
        self.pixels += PIXELS_PER_BYTE * len(data)
        try:
            # The content of TARGA files does not tell their kind.
            formats = ("TGA",) if name.lower().endswith(".tga") else FORMATS
            with open_image(io.BytesIO(data), name, formats=formats) as image:
                if not self.claim(4 * image.width * image.height, name):
                    return None
                pixels = to_rgba(image, name, profiled=profiled, warn=self.warnings.append)
        except UserError as error:
            self.warnings.append(str(error))
            return None
        image = Image.fromarray(pixels)
        while max(image.size) > MAX_TEXTURE:
            image = image.reduce(2)
        self.texels -= 4 * image.width * image.height
        if self.texels < 0:
            self.warnings.append(f"{name}: too many textures, left out")
            return None
        texture = np.array(image)
        if texture[..., 3].max() < _UNSEEN:
            texture[..., 3] = 255
        return texture


def _shown(name: str) -> str:
    return " ".join(name[:100].split())


def _folded(name: str) -> str:
    """Return a name in lower case and in Unicode's composed form, as file systems compare names."""
    return normalize("NFC", name).lower()


def _find_file(folder: Path, root: Path, *names: str) -> Path | None:
    """Return the file of the first name found from a folder on, in a root; None without one."""
    for name in names:
        bare = _OPTIONS.sub("", name[:2000].strip())
        last = Path(bare.replace("\\", "/")).name
        for candidate in (name, bare, last, bare.partition(" #")[0]):
            relative = candidate.strip().strip('"').replace("\\", "/").lstrip("/")
            try:
                base = folder
                if ".." in relative:  # a sister of the mesh's folder
                    target = Path(os.path.normpath(folder / relative))
                    base, relative = root, target.relative_to(root).as_posix()
                place = base
                for part in inside(base, relative, "a mesh").relative_to(base).parts:
                    exact = place / part
                    if not exact.exists() and place.is_dir():
                        matches = [p for p in place.iterdir() if _folded(p.name) == _folded(part)]
                        exact = matches[0] if matches else exact
                    place = exact
                if place.is_file():
                    return inside(base, place.relative_to(base).as_posix(), "a mesh")
            except (UserError, OSError, ValueError):  # over-long, absolute, out of the folder
                continue
    return None
