"""Images for tests: random ones, their files in memory, and files that are not images."""

import io
import struct
import zlib

import numpy as np
from PIL import Image

from gamba_warp.images import save_image


def colours(mode="RGB", size=(7, 5)):
    """Make a PIL image of random colours, the same on each call; ``size`` is (width, height)."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (size[1], size[0], 4), dtype=np.uint8)
    image = Image.fromarray(pixels, "RGBA")
    return image.convert(mode) if "A" in mode else image.convert("RGB").convert(mode)


def bytes_of(image, form="PNG", **options):
    """Return the bytes of an image in a format of PIL."""
    content = io.BytesIO()
    image.save(content, form, **options)
    return content.getvalue()


def encoded(form):
    """Return the bytes of a 40 x 30 image in a format of PIL."""
    return bytes_of(colours(size=(40, 30)), form)


def png_of(*chunks):
    """Return a PNG of chunks, each a name and its data, with their checksums."""
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def png_of_size(width, height):
    """A PNG whose header states a size, with hardly any data."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return png_of((b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 999)), (b"IEND", b""))


# Columns of linear red, green and blue to XYZ at D50, as the published profiles hold them.
SRGB = [[0.4361, 0.3852, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]]
ADOBE_RGB = [[0.6097, 0.2053, 0.1492], [0.3111, 0.6257, 0.0632], [0.0195, 0.0609, 0.7446]]
DISPLAY_P3 = [[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]]


def colour_profile(columns=None, gamma=2.2):
    """A small ICC profile: of RGB with these columns, of CMYK (``"CMYK"``), or of grey.

    CMYK is of an L* that falls in a straight line with each ink, from 100 to 0 with all four.
    """

    def numbers(*values):
        return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))

    curve = b"curv" + bytes(4) + struct.pack(">IHH", 1, round(256 * gamma), 0)
    tags = {b"wtpt": b"XYZ " + bytes(4) + numbers(0.9642, 1, 0.8249)}
    if columns == "CMYK":
        space, kind = b"CMYK", b"prtrLab "
        inks = np.stack(np.meshgrid(*[[0, 1]] * 4, indexing="ij"), -1).reshape(-1, 4)
        lab = np.full((16, 3), 128, np.uint8)
        lab[:, 0] = np.round(255 - 63.75 * inks.sum(1))
        same = bytes(range(256))
        table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + numbers(1, 0, 0, 0, 1, 0, 0, 0, 1)
        tags[b"A2B0"] = table + 4 * same + lab.tobytes() + 3 * same
    elif columns is None:
        space, kind = b"GRAY", b"mntrXYZ "
        tags[b"kTRC"] = curve
    else:
        space, kind = b"RGB ", b"mntrXYZ "
        for name, column in zip("rgb", zip(*columns)):
            tags[f"{name}XYZ".encode()] = b"XYZ " + bytes(4) + numbers(*column)
            tags[f"{name}TRC".encode()] = curve
    at, table, data = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += struct.pack(">4sII", name, at + len(data), len(content))
        data += content
    head = struct.pack(">I4sI", at + len(data), bytes(4), 0x02400000) + kind[:4] + space + kind[4:]
    head += bytes(12) + b"acsp" + bytes(28) + numbers(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + table + data


def bad_files(folder):
    """Write files that cannot be read as an image; yield name, path and the expected reason."""
    first, second = colours("P"), colours("P", (7, 5)).transpose(Image.Transpose.ROTATE_180)
    yield "missing", folder / "none.png", "no such file"
    yield "folder", folder, "is a folder"
    for name, content, reason in [
        ("empty.png", b"", "the file is empty"),
        ("text.jpg", b"hello", "not an image"),
        ("noise.png", bytes(range(256)), "not an image"),
        ("cut.png", encoded("PNG")[:1500], "cannot be decoded"),
        ("cut.jpg", encoded("JPEG")[:800], "cannot be decoded"),
        ("head.png", encoded("PNG")[:20], ""),
        ("huge.png", png_of_size(20_000, 20_000), "is over 64 megapixels"),
        ("long.png", png_of_size(40_000, 2), "is over 32768 pixels long"),
        ("film.heic", b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom" + b"\0" * 99, ""),
    ]:
        (folder / name).write_bytes(content)
        yield name, folder / name, reason
    for name in ("moving.gif", "moving.webp", "pages.tiff"):
        first.convert("RGB").save(folder / name, save_all=True, append_images=[second])
        part = "a TIFF of 2 pages" if name == "pages.tiff" else "an animation of 2 frames"
        yield name, folder / name, part


def cut_out(path, colour=(0.8, 0.3, 0.1)):
    """Write an image of one square, cut out; return its path."""
    rgba = np.zeros((20, 30, 4))
    rgba[4:16, 8:24] = (*colour, 1)
    save_image(path, rgba)
    return path


def post(folder):
    """Write an image whose cut-out is doubted: a red post down to the border; return its path."""
    rgb = np.ones((60, 80, 3))
    rgb[20:, 30:50] = 0.8, 0.2, 0.1
    save_image(folder / "post.png", rgb)
    return folder / "post.png"


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
    image = alpha * red + (1 - alpha) * rgb
    return image.clip(0, 1).astype(np.float32), alpha[..., 0].astype(np.float32)
