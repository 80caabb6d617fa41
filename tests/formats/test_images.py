"""Pictures in files: all common kinds, damaged ones, and writing that leaves all or nothing."""

import io
import random
import struct
import zlib

import numpy as np
import pytest
from helpers.images import bad_files, colours, encoded
from PIL import Image

from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder, write_json
from gamba_warp.images import load_rgba, save_image, to_uint8


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
    got = load_rgba(tmp_path / "a.png")
    assert got[0, 0, 3] == 0 and got[1, 2].tolist() == pytest.approx(
        [200 / 255, 100 / 255, 50 / 255, 1]
    )


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_16_bit_grey_keeps_its_range(tmp_path, suffix):
    values = np.array([[0, 1, 257], [32768, 65534, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / f"a.{suffix}")
    got = load_rgba(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(got[..., 0], values / 65535, atol=1e-7)
    assert (got[..., :3] == got[..., :1]).all() and (got[..., 3] == 1).all()


def png16(values):
    """A 16-bit RGB or RGBA PNG, which Pillow reads but cannot write."""
    height, width, channels = values.shape
    kind = {3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0))]
    chunks += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("channels", [3, 4])
def test_16_bit_colour_is_read_to_8_bits(tmp_path, channels):
    values = np.random.default_rng(0).integers(0, 65536, (5, 7, channels))
    (tmp_path / "a.png").write_bytes(png16(values))
    got = load_rgba(tmp_path / "a.png")[..., :channels]
    np.testing.assert_allclose(got, values / 65535, atol=1.01 / 255)  # Pillow keeps the high byte


def test_float_tiff_is_scaled_and_stays_finite(tmp_path):
    values = np.array([[0.0, 0.5, np.nan], [4.0, np.inf, -1.0]], np.float32)
    Image.fromarray(values).save(tmp_path / "a.tiff")
    got = load_rgba(tmp_path / "a.tiff")
    np.testing.assert_allclose(got[..., 0], [[0, 0.125, 0], [1, 1, 0]])


def test_exif_rotation_is_applied(tmp_path):
    image = colours()
    exif = image.getexif()
    exif[0x0112] = 6  # turn a quarter clockwise to view
    image.save(tmp_path / "a.png", exif=exif)
    want = np.asarray(image.rotate(-90, expand=True)) / 255
    np.testing.assert_allclose(load_rgba(tmp_path / "a.png")[..., :3], want, atol=1e-6)


def test_one_pixel_and_extreme_shapes(tmp_path):
    for size in [(1, 1), (1, 3000), (3000, 1)]:
        Image.new("RGB", size, (255, 0, 0)).save(tmp_path / "a.png")
        assert load_rgba(tmp_path / "a.png").shape == (size[1], size[0], 4)


def test_a_phone_picture_with_a_preview_is_one_picture(tmp_path):
    """Many cameras append a second picture to a JPEG (MPO); it is not an animation."""
    content = io.BytesIO()
    colours().save(content, "MPO", save_all=True, append_images=[colours(size=(3, 3))])
    (tmp_path / "a.jpg").write_bytes(content.getvalue())
    assert load_rgba(tmp_path / "a.jpg").shape == (5, 7, 4)


def test_bad_files_are_named_with_the_reason(tmp_path):
    for name, path, reason in bad_files(tmp_path):
        with pytest.raises(UserError) as caught:
            load_rgba(path)
        message = str(caught.value)
        assert message.startswith(f"{path}: ") and reason in message, name
        assert "\n" not in message


def test_huge_pictures_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr("gamba_warp.images.MAX_PIXELS", 34)
    colours().save(tmp_path / "a.png")
    with pytest.raises(UserError, match="7x5 is over"):
        load_rgba(tmp_path / "a.png")


@pytest.mark.filterwarnings("ignore::UserWarning")  # of the TIFF decoder
@pytest.mark.parametrize("form", ["PNG", "JPEG", "GIF", "TIFF", "WEBP", "BMP"])
def test_damaged_files_give_a_picture_or_a_user_error(tmp_path, form):
    rng, whole = random.Random(form), encoded(form)
    path = tmp_path / "a"
    failed = 0
    for _ in range(150):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(min(len(content), rng.choice([64, 10**9])))] = rng.randrange(256)
        path.write_bytes(content[: rng.choice([len(content), rng.randrange(1, len(content))])])
        try:
            assert load_rgba(path).shape[2] == 4
        except UserError:
            failed += 1
    assert failed > 10


def test_saved_pictures_come_back(tmp_path):
    for shape in [(5, 7), (5, 7, 1), (5, 7, 3), (5, 7, 4)]:
        picture = np.random.default_rng(1).random(shape).astype(np.float32)
        save_image(tmp_path / "a.png", picture)
        got = load_rgba(tmp_path / "a.png")
        want = np.broadcast_to(picture.reshape(5, 7, -1), (5, 7, max(3, picture.shape[-1] % 7)))
        np.testing.assert_allclose(got[..., : want.shape[2]], want, atol=0.501 / 255)


def test_to_uint8_rounds_and_clips():
    values = np.array([-1, 0, 0.5 / 255, 0.499 / 255, 1, 2, np.nan, np.inf])
    assert to_uint8(values).tolist() == [0, 0, 1, 0, 255, 255, 0, 255]


def test_atomic_path_leaves_all_or_nothing(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt" and temporary.parent == tmp_path
        raise RuntimeError
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    with atomic_path(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new" and len(list(tmp_path.iterdir())) == 1
    reference = tmp_path / "plain"
    reference.touch()
    assert path.stat().st_mode == reference.stat().st_mode  # as an ordinary new file


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    for path in [tmp_path / "file" / "a.json", tmp_path / "none" / "a.json", tmp_path]:
        with pytest.raises(UserError) as caught:
            write_json(path, {})
        assert str(caught.value).startswith(f"cannot write {path}: ")
    for path in [tmp_path / "file", tmp_path / "file" / "sub", "/dev/null/x"]:
        with pytest.raises(UserError, match=f"cannot write into {path}"):
            output_folder(path)
    assert output_folder(tmp_path / "new" / "deep").is_dir()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "new"]


def test_a_full_disk_is_a_user_error(tmp_path):
    def full():
        raise OSError(28, "No space left on device")

    with pytest.raises(UserError, match=r"cannot write .*a\.bin: No space left"):
        with atomic_path(tmp_path / "a.bin"):
            full()
    assert not list(tmp_path.iterdir())


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())
