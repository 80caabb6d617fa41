"""An .spz of version 4, built here from the published layout: valid, malformed, a bomb."""

import gzip
import importlib
import struct
import sys
import tracemalloc

import pytest
import torch
from helpers import refusals
from helpers.gaussians import ZSTD, parts_of_spz, raw_frame, rotations, some, spz_4

from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.read import read_gaussians
from gamba_warp.gaussians import SH_C0

SAFE_ORBIT = struct.pack("<IIfff", 0xADBE0002, 12, -0.5, 1.0, 0.3)


def zstd():
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return pytest.importorskip("backports.zstd")


def bomb(blocks):
    """Return a frame of blocks that repeat one byte 131,072 times, in a window of 2 MB."""
    repeat = ((1 << 17) << 3 | 2).to_bytes(3, "little") + b"\0"
    return ZSTD + b"\x00\x58" + repeat * blocks + b"\1\0\0"


def two(degree=1):
    """Streams of two Gaussians. The numbers are the layout's, not our writer's."""
    fixed = [4096, -10240, 1024, 0, 1, -1]
    positions = b"".join((value & 0xFFFFFF).to_bytes(3, "little") for value in fixed)
    colors, scales = bytes([0, 128, 255] * 2), bytes([160, 144, 128, 160, 160, 160])
    # The largest is w (3); of z 277/511/sqrt(2) = sin(22.5 degrees). Then: the largest is x (0).
    rotation = struct.pack("<II", 3 << 30 | 277, 0)
    harmonics = bytes([192, 128, 64, 130, 128, 126, 128, 255, 0] * 2)
    streams = [positions, bytes([255, 51]), colors, scales, rotation]
    return streams + ([harmonics] if degree else [])


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("extensions", [b"", SAFE_ORBIT, struct.pack("<III", 0xADBE0003, 4, 4)])
def test_the_numbers_of_a_file_by_the_layout(tmp_path, degree, extensions):
    path = tmp_path / "a.spz"
    path.write_bytes(spz_4(two(degree), 2, degree, extensions=extensions))
    got = read_gaussians(path)
    # The file has y up and z backward; what is read has both turned.
    want = torch.tensor([[1.0, 2.5, -0.25], [0.0, -1 / 4096, 1 / 4096]])
    torch.testing.assert_close(got.means, want)
    torch.testing.assert_close(got.opacities, torch.tensor([1.0, 0.2]))
    base = (torch.tensor([0.0, 128, 255]) / 255 - 0.5) / 0.15 * SH_C0 + 0.5
    torch.testing.assert_close(got.colors[0], base)
    torch.testing.assert_close(got.scales[0].log(), torch.tensor([0.0, -1.0, -2.0]))
    flip = torch.diag(torch.tensor([1.0, -1, -1]).double())
    s = 0.5**0.5
    turn = flip @ torch.tensor([[s, -s, 0], [s, s, 0], [0, 0, 1]]).double()
    # 1/511 is a step of the quaternion's numbers, half of it is what they are off, twice as angle
    torch.testing.assert_close(rotations(got.quats.double())[0], turn, atol=2e-3, rtol=0)
    torch.testing.assert_close(rotations(got.quats.double())[1], flip @ flip, atol=1e-6, rtol=0)
    if degree:
        sh = torch.tensor([[64.0, 0, -64], [2, 0, -2], [0, 127, -128]]) / 128
        # Of degree 1 the order is y, z, x, and the first two are turned.
        torch.testing.assert_close(got.harmonics[1], sh * torch.tensor([[-1.0], [-1], [1]]))
    else:
        assert got.harmonics is None


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_packed_streams_are_those_of_version_3(tmp_path, degree):
    """Packed by the library, of more than one block of 128 kB, with a checksum or without."""
    count = 15_000 if degree == 0 else 5_003
    write_gaussians(tmp_path / "three.spz", some(count, degree=degree), "spz")
    streams, *numbers = parts_of_spz((tmp_path / "three.spz").read_bytes())
    module = zstd()
    checked = {module.CompressionParameter.checksum_flag: 1}
    for options in ({}, checked):
        packed = [module.compress(stream, options=options) for stream in streams]
        (tmp_path / "four.spz").write_bytes(spz_4(streams, *numbers, frames=packed))
        want, got = (read_gaussians(tmp_path / f"{name}.spz") for name in ("three", "four"))
        for name in ("means", "quats", "scales", "opacities", "colors"):
            assert torch.equal(getattr(want, name), getattr(got, name)), name
        assert degree == 0 or torch.equal(want.harmonics, got.harmonics)


def refused(path, data, *words):
    path.write_bytes(data)
    tracemalloc.start()
    try:
        text = refusals.refused(None, read_gaussians, path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(path) in text and all(word in text for word in words), text
    assert peak < 5e6  # nothing was made room for


@pytest.mark.parametrize("pack", [raw_frame, lambda data: zstd().compress(data)])
def test_cut_short_anywhere(tmp_path, pack):
    zstd()
    data = spz_4(two(), 2, 1, pack=pack, extensions=SAFE_ORBIT)
    for length in range(4, len(data)):
        refused(tmp_path / "a.spz", data[:length], "truncated")
    refused(tmp_path / "a.spz", data + bytes(3), "invalid header")


def sizes_with(number, packed=None, unpacked=None):
    streams = two()
    sizes = [[len(raw_frame(stream)), len(stream)] for stream in streams]
    sizes[number][0] = sizes[number][0] if packed is None else packed
    sizes[number][1] = sizes[number][1] if unpacked is None else unpacked
    return sizes


LIES = {
    "a version to come": ({"version": 5}, "version 5"),
    "version 3 without gzip": ({"version": 3}, "version 3"),
    "one Gaussian more": ({"count": 3}, "stream 0 has 18 bytes"),
    "one less": ({"count": 1}, "stream 0 has 18 bytes"),
    "none": ({"count": 0}, "0 by the number"),
    "ten million": ({"count": 10_000_000}, "290000000 bytes"),
    "too many": ({"count": 2**32 - 1}, "4294967295 Gaussians"),
    "degree 4": ({"degree": 4}, "degree 4"),
    "degree 2": ({"degree": 2}, "stream 5"),
    "degree 0": ({"degree": 0}, "6 streams"),
    "bits": ({"bits": 31}, "31 bits"),
    "no streams": ({"number": 0}, "0 streams"),
    "255 streams": ({"number": 255}, "255 streams"),
    "a table in the header": ({"table": 31}, "byte 31"),
    "a table past the end": ({"table": 2**32 - 1}, "header and table"),
    "packed to nothing": ({"sizes": sizes_with(2, packed=0)}, "the streams take"),
    "packed beyond the end": ({"sizes": sizes_with(5, packed=2**64 - 1)}, "the streams take"),
    "unpacked to much": ({"sizes": sizes_with(0, unpacked=2**63)}, "stream 0 has 9223"),
    "unpacked to less": ({"sizes": sizes_with(4, unpacked=7)}, "stream 4 has 7 bytes"),
    "other axes": ({"extensions": struct.pack("<III", 0xADBE0003, 4, 6)}, "axes are number 6"),
}


@pytest.mark.parametrize("case", LIES)
def test_a_header_or_a_table_that_lies(tmp_path, case):
    change, word = LIES[case]
    data = spz_4(**({"streams": two(), "count": 2, "degree": 1} | change))
    refused(tmp_path / "a.spz", data, word)


def far(size):
    """Return a raw frame that states, or has a window of, ``size`` bytes."""
    return ZSTD + b"\xe0" + struct.pack("<Q", size) + (18 << 3 | 1).to_bytes(3, "little")


FRAMES = {
    "a bomb of 300 MB": (bomb(2400), "stream 0 holds more than 18 bytes"),
    "a bomb after the frame": (raw_frame(two()[0]) + bomb(2400), "more than 18 bytes"),
    "two frames": (raw_frame(two()[0][:9]) + raw_frame(two()[0][9:]), "more than 18 bytes"),
    "one byte more": (raw_frame(two()[0] + b"\0"), "more than 18 bytes"),
    "one byte less": (raw_frame(two()[0][:-1]), "after 17 of 18 bytes"),
    "nothing": (raw_frame(b""), "after 0 of 18 bytes"),
    "no ZSTD": (gzip.compress(two()[0]), "stream 0 is truncated or damaged"),
    "a terabyte promised": (far(1 << 40) + two()[0], "stream 0 is truncated or damaged"),
    "a wrong checksum": (lambda frame: frame[:-1] + bytes([frame[-1] ^ 1]), "damaged"),
    "half a checksum": (lambda frame: frame[:-2], "truncated"),
}


@pytest.mark.parametrize("case", FRAMES)
def test_a_stream_that_is_something_else(tmp_path, case):
    module = zstd()
    frame, word = FRAMES[case]
    if callable(frame):
        checked = {module.CompressionParameter.checksum_flag: 1}
        frame = frame(module.compress(two()[0], options=checked))
    frames = [frame, *map(raw_frame, two()[1:])]
    refused(tmp_path / "a.spz", spz_4(two(), 2, 1, frames=frames), word)


def test_a_small_file_of_many_equal_gaussians_is_taken_for_a_bomb(tmp_path):
    """29 million bytes by 1,000: more than the reference library takes, too."""
    streams = [bytes(1_000_000 * each) for each in (9, 1, 3, 3, 4, 9)]
    frames = [bomb(len(stream) >> 17) for stream in streams]
    data = spz_4(streams, 1_000_000, 1, frames=frames)
    del streams
    refused(tmp_path / "a.spz", data, "29000000 bytes")


def test_without_the_library_one_line_says_how_to_get_it(tmp_path, monkeypatch):
    for name in ("compression", "compression.zstd", "backports.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.spz").write_bytes(spz_4(two(), 2, 1))
    assert refusals.refused(None, read_gaussians, tmp_path / "a.spz") == (
        f"{tmp_path / 'a.spz'}: .spz of version 4 needs backports.zstd, which is not installed:"
        " pip install '.[spz]' in the checkout, or 'FILE.whl[spz]'"
    )
