"""Pictures for tests: random ones, their files in memory, and files that are not pictures."""

import io
import struct
import zlib

import numpy as np
from PIL import Image

from gamba_warp.images import save_image


def colours(mode="RGB", size=(7, 5)):
    """Makes a PIL picture of random colours, the same on each call; ``size`` is (width, height)."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (size[1], size[0], 4), dtype=np.uint8)
    image = Image.fromarray(pixels, "RGBA")
    return image.convert(mode) if "A" in mode else image.convert("RGB").convert(mode)


def encoded(form):
    """Returns the bytes of a 40 x 30 picture in a format of PIL."""
    content = io.BytesIO()
    colours(size=(40, 30)).save(content, form)
    return content.getvalue()


def png_of_size(width, height):
    """A PNG whose header states a size, with hardly any data."""

    def chunk(kind, data):
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 999)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def bad_files(folder):
    """Writes files that cannot be read as a picture; yields name, path and the expected reason."""
    first, second = colours("P"), colours("P", (7, 5)).transpose(Image.Transpose.ROTATE_180)
    yield "missing", folder / "none.png", "no such file"
    yield "folder", folder, "is a folder"
    for name, content, reason in [
        ("empty.png", b"", "the file is empty"),
        ("text.jpg", b"hello", "not a picture"),
        ("noise.png", bytes(range(256)), "not a picture"),
        ("cut.png", encoded("PNG")[:1500], "cannot be decoded"),
        ("cut.jpg", encoded("JPEG")[:800], "cannot be decoded"),
        ("head.png", encoded("PNG")[:20], ""),
        ("huge.png", png_of_size(20_000, 20_000), "is over 64 megapixels"),
        ("long.png", png_of_size(40_000, 2), "is over 32768 pixels long"),
        ("film.heic", b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom" + b"\0" * 99, ""),
    ]:
        (folder / name).write_bytes(content)
        yield name, folder / name, reason
    for name in ("moving.gif", "moving.webp"):
        first.convert("RGB").save(folder / name, save_all=True, append_images=[second])
        yield name, folder / name, "animated picture (2 frames)"


def cut_out(path, colour=(0.8, 0.3, 0.1)):
    """Writes a picture of one square, cut out; returns its path."""
    rgba = np.zeros((20, 30, 4))
    rgba[4:16, 8:24] = (*colour, 1)
    save_image(path, rgba)
    return path


def disc_on_noise(size: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A red disc in the middle of blue and green blocks, ``[H, W, 3]``, and its alpha."""
    height, width = size
    rng = np.random.default_rng(seed)
    blocks = rng.random((height // 8 + 1, width // 8 + 1, 3)) * (0.3, 0.8, 0.9)
    rgb = np.kron(blocks, np.ones((8, 8, 1)))[:height, :width]
    y, x = np.mgrid[:height, :width]
    far = np.hypot(y - height / 2 + 0.5, x - width / 2 + 0.5)
    alpha = np.clip(0.3 * min(size) + 0.5 - far, 0, 1)[..., None]
    red = np.array([0.9, 0.15, 0.1]) + rng.normal(0, 0.03, (height, width, 3))
    picture = alpha * red + (1 - alpha) * rgb
    return picture.clip(0, 1).astype(np.float32), alpha[..., 0].astype(np.float32)
