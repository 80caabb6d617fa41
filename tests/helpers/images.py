"""Pictures for tests: random ones, their files in memory, and files that are not pictures."""

import io

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
    ]:
        (folder / name).write_bytes(content)
        yield name, folder / name, reason
    first.save(folder / "moving.gif", save_all=True, append_images=[second])
    yield "moving.gif", folder / "moving.gif", "animated picture (2 frames)"


def cut_out(path, colour=(0.8, 0.3, 0.1)):
    """Writes a picture of one square, cut out; returns its path."""
    rgba = np.zeros((20, 30, 4))
    rgba[4:16, 8:24] = (*colour, 1)
    save_image(path, rgba)
    return path
