"""Images in files: all common kinds, damaged ones, and atomic writes."""

import io
import os
import struct
import zlib

import numpy as np
import pytest
from helpers.images import (
    ADOBE_RGB,
    DISPLAY_P3,
    SRGB,
    bad_files,
    colour_profile,
    colours,
    encoded,
    png_of,
    png_of_size,
)
from helpers.refusals import refused, refused_at
from PIL import EpsImagePlugin, Image, ImageOps

from gamba_warp.errors import FileWarning, UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.images import image_size, load_rgba, load_rgba8, open_image, save_image, to_uint8


@pytest.mark.parametrize(
    "mode, suffix",
    [
        *[("RGB", s) for s in ("png", "bmp", "tiff", "webp", "ppm", "gif")],
        *[("RGBA", "png"), ("LA", "png"), ("L", "png"), ("1", "png"), ("P", "png"), ("P", "gif")],
        *[("CMYK", "tiff"), ("L", "jpg"), ("RGBA", "webp")],
    ],
)
def test_common_files_are_read_as_pillow_converts_them(tmp_path, mode, suffix):
    path = tmp_path / f"a.{suffix}"
    options = {"lossless": True, "exact": True} if suffix == "webp" else {}
    colours(mode).save(path, **options)
    got = load_rgba(path)
    assert got.shape == (5, 7, 4) and got.dtype == np.float32
    with Image.open(path) as image:
        want = np.asarray(image.convert("RGBA")) / 255
    np.testing.assert_allclose(got, want, atol=1e-6)
    if "A" not in mode:
        assert (got[..., 3] == 1).all()


def test_palette_transparency_becomes_alpha(tmp_path):
    image = Image.new("P", (3, 2))
    image.putpalette([10, 20, 30, 200, 100, 50])
    image.putpixel((2, 1), 1)
    image.save(tmp_path / "a.png", transparency=0)
    got = 255 * load_rgba(tmp_path / "a.png")
    assert got[0, 0, 3] == 0 and got[1, 2].tolist() == pytest.approx([200, 100, 50, 255])


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_16_bit_grey_keeps_its_range(tmp_path, suffix):
    values = np.array([[0, 1, 257], [32768, 65534, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / f"a.{suffix}")
    got = load_rgba(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(got[..., 0], values / 65535, atol=1e-7)
    assert (got[..., :3] == got[..., :1]).all() and (got[..., 3] == 1).all()


def png16(values, key=None, bits=16, more=()):
    """Return a PNG of any bit depth, which Pillow cannot write, perhaps with a transparent value.

    ``more`` chunks stand before the others.
    """
    height, width, channels = values.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    high = values.astype(">u2").reshape(height, -1)
    of_bits = np.unpackbits(high.view(np.uint8), axis=1).reshape(height, -1, 16)[..., -bits:]
    rows = b"".join(b"\0" + row.tobytes() for row in np.packbits(of_bits.reshape(height, -1), 1))
    head = b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    more = more if key is None else [*more, (b"tRNS", np.array(key, ">u2").tobytes())]
    return png_of(head, *more, (b"IDAT", zlib.compress(rows)), (b"IEND", b""))


@pytest.mark.parametrize("channels, bits", [(1, 2), (1, 4), (1, 8), (1, 16), (3, 8), (3, 16)])
def test_a_transparent_value_becomes_alpha(tmp_path, channels, bits):
    """Pillow compares 8-bit pixels with the file's value of another bit depth."""
    most = 2**bits - 1
    values = np.random.default_rng(0).integers(0, most, (5, 7, channels))
    values[1, 2] = values[4, 0] = most  # what no other pixel is
    values[0, 0], values[0, 1] = 0, [1, *[0] * (channels - 1)]  # of 16 bits, with one high byte
    for key in ([most] * channels, [0] * channels):
        (tmp_path / "a.png").write_bytes(png16(values, key, bits))
        for got in (load_rgba(tmp_path / "a.png"), load_rgba8(tmp_path / "a.png") / 255):
            np.testing.assert_array_equal(got[..., 3], (values != key).any(-1))
            want = np.broadcast_to(values / most, (5, 7, 3))
            # Colour of 16 bits is rounded to 8.
            np.testing.assert_allclose(got[..., :3], want, atol=0.501 / 255 if bits == 16 else 1e-6)
    large = np.kron(values, np.ones((16, 16, 1), int))
    (tmp_path / "a.png").write_bytes(png16(large, [most] * channels, bits))
    alpha = load_rgba(tmp_path / "a.png", 14)[..., 3]  # by blocks of four
    np.testing.assert_array_equal(alpha[::4, ::4], (values != most).any(-1))


@pytest.mark.parametrize("channels", [2, 3, 4])
def test_16_bit_colour_is_rounded_to_8_bits(tmp_path, channels):
    """Pillow keeps the high byte alone, up to a whole step below."""
    values = np.random.default_rng(0).integers(0, 65536, (64, 1024, channels))
    values[..., 0] = np.arange(65536).reshape(64, 1024)
    (tmp_path / "a.png").write_bytes(png16(values))
    want = np.rint(values / 257)
    want = want[..., [0, 0, 0, 1]] if channels == 2 else want
    np.testing.assert_array_equal(load_rgba8(tmp_path / "a.png")[..., : want.shape[2]], want)
    got = load_rgba(tmp_path / "a.png")[..., : want.shape[2]]
    np.testing.assert_array_equal(got, (want / 255).astype(np.float32))


def chunked(*chunks, pixel=(200, 60, 30)):
    """Return a PNG of one colour with more chunks."""
    return png16(np.full((2, 2, 3), pixel), bits=8, more=chunks)


def numbers(*values):
    """Return numbers of a chunk."""
    return struct.pack(f">{len(values)}I", *values)


CHRM = [31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000]
ADOBE = [31270, 32900, 64000, 33000, 21000, 71000, 15000, 6000]
P3 = bytes([12, 13, 0, 1])
EXIF_R03 = b"II*\0\x08\0\0\0\1\0\x05\xa0\4\0\1\0\0\0\x1a\0\0\0\0\0\0\0"
EXIF_R03 += b"\1\0\1\0\2\0\4\0\0\0R03\0\0\0\0\0"
STATED = {  # sRGB values of (200, 60, 30) in the space, by the published primaries and curves
    "sRGB by its numbers": ((b"cICP", bytes([1, 13, 0, 1])), (200, 60, 30)),
    "Display P3": ((b"cICP", P3), (217, 42, 0)),
    "cHRM, gAMA of sRGB": ((b"cHRM", numbers(*CHRM)), (b"gAMA", numbers(45455)), (200, 60, 30)),
    "Adobe RGB by cHRM": ((b"cHRM", numbers(*ADOBE)), (b"gAMA", numbers(45470)), (232, 57, 21)),
    "linear gAMA": ((b"gAMA", numbers(100000)), (228, 132, 96)),
    "sRGB before gAMA": ((b"gAMA", numbers(100000)), (b"sRGB", b"\0"), (200, 60, 30)),
    "cICP before gAMA": ((b"gAMA", numbers(100000)), (b"cICP", P3), (217, 42, 0)),
    "Adobe RGB by EXIF": ((b"eXIf", EXIF_R03), (232, 57, 21)),
}


@pytest.mark.parametrize("name", STATED)
def test_colour_spaces_told_by_numbers(tmp_path, name):
    *chunks, want = STATED[name]
    lines, path = [], tmp_path / "a.png"
    path.write_bytes(chunked(*chunks))
    got = 255 * load_rgba(path, warn=lines.append)[0, 0, :3]
    np.testing.assert_allclose(got, want, atol=1)  # of rounding, and of a curve for another
    assert not lines


@pytest.mark.parametrize("tag, value", [(0xC612, b"\1\4\0\0"), (0xFE, 1)])
def test_raw_photographs_are_refused(tmp_path, tag, value):
    """Of these Pillow would read a preview."""
    colours().save(tmp_path / "a.dng", "TIFF", tiffinfo={tag: value})
    refused("a raw photograph, .* preview of 7x5", load_rgba, tmp_path / "a.dng")


def test_colours_of_pq(tmp_path):
    """A grey of 203 cd/m² is white; half of its light is half of white's."""
    for value, want in ((148, 255), (130, 188)):
        content = chunked((b"cICP", bytes([9, 16, 0, 1])), pixel=[value] * 3)
        (tmp_path / "a.png").write_bytes(content)
        got = load_rgba8(tmp_path / "a.png")[0, 0]
        assert np.ptp(got[:3]) == 0
        np.testing.assert_allclose(got[:3], want, atol=3)  # a step of PQ is two there


@pytest.mark.parametrize(
    "chunk, reason",
    [
        ((b"cICP", bytes([9, 18, 0, 1])), r"primaries 9, transfer 18 of H.273"),
        ((b"cICP", bytes([1, 13, 0, 0])), "narrow range"),
        ((b"cHRM", numbers(*[0] * 8)), ""),
        ((b"gAMA", numbers(0)), ""),
    ],
)
def test_invalid_colour_spaces_are_named(tmp_path, chunk, reason):
    lines, path = [], tmp_path / "a.png"
    path.write_bytes(chunked(chunk))
    assert load_rgba(path, warn=lines.append)[0, 0, 0] == np.float32(200 / 255)
    (line,) = lines
    assert line.startswith(f"{path}: its colour space is not used") and reason in line


@pytest.mark.parametrize("suffix", ["avif", "heic"])
def test_colours_of_phones_told_by_numbers(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    image = Image.new("RGB", (64, 64), (200, 60, 30))
    if suffix == "heic":
        heif = pytest.importorskip("pillow_heif")
        file = heif.from_pillow(image)
        file.save(path, quality=-1, chroma=444, color_primaries=12, transfer_characteristics=13)
    else:
        image.save(path, quality=100, subsampling="4:4:4")
        content = path.read_bytes()
        at = content.index(b"colrnclx") + 8
        path.write_bytes(content[:at] + struct.pack(">2H", 12, 13) + content[at + 4 :])
    # Lossy files are a step or two off, which the wider primaries double.
    np.testing.assert_allclose(load_rgba8(path)[32, 32, :3], (217, 42, 0), atol=4)


def in_srgb(pixels, columns, gamma):
    """Convert values of 0 to 255 of a space with a gamma to sRGB."""
    linear = (pixels / 255.0) ** gamma @ np.array(columns).T
    linear = np.clip(linear @ np.linalg.inv(SRGB).T, 0, 1)
    return 255 * np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("suffix", ["png", "tiff", "jpg", "webp"])
@pytest.mark.parametrize("columns, gamma", [(ADOBE_RGB, 2.2), (DISPLAY_P3, 1.8)])
def test_colour_profiles_become_srgb(tmp_path, suffix, columns, gamma, recwarn):
    path = tmp_path / f"a.{suffix}"
    mode = "RGB" if suffix == "jpg" else "RGBA"
    options = {"webp": {"lossless": True, "exact": True}, "jpg": {"quality": 100}}.get(suffix, {})
    colours(mode).save(path, icc_profile=colour_profile(columns, gamma), **options)
    with Image.open(path) as image:
        before = np.asarray(image.convert("RGBA"))
    want = in_srgb(before[..., :3], columns, gamma)
    for got in (255 * load_rgba(path), load_rgba8(path)):
        # Half a step of rounding, and one of littleCMS's tables.
        np.testing.assert_allclose(got[..., :3], want, atol=1.5)
        np.testing.assert_array_equal(got[..., 3], before[..., 3])
    assert np.abs(want - before[..., :3]).max() > 20 and not recwarn.list


def test_a_profile_of_srgb_leaves_every_bit(tmp_path):
    from PIL import ImageCms

    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for mode in ("RGB", "RGBA", "P", "L", "LA", "1"):
        colours(mode).save(tmp_path / "a.png", icc_profile=srgb)
        colours(mode).save(tmp_path / "b.png")
        np.testing.assert_array_equal(load_rgba(tmp_path / "a.png"), load_rgba(tmp_path / "b.png"))


@pytest.mark.parametrize("columns", [None, ADOBE_RGB], ids=["grey", "rgb"])
@pytest.mark.parametrize("mode", ["L", "LA", "I;16"])
def test_grey_has_profiles_too(tmp_path, mode, columns):
    """A grey image stays grey, as masks must."""
    values = np.arange(256, dtype=np.uint8).reshape(16, 16)
    if mode == "I;16":
        grey = Image.fromarray(257 * values.astype(np.uint16))
    else:
        grey = Image.fromarray(values).convert(mode)
    grey.save(tmp_path / "a.png", icc_profile=colour_profile(columns, 1.0))
    got = load_rgba(tmp_path / "a.png")
    want = in_srgb(np.repeat(values[..., None], 3, -1), SRGB, 1.0)
    np.testing.assert_allclose(255 * got[..., :3], want, atol=1)  # of which rounding is a half
    assert (got[..., :3] == got[..., :1]).all() and (got[..., 3] == 1).all()


def test_cmyk_goes_by_its_profile(tmp_path):
    inks = Image.new("CMYK", (64, 64), (255, 255, 0, 0))
    inks.paste((0, 0, 0, 255), (0, 0, 32, 64))
    for suffix in ("jpg", "tiff"):
        inks.save(tmp_path / f"a.{suffix}", icc_profile=colour_profile("CMYK"))
        got = 255 * load_rgba(tmp_path / f"a.{suffix}", 8)
        assert got.shape == (16, 16, 4)
        # L* of 75 and of 50, in sRGB; 8 bits of L* in the profile's table are half a step of ours.
        assert np.abs(got[8, 4, :3] - 185.5).max() < 2 and np.abs(got[8, 12, :3] - 118.9).max() < 2


@pytest.mark.parametrize(
    "mode, profile, reason",
    [
        ("RGB", b"no profile", ""),
        ("RGBA", colour_profile(ADOBE_RGB)[:200], ""),
        ("RGB", colour_profile("CMYK"), "it is for CMYK, but the image is RGB"),
        ("CMYK", colour_profile(SRGB), "it is for RGB, but the image is CMYK"),
        ("L", bytes(5 << 20), "damaged or too large"),
    ],
)
def test_what_is_no_profile_is_said_and_keeps_the_pixels(tmp_path, mode, profile, reason):
    path = tmp_path / "a.tiff"
    colours(mode).save(path, icc_profile=profile)
    with pytest.warns(FileWarning, match=f"a.tiff: its colour profile is not used.*{reason}"):
        got = load_rgba(path)
    want = np.asarray(colours(mode).convert("RGBA")) / np.float32(255)
    np.testing.assert_array_equal(got, want)


def test_float_tiff_is_scaled_and_stays_finite(tmp_path):
    values = np.array([[0.0, 0.5, np.nan], [4.0, np.inf, -1.0]], np.float32)
    Image.fromarray(values).save(tmp_path / "a.tiff")
    got = load_rgba(tmp_path / "a.tiff")
    np.testing.assert_allclose(got[..., 0], [[0, 0.125, 0], [1, 1, 0]])


def test_one_pixel_and_extreme_shapes(tmp_path):
    for size in [(1, 1), (1, 3000), (3000, 1)]:
        Image.new("RGB", size, (255, 0, 0)).save(tmp_path / "a.png")
        assert load_rgba(tmp_path / "a.png").shape == (size[1], size[0], 4)


def test_a_phone_image_with_a_preview_is_one_image(tmp_path):
    """Many cameras append a second image to a JPEG (MPO); it is not an animation."""
    both = {"save_all": True, "append_images": [colours(size=(3, 3))]}
    colours().save(tmp_path / "a.jpg", "MPO", **both)
    assert load_rgba(tmp_path / "a.jpg").shape == (5, 7, 4)


def test_bad_files_are_named_with_the_reason(tmp_path):
    for _, path, reason in bad_files(tmp_path):
        refused_at(path, reason, load_rgba, path)


def test_saved_images_come_back(tmp_path):
    for shape in [(5, 7), (5, 7, 1), (5, 7, 3), (5, 7, 4)]:
        image = np.random.default_rng(1).random(shape).astype(np.float32)
        save_image(tmp_path / "a.png", image)
        got = load_rgba(tmp_path / "a.png")
        want = np.broadcast_to(image.reshape(5, 7, -1), (5, 7, max(3, image.shape[-1] % 7)))
        np.testing.assert_allclose(got[..., : want.shape[2]], want, atol=0.501 / 255)


@pytest.mark.parametrize(
    "size, reason",
    [
        ((8192, 8193), "8192x8193 is over 64 megapixels"),
        ((65_535, 1), "65535x1 is over 32768 pixels long"),
        ((1, 32_769), "1x32769 is over 32768 pixels long"),
        ((10**9, 10**9), "over 64 megapixels"),  # over what Pillow itself opens
        ((10**5, 10**5), "over 64 megapixels"),
        ((0, 5), ""),
    ],
)
def test_sizes_are_refused_by_the_header_without_a_warning(tmp_path, recwarn, size, reason):
    path = tmp_path / "a.png"
    path.write_bytes(png_of_size(*size))
    for function in (load_rgba, load_rgba8, image_size):
        refused_at(path, reason, function, path)
    assert not recwarn.list


def test_only_a_few_formats_are_ever_opened(tmp_path, monkeypatch):
    """Pillow would have another program draw a PostScript file of any name."""
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_: pytest.fail("Ghostscript"))
    postscript = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"
    for suffix in ("png", "eps", "jpg"):
        (tmp_path / f"a.{suffix}").write_bytes(postscript)
        assert "not an image" in refused(None, load_rgba, tmp_path / f"a.{suffix}")
    for form in ("ICO", "TGA", "PCX", "SGI", "DDS", "JPEG2000", "PDF", "ICNS"):
        colours("RGBA" if form == "ICNS" else "RGB", (16, 16)).save(tmp_path / "a.png", form)
        assert "not an image" in refused(None, load_rgba, tmp_path / "a.png"), form


def test_a_image_in_memory(tmp_path):
    with open_image(io.BytesIO(encoded("PNG")), "wood.png in a.glb") as image:
        assert image.size == (40, 30)
    for content, reason in ((b"", "not an image"), (encoded("PNG")[:900], "cannot be decoded")):
        with pytest.raises(UserError, match=f"wood: .*{reason}"):
            with open_image(io.BytesIO(content), "wood") as image:
                image.load()
    with pytest.raises(UserError, match="wood: 40x30 is over"):
        with open_image(io.BytesIO(encoded("PNG")), "wood", max_pixels=1199):
            pass


def test_what_is_no_plain_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")  # opening it would wait for ever
    (tmp_path / "round.png").symlink_to("round.png")
    (tmp_path / "file").write_text("x")
    for name in ("pipe.png", "round.png", "file/a.png", "n" * 300, "a\0b.png"):
        assert refused(None, load_rgba, tmp_path / name).startswith(str(tmp_path))


def test_absurd_exif_does_not_hide_the_image(tmp_path, recwarn):
    image = colours()
    want = np.asarray(image) / 255
    exifs = [b"Exif\0\0" + bytes(rng) for rng in ([], [255] * 20, range(200))]
    exifs += [b"Exif\0\0II*\0\x08\0\0\0" + b"\xff" * size for size in (1, 2, 9, 400)]
    exifs.append(b"Exif\0\0MM\0\x2a\xff\xff\xff\xff")
    for value in (0, 9, 60_000):
        exif = image.getexif()
        exif[0x0112] = value
        exifs.append(exif.tobytes())
    for exif in exifs:
        image.save(tmp_path / "a.png", exif=exif)
        np.testing.assert_allclose(load_rgba(tmp_path / "a.png")[..., :3], want, atol=1e-6)
    assert not recwarn.list


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_exif_orientation(tmp_path, orientation):
    image = colours()
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    want = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png"))) / 255
    np.testing.assert_allclose(load_rgba(tmp_path / "a.png")[..., :3], want, atol=1e-6)
    assert image_size(tmp_path / "a.png") == (want.shape[1], want.shape[0])


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "1", "I;16", "F"])
def test_large_images_are_reduced_by_whole_factors(tmp_path, mode):
    """The result has at least twice the requested length, and the mean of the whole image."""
    kind, full = {"I;16": (np.uint16, 65535), "F": (np.float32, 1)}.get(mode, (np.uint8, 255))
    image = Image.fromarray(np.repeat([[full, 0]], 80, 1).repeat(120, 0).astype(kind))
    image = image if mode in ("I;16", "F") else image.convert(mode)
    path = tmp_path / ("a.tiff" if mode == "F" else "a.png")
    image.save(path)
    assert load_rgba(path, 41).shape == (120, 160, 4)
    got = load_rgba(path, 20)
    assert got.shape == (30, 40, 4) and (got[..., 3] == 1).all()
    np.testing.assert_allclose(got[:, :20, :3], 1, atol=1e-6)
    np.testing.assert_allclose(got[:, 20:, :3], 0, atol=1e-6)


def test_reducing_lets_no_background_in(tmp_path):
    pixels = np.zeros((64, 64, 4), np.uint8)
    pixels[..., 1] = 255  # transparent green
    pixels[::2] = (255, 0, 0, 255)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    got = load_rgba(tmp_path / "a.png", 8)
    assert got.shape == (16, 16, 4)
    np.testing.assert_allclose(got, np.broadcast_to([1, 0, 0, 0.5], got.shape), atol=1 / 255)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "L", "LA", "CMYK"])
def test_8_bits_are_the_same_image(tmp_path, mode):
    path = tmp_path / ("a.tiff" if mode == "CMYK" else "a.png")
    colours(mode).save(path)
    got = load_rgba8(path)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got, to_uint8(load_rgba(path)))


def test_bands_of_large_images_meet(tmp_path, monkeypatch):
    colours("RGBA", (50, 40)).save(tmp_path / "a.png")
    Image.fromarray(np.arange(2000, dtype=np.uint16).reshape(40, 50) * 30).save(tmp_path / "b.png")
    want = [load_rgba(tmp_path / f"{name}.png") for name in "ab"]
    monkeypatch.setattr("gamba_warp.images._BAND", 170)
    for name, image in zip("ab", want):
        np.testing.assert_array_equal(load_rgba(tmp_path / f"{name}.png"), image)


def test_to_uint8_rounds_and_clips():
    values = np.array([-1, 0, 0.5 / 255, 0.499 / 255, 1, 2, np.nan, np.inf])
    assert to_uint8(values).tolist() == [0, 0, 1, 0, 255, 255, 0, 255]


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    for path in [tmp_path / "file" / "a.json", tmp_path / "none" / "a.json", tmp_path]:
        assert refused(None, write_json, path, {}).startswith(f"cannot write {path}: ")
    for path in [tmp_path / "file", tmp_path / "file" / "sub", "/dev/null/x"]:
        refused(f"cannot write into {path}", output_folder, path)
    assert output_folder(tmp_path / "new" / "deep").is_dir()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "new"]


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())
