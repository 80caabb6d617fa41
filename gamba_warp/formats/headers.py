"""Counts that a shape file states, against its size: a file that lies is refused unread."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import UserError
from .ply_header import ORDERS, PlyElement, read_ply_header

SLACK = 2  # bytes after the end: a line end
GLB_JSON, GLB_START = 0x4E4F534A, 12


def check_counts(path: Path) -> None:
    """Compares what a .ply, .stl, .glb, .gltf, .pcd or .pts file says it holds with its size.

    Nothing is allocated by what the file says, so that a header of 10^12 vertices costs nothing.
    Files of other kinds state no counts, or are read without trust in them, and pass.

    Raises:
        UserError: the file holds less or more than it says, or its header is broken.
    """
    check = _CHECKS.get(path.suffix.lower())
    if check is None:
        return
    try:
        with open(path, "rb") as file:
            check(path, file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except (ValueError, struct.error, KeyError, IndexError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: broken header ({error})") from error


def _compare(path: Path, says: str, wanted: int, there: int, exact: bool = True) -> None:
    if there < wanted:
        raise UserError(
            f"{path}: truncated or false header, {says} take {wanted} bytes but {there} follow"
        )
    if exact and there > wanted + SLACK:
        raise UserError(f"{path}: false header, {says} take {wanted} bytes but {there} follow")


def _check_ply(path: Path, file: BinaryIO, size: int) -> None:
    layout, _, elements, start = read_ply_header(path, file)
    says = ", ".join(f"{element.count} {element.name}" for element in elements)
    if layout == "ascii":
        file.seek(start)
        wanted = sum(element.count for element in elements if element.properties)
        found = sum(1 for _ in _lines(file))
        if found != wanted:
            raise UserError(f"{path}: truncated or false header, {says}, but {found} lines follow")
        return
    if layout not in ORDERS:
        raise UserError(f"{path}: the .ply header states no format")
    least = sum(element.count * element.least_bytes() for element in elements)
    _compare(path, says, least, size - start, exact=False)
    if size == start:
        return
    data, at = np.memmap(file, np.uint8, "r"), start
    for element in elements:
        at += _element_bytes(path, data[at:], element, ORDERS[layout])
    _compare(path, says, at - start, size - start)


def _element_bytes(path: Path, data: np.ndarray, element: PlyElement, order: str) -> int:
    """Bytes that an element takes at the start of ``data [B]`` uint8, its lists included."""
    count = element.count
    lists = [i for i, item in enumerate(element.properties) if item.length]
    if not lists or count == 0:
        return count * element.least_bytes()
    says = f"{count} {element.name} with lists"
    if len(lists) == 1:  # as a rule all lists are of one length
        item = element.properties[lists[0]]
        before = sum(other.least_bytes() for other in element.properties[: lists[0]])
        counts = np.dtype(order + item.length)
        _compare(path, says, element.least_bytes(), len(data), exact=False)
        length = int(data[before : before + counts.itemsize].view(counts)[0])
        stride = element.least_bytes() + length * np.dtype(item.kind).itemsize
        if 0 <= length and count * stride <= len(data):
            rows = data[: count * stride].reshape(count, stride)
            found = np.ascontiguousarray(rows[:, before : before + counts.itemsize]).view(counts)
            if (found == length).all():
                return count * stride
    return _walked_bytes(path, data.tobytes(), element, order)


def _walked_bytes(path: Path, data: bytes, element: PlyElement, order: str) -> int:
    """As ``_element_bytes``, row by row and list by list."""
    at, says = 0, f"{element.count} {element.name} with lists"
    for _ in range(element.count):
        for item in element.properties:
            if not item.length:
                at += item.least_bytes()
                continue
            _compare(path, says, at + item.least_bytes(), len(data), exact=False)
            length = int(np.frombuffer(data, order + item.length, 1, at)[0])
            if length < 0:
                raise UserError(f"{path}: false header, a list of {length} in {element.name}")
            at += item.least_bytes() + length * np.dtype(item.kind).itemsize
            _compare(path, says, at, len(data), exact=False)
    return at


def _check_stl(path: Path, file: BinaryIO, size: int) -> None:
    head = file.read(84)
    if head.lstrip().startswith(b"solid") and b"facet" in head + file.read(1 << 12):
        return  # text, which states no count
    if len(head) < 84:
        raise UserError(f"{path}: {size} bytes are too few for an .stl file")
    count = struct.unpack("<I", head[80:])[0]
    _compare(path, f"{count} faces", 50 * count, size - 84)


def _check_glb(path: Path, file: BinaryIO, size: int) -> None:
    magic, _, length = struct.unpack("<4sII", file.read(GLB_START))
    if magic != b"glTF":
        raise UserError(f"{path}: not a .glb file")
    _compare(path, "its header and chunks", length, size)
    at, tree, binary = GLB_START, None, 0
    while at + 8 <= size:
        file.seek(at)
        chunk, kind = struct.unpack("<II", file.read(8))
        _compare(path, f"a chunk at byte {at}", chunk, size - at - 8, exact=False)
        if kind == GLB_JSON and tree is None:
            tree = json.loads(file.read(chunk))
        else:
            binary += chunk
        at += 8 + chunk
    if tree is None:
        raise UserError(f"{path}: no JSON chunk")
    _check_accessors(path, tree)


def _check_gltf(path: Path, file: BinaryIO, size: int) -> None:
    _check_accessors(path, json.load(file))


def _check_accessors(path: Path, tree: dict) -> None:
    """Each accessor against its view; the views' buffers are what trimesh reads for real."""
    bytes_of = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
    parts = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
    views = tree.get("bufferViews", [])
    most = max([int(buffer["byteLength"]) for buffer in tree.get("buffers", [])], default=0)
    for number, accessor in enumerate(tree.get("accessors", [])):
        count = int(accessor["count"])
        there = most  # without a view it is zeros, which nothing bounds; sparse ones are rare
        size = 1
        if "bufferView" in accessor:
            there = int(views[accessor["bufferView"]]["byteLength"])
            size = bytes_of[accessor["componentType"]] * parts[accessor["type"]]
        _compare(path, f"{count} values of accessor {number}", count * size, there, exact=False)


def _check_pcd(path: Path, file: BinaryIO, size: int) -> None:
    lines: dict[str, list[str]] = {}
    for line in islice(file, 64):
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]
        if words[:1] == ["DATA"]:
            break
    at = file.tell()
    sizes = [int(word) for word in lines["SIZE"]]
    repeats = [int(word) for word in lines.get("COUNT", ["1"] * len(sizes))]
    count = int(lines["POINTS"][0])
    says, data = f"{count} points", lines["DATA"][0]
    if data == "ascii":  # a digit and a blank each
        _compare(path, says, 2 * count * sum(repeats) - 1, size - at, exact=False)
        return
    wanted = count * sum(a * b for a, b in zip(sizes, repeats, strict=True))
    if data == "binary_compressed":
        packed, unpacked = struct.unpack("<II", file.read(8))
        _compare(path, says, packed, size - at - 8, exact=False)
        _compare(path, says, wanted, unpacked)
        _compare(path, says, wanted, packed * 264, exact=False)  # LZF's longest repetition
        return
    _compare(path, says, wanted, size - at)


def _check_pts(path: Path, file: BinaryIO, size: int) -> None:
    words = next(_lines(file)).split()
    if len(words) == 1:
        rows = sum(1 for _ in _lines(file))
        if rows != int(words[0]):
            raise UserError(
                f"{path}: truncated or false header, {int(words[0])} points but {rows} lines follow"
            )


def _lines(file: BinaryIO) -> Iterator[bytes]:
    return (line for line in file if line.strip())


_CHECKS = {
    ".ply": _check_ply,
    ".stl": _check_stl,
    ".glb": _check_glb,
    ".gltf": _check_gltf,
    ".pcd": _check_pcd,
    ".pts": _check_pts,
}
