"""Mutations of what is packed: the inside is changed, and what holds it is made whole again."""

from __future__ import annotations

import ast
import functools
import io
import json
import pickle
import re
import struct
import tarfile
import zipfile
import zlib
from random import Random
from typing import Any

import numpy as np

from ..seeds.datasets import ar, npy, tarred, zipped
from ..seeds.shapes import glb
from .data import BOMB, Mutation, Unfit
from .spz import gzip_inside, spz_frame, spz_table
from .text import NAMES, any_plain, change_json, changed_tree, dump, encode


def safetensors_header(data: bytes, rng: Random) -> bytes:
    """Changes the JSON header of a safetensors file, of its metadata's JSON too."""
    size = struct.unpack("<Q", data[:8].ljust(8, b"\0"))[0]
    try:
        header = json.loads(data[8 : 8 + size])
    except ValueError as error:
        raise Unfit from error
    inner = header.get("__metadata__", {}).get("config") if isinstance(header, dict) else None
    if inner and rng.random() < 0.6:
        header["__metadata__"]["config"] = change_json(inner.encode(), rng).decode(
            "utf-8", "replace"
        )
        text = dump(header)
    else:
        text = dump(changed_tree(header, rng))
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


def safetensors_values(data: bytes, rng: Random) -> bytes:
    """Puts numbers that are not finite, or huge, among the weights; the header stays whole."""
    size = struct.unpack("<Q", data[:8].ljust(8, b"\0"))[0]
    start = 8 + size
    count = (len(data) - start) // 4
    if count < 1:
        raise Unfit
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 50))):
        at = start + 4 * rng.randrange(count)
        word = struct.pack("<f", rng.choice((float("nan"), float("inf"), 3e38, -1e30)))
        out[at : at + 4] = word
    return bytes(out)


def glb_tree(data: bytes, rng: Random) -> bytes:
    """Changes the tree or the binary part of a .glb, whose lengths then fit."""
    try:
        size = struct.unpack("<I", data[12:16])[0]
        tree = json.loads(data[20 : 20 + size])
    except (ValueError, struct.error) as error:
        raise Unfit from error
    binary = data[28 + size :]
    if rng.random() < 0.3:
        return glb(dump(tree), any_plain(binary, rng))
    return glb(dump(changed_tree(tree, rng)), binary)


def npy_header(data: bytes, rng: Random) -> bytes:
    """Changes shape, type or order in a ``.npy`` header, or makes another kind of array of it."""
    if rng.random() < 0.3:
        arrays = (
            np.array(3.0), np.zeros((3, 4), "M8[s]"), np.zeros((3, 4), "S8"), np.zeros((0, 4)),
            np.full((3, 4), np.nan), np.zeros((3, 4), complex), np.zeros((3, 4), ">i2"),
            np.zeros((3, 2), "f4,i4"), np.full((3, 2), 1e308), np.zeros((3, 2), bool),
        )  # fmt: skip
        return npy(rng.choice(arrays))
    if rng.random() < 0.2:
        content = io.BytesIO()
        np.savez(content, a=np.ones((3, 4)))
        return content.getvalue()
    match = re.match(rb"\x93NUMPY\x01\x00..(\{.*?\}) *\n", data, re.DOTALL)
    if not match:
        raise Unfit
    fields = ast.literal_eval(match[1].decode())
    fields["shape"] = rng.choice(
        ((3, 4), (2**31, 2**31), (3, -4), (10**9,), (), (3, 4, 1), (2**62,))
    )
    kinds = ("<f8", "|O", ">f4", "<U1000000", "|V9", "<f2", "f8, f8", "<M8[s]", "|S0")
    fields["descr"] = rng.choice((fields["descr"], rng.choice(kinds)))
    text = (repr(fields) + " " * rng.choice((0, 7, 70_000))).encode() + b"\n"
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text + data[match.end() :]


@functools.lru_cache
def _bomb(size: int) -> bytes:
    """Zeros, packed."""
    return zlib.compress(bytes(size), 9)


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise Unfit
    found, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack(">I", data[at : at + 4])[0]
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def png_chunks(data: bytes, rng: Random) -> bytes:
    """Changes sizes, depth or chunks of a PNG, whose checksums then fit."""
    chunks = _chunks(data)
    choice, at = rng.random(), rng.randrange(len(chunks))
    if choice < 0.4 and chunks[0][0] == b"IHDR" and len(chunks[0][1]) == 13:
        width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
        sides = (0, 1, 65535, 100_000, 2**31 - 1, 2**31, width)
        width, height = rng.choice(sides), rng.choice((*sides, height))
        if rng.random() < 0.4:
            rest[rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", width, height, *rest))
    elif choice < 0.5:
        kind = rng.choice((b"zTXt", b"iCCP", b"iTXt"))
        start = b"k\0\0" if kind != b"iTXt" else b"k\0\x01\0\0\0"
        chunks.insert(1, (kind, start + _bomb(BOMB // 16)))
    elif choice < 0.55:
        chunks.insert(1, (b"acTL", struct.pack(">II", rng.choice((2, 2**31 - 1)), 0)))
    elif choice < 0.75:
        chunks[at] = (chunks[at][0], any_plain(chunks[at][1], rng))
    elif choice < 0.85:
        chunks.insert(at, chunks[rng.randrange(len(chunks))])
    else:
        del chunks[at]
    out = [b"\x89PNG\r\n\x1a\n"]
    for kind, body in chunks:
        out += [
            struct.pack(">I", len(body)),
            kind + body,
            struct.pack(">I", zlib.crc32(kind + body)),
        ]
    return b"".join(out)


def _members(data: bytes, rng: Random) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception as error:  # a mutated archive fails in many ways
        raise Unfit from error


@functools.lru_cache
def _unzip_bomb() -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open(zipfile.ZipInfo("b/chair/chair.obj"), "w") as member:
            for _ in range(BOMB >> 20):
                member.write(bytes(1 << 20))
    return content.getvalue()


def zip_members(data: bytes, rng: Random) -> bytes:
    """Changes names, contents or the number of members of a zip archive; links, and bombs."""
    members = _members(data, rng)
    name = rng.choice(sorted(members) or [""])
    choice = rng.random()
    if choice < 0.35 and name:  # what the catalogue says
        properties = next((n for n in members if n.endswith(".properties")), name)
        members[properties] = _hostile_properties(members[properties], rng)
    elif choice < 0.55 and name:
        members[_text_name(rng)] = members.pop(name)
    elif choice < 0.7 and name:
        members[name] = any_plain(members[name], rng)
    elif choice < 0.8 and name:
        del members[name]
    elif choice < 0.85:
        members |= {f"many/{i}": b"" for i in range(2000)}
    elif choice < 0.9:
        return _with_link(members, rng)
    elif choice < 0.93:
        return _unzip_bomb()
    else:
        packed = bytearray(zipped(members))
        at = packed.rfind(b"PK\x01\x02")
        if at >= 0:
            packed[at + 20 : at + 28] = rng.choice((b"\xff" * 8, bytes(8), rng.randbytes(8)))
        return bytes(packed)
    return zipped(members)


def _text_name(rng: Random) -> str:
    return encode(rng.choice(NAMES)).decode("utf-8", "replace") or "x"


def _hostile_properties(data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.3:
        return any_plain(data, rng)
    lines = data.split(b"\n")
    at = rng.choice([i for i, line in enumerate(lines) if b"=" in line] or [0])
    key = lines[at].split(b"=")[0]
    value = rng.choice([*map(encode, NAMES), b"1 2 3", b"nan " * 9, b"1e999 " * 9, b"\\ud800"])
    lines[at] = key + b"=" + value
    return b"\n".join(lines)


def _with_link(members: dict[str, bytes], rng: Random) -> bytes:
    content = io.BytesIO(zipped(members))
    with zipfile.ZipFile(content, "a") as archive:
        link = zipfile.ZipInfo(rng.choice(("b/chair/link.obj", "b/chair", "icons")))
        link.external_attr = 0o120777 << 16
        archive.writestr(link, rng.choice(("../../../canary", "/etc/passwd", "/etc")))
    return content.getvalue()


def _ar_members(data: bytes) -> dict[str, bytes]:
    members, at = {}, 8
    try:
        while at + 60 <= len(data):
            name, size = data[at : at + 16].decode().strip(), int(data[at + 48 : at + 58])
            if size < 0:
                break
            members[name] = data[at + 60 : at + 60 + size]
            at += 60 + size + size % 2
    except ValueError as error:
        raise Unfit from error
    return members


def deb_members(data: bytes, rng: Random) -> bytes:
    """Changes the archive in an archive in a Debian package, or what the package says of it."""
    members = _ar_members(data)
    inner = members.get("data.tar.xz")
    if inner is None:
        raise Unfit
    choice = rng.random()
    if choice < 0.25:
        sizes = (b"-60", b"-61", b"-120", b"0", b"9999999999", b"60", b"x", b"1e3", b"")
        return re.sub(rb"(?<=100644  )\d+ *(?=`)", lambda _: rng.choice(sizes).ljust(10), data)
    if choice < 0.35:
        members["data.tar.xz"] = any_plain(inner, rng)
        return ar(members)
    try:
        with tarfile.open(fileobj=io.BytesIO(inner)) as tar:
            opened = {m.name: tar.extractfile(m) for m in tar}
            files = {name: file.read() for name, file in opened.items() if file}
    except Exception as error:  # a mutated archive fails in many ways
        raise Unfit from error
    for name in list(files):
        if rng.random() < 0.6:
            files[name] = zip_members(files[name], rng)
        else:
            files[_text_name(rng) + ".sh3f"] = files.pop(name)
    members["data.tar.xz"] = _tar_with_odd(files, rng) if rng.random() < 0.4 else tarred(files)
    return ar(members)


def _tar_with_odd(files: dict[str, bytes], rng: Random) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:xz") as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
        odd = tarfile.TarInfo(rng.choice(("Odd.sh3f", "../Odd.sh3f", "...sh3f", "/tmp/Odd.sh3f")))
        odd.type = rng.choice((tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE))
        odd.linkname = rng.choice(("/etc/passwd", "../../canary/kept.txt", odd.name, ""))
        tar.addfile(odd)
    return content.getvalue()


def torch_values(data: bytes, rng: Random) -> bytes:
    """Changes values, kinds and shapes in a file of ``torch.save``, which is then written again."""
    import torch

    try:
        tree = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # a mutated file fails in many ways
        raise Unfit from error
    for _ in range(rng.choice((1, 1, 2))):
        tree = _changed_state(tree, rng)
    content = io.BytesIO()
    torch.save(tree, content)
    return content.getvalue()


def _changed_state(tree: Any, rng: Random) -> Any:
    import torch

    holder: Any = None
    key: Any = None
    node = tree
    while isinstance(node, (dict, list)) and node and (holder is None or rng.random() < 0.75):
        holder = node
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        node = node[key]
    others: list[Any] = [None, "x", -1, 2**63, float("nan"), [], {}, True, torch.zeros(0), 1e308]
    others += [torch.full((2,), float("nan")), torch.zeros(3, 3, dtype=torch.int8)]
    if isinstance(node, torch.Tensor):
        others += [node * float("nan")] * 3 + [node[:0] if node.dim() else node, node[None]]
        others += [node.double(), node.to(torch.complex64), node.clone().fill_(100)]
    if holder is None:
        return rng.choice(others)
    if isinstance(holder, dict) and rng.random() < 0.2:
        del holder[key]
    else:
        holder[key] = rng.choice(others)
    return tree


def pickle_values(data: bytes, rng: Random) -> bytes:
    """Puts another class, deep nesting or other arrays into a pickle."""
    choice = rng.random()
    if choice < 0.3:
        return pickle.dumps(
            rng.choice((print, np.float32(3), {1: {2}}, [Random], slice(3), 3 + 4j))
        )
    if choice < 0.5:
        code = b"cos\nsystem\n(S'true'\ntR."
        return rng.choice((code, b"\x80\x02" + code, b"(" * 100_000 + b".", b"]" * 9 + b"a" * 9))
    arrays = (np.array([None]), np.zeros(3, "f4,i4"), np.zeros((3, 3, 3, 4)), np.array(["x"]))
    return pickle.dumps({"VGG16_0": {"Conv_0": {"kernel": rng.choice(arrays)}}}, protocol=4)


BY_SUFFIX: dict[str, tuple[Mutation, ...]] = {
    ".spz": (gzip_inside, spz_table, spz_frame),
    ".safetensors": (safetensors_header, safetensors_header, safetensors_values),
    ".glb": (glb_tree,),
    ".npy": (npy_header,),
    ".png": (png_chunks,),
    ".sh3f": (zip_members,),
    ".deb": (deb_members,),
    ".pt": (torch_values,),
    ".pth": (torch_values,),
    ".ckpt": (pickle_values,),
}
