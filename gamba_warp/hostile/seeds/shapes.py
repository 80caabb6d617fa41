"""Sound shapes: Gaussians, meshes with their side files, and point clouds."""

from __future__ import annotations

import base64
import gzip
import json
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...formats.names import SplatFormat
from .pictures import Files, png

_PLY_TYPES = {"<f4": "float", "<f8": "double", "u1": "uchar", "<i4": "int"}


def ball(rings: int = 4, around: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A coarse closed ball: vertices ``[V, 3]`` float64 and faces ``[F, 3]`` int64."""
    up = np.linspace(0, np.pi, rings + 1)[1:-1]
    turn = np.arange(around) * 2 * np.pi / around
    rows = [
        np.stack([np.sin(u) * np.cos(turn), np.sin(u) * np.sin(turn), np.full(around, np.cos(u))])
        for u in up
    ]
    vertices = np.vstack([[[0, 0, 1]], np.hstack(rows).T, [[0, 0, -1]]])
    last, faces = len(vertices) - 1, []
    for k in range(around):
        a, b = 1 + k, 1 + (k + 1) % around
        faces.append([0, a, b])
        for row in range(rings - 2):
            c, d = (x + around * row for x in (a, b))
            faces += [[c, c + around, d], [d, c + around, d + around]]
        low, high = (x + around * (rings - 2) for x in (a, b))
        faces.append([low, last, high])
    return vertices.round(4), np.array(faces)


def gaussians(count: int = 12, kind: SplatFormat = "ply", degree: int = 0) -> bytes:
    """A file of Gaussians of one of the formats, with harmonics of a degree."""
    import torch

    from ...formats.gaussians.files import write_gaussians
    from ...formats.names import splat_suffix
    from ...gaussians import Gaussians

    rng = torch.Generator().manual_seed(1)
    K = (degree + 1) ** 2 - 1
    some = Gaussians(
        means=torch.rand(count, 3, generator=rng) - 0.5,
        quats=torch.randn(count, 4, generator=rng),
        scales=torch.rand(count, 3, generator=rng) * 0.1 + 0.01,
        opacities=torch.rand(count, generator=rng) * 0.9 + 0.05,
        colors=torch.rand(count, 3, generator=rng),
        harmonics=torch.rand(count, K, 3, generator=rng) - 0.5 if K else None,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("object" + splat_suffix(kind))
        write_gaussians(path, some, kind)
        return path.read_bytes()


def splats() -> dict[str, Files]:
    """Gaussians in every format that is read, some with harmonics."""
    seeds: dict[str, Files] = {
        "gaussians": {"object.ply": gaussians()},
        "gaussians-text": {"object.ply": _as_text(gaussians(degree=1))},
        "gaussians-harmonics": {"object.ply": gaussians(degree=3)},
    }
    for kind in ("compressed-ply", "splat", "spz", "glb"):
        name = "object." + ("ply" if kind == "compressed-ply" else kind)
        seeds[f"gaussians-{kind}"] = {name: gaussians(300 if "ply" in kind else 12, kind, 1)}
    seeds["gaussians-spz-4"] = {"object.spz": spz_4(gaussians(12, "spz", 1))}
    return seeds


def spz_4(data: bytes) -> bytes:
    """An ``.spz`` of version 3 in the container of version 4, with an extension.

    Each ZSTD frame holds its bytes as they are, so a mutation reaches the numbers too.
    """
    inner = gzip.decompress(data)
    magic, _, count, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", inner)
    sizes = [count * each for each in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if each]
    extension = struct.pack("<III", 0xADBE0003, 4, 4)  # the axes are the usual ones
    table, frames, at = b"", b"", 16
    for size in sizes:
        frame = zstd_frame(inner[at : at + size])
        table += struct.pack("<QQ", len(frame), size)
        frames += frame
        at += size
    head = struct.pack("<4sIIBBBB", magic, 4, count, degree, bits, flags | 2, len(sizes))
    head += struct.pack("<I12x", 32 + len(extension))
    return head + extension + table + frames


def zstd_frame(data: bytes) -> bytes:
    """A ZSTD frame of one block that is not packed, of up to 128 kB."""
    block = struct.pack("<I", len(data) << 3 | 1)[:3]  # the last one, raw
    return b"\x28\xb5\x2f\xfd\xa0" + struct.pack("<I", len(data)) + block + data


def _as_text(data: bytes) -> bytes:
    """A binary ``.ply`` of float32 as text."""
    header, _, body = data.partition(b"end_header\n")
    columns = header.count(b"property float")
    rows = np.frombuffer(body, "<f4").reshape(-1, columns)
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    header = header.replace(b"binary_little_endian", b"ascii")
    return header + b"end_header\n" + "\n".join([*lines, ""]).encode()


def ply(
    columns: dict[str, np.ndarray], faces: Sequence[list[int]] = (), form: str = "ascii"
) -> bytes:
    """A ``.ply`` of named vertex columns, and of faces of any number of corners.

    Args:
        columns: ``[V]`` each, of a dtype in ``_PLY_TYPES``.
        faces: indices of vertices.
        form: "ascii", "binary_little_endian" or "binary_big_endian".
    """
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {form} 1.0", "comment made here", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[c.dtype.str.lstrip('|')]} {n}" for n, c in columns.items()]
    if faces:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode()
    if form == "ascii":
        rows = [" ".join(f"{value:g}" for value in row) for row in zip(*columns.values())]
        rows += [" ".join(map(str, [len(face), *face])) for face in faces]
        return head + "\n".join([*rows, ""]).encode()
    order = "<" if "little" in form else ">"
    kinds = [(n, c.dtype.newbyteorder(order)) for n, c in columns.items()]
    table = np.zeros(count, kinds)
    for name, column in columns.items():
        table[name] = column
    body = b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
    return head + table.tobytes() + body


def _columns(points: np.ndarray, colours: bool = False, normals: bool = False) -> dict:
    named = {name: points[:, i].astype("<f4") for i, name in enumerate("xyz")}
    if normals:
        named |= {f"n{name}": points[:, i].astype("<f4") for i, name in enumerate("xyz")}
    if colours:
        named |= {n: np.full(len(points), 99, "u1") for n in ("red", "green", "blue")}
    return named


def _obj(vertices: np.ndarray, faces: np.ndarray, textured: bool) -> Files:
    lines = ["mtllib ball.mtl", "o ball"] if textured else []
    lines += [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices]
    lines += [f"vt {(x + 1) / 2:g} {(y + 1) / 2:g}" for x, y, _ in vertices]
    lines += ["usemtl paint"] if textured else []
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in faces]
    files = {"ball.obj": "\n".join([*lines, ""]).encode()}
    if textured:
        material = "newmtl paint\nKd 0.8 0.7 0.6\nd 1\nmap_Kd paint.png\nmap_d mask.png\n"
        files |= {"ball.mtl": material.encode(), "paint.png": png(8), "mask.png": png(8)}
    return files


def _off(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [f"{x:g} {y:g} {z:g}" for x, y, z in vertices]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in faces), ""]).encode()


def _stl(vertices: np.ndarray, faces: np.ndarray, text: bool) -> bytes:
    corners = vertices[faces]
    if text:
        lines = ["solid ball"]
        for face in corners:
            lines += ["facet normal 0 0 1", "outer loop"]
            lines += [f"vertex {x:g} {y:g} {z:g}" for x, y, z in face]
            lines += ["endloop", "endfacet"]
        return "\n".join([*lines, "endsolid ball", ""]).encode()
    table = np.zeros(
        len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]
    )
    table["corners"] = corners
    return b"a ball".ljust(80) + struct.pack("<I", len(faces)) + table.tobytes()


def _gltf(vertices: np.ndarray, faces: np.ndarray, uri: str | None) -> tuple[dict, bytes]:
    """The tree and the binary part of a textured glTF."""
    picture = png(8)
    parts = [vertices.astype("<f4").tobytes(), (vertices[:, :2] / 2 + 0.5).astype("<f4").tobytes()]
    parts += [faces.astype("<u2").tobytes(), picture + b"\0" * (-len(picture) % 4)]
    views, at = [], 0
    for part in parts:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(part)})
        at += len(part)
    low, high = vertices.min(0).tolist(), vertices.max(0).tolist()
    accessor = [
        {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5126, "count": len(vertices), "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
    ]
    accessor[0] |= {"min": low, "max": high}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "ball", "translation": [0.5, 0, 0]}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": accessor,
        "bufferViews": views,
        "buffers": [{"byteLength": at} | ({"uri": uri} if uri else {})],
    }
    return tree, b"".join(parts)


def glb(tree: dict | bytes, binary: bytes) -> bytes:
    """A GLB container of a tree, which may be given as text, and a binary part."""
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def meshes() -> dict[str, Files]:
    """Meshes with their side files, by name of the kind; the first file is the mesh."""
    vertices, faces = ball()
    tree, binary = _gltf(vertices, faces, None)
    inline = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    columns, mixed = _columns(vertices, True), [*faces[:-2].tolist(), [0, 1, 7, 2]]
    same = faces.tolist()
    return {
        "obj": _obj(vertices, faces, False),
        "obj-textured": _obj(vertices, faces, True),
        "glb": {"ball.glb": glb(tree, binary)},
        "gltf-inline": {"ball.gltf": json.dumps(_gltf(vertices, faces, inline)[0]).encode()},
        "gltf-side": {
            "ball.gltf": json.dumps(_gltf(vertices, faces, "ball.bin")[0]).encode(),
            "ball.bin": binary,
        },
        "ply-ascii": {"ball.ply": ply(columns, same)},
        "ply-binary": {"ball.ply": ply(columns, same, "binary_little_endian")},
        "ply-big": {"ball.ply": ply(columns, same, "binary_big_endian")},
        "ply-mixed": {"ball.ply": ply(_columns(vertices), mixed, "binary_little_endian")},
        "ply-mixed-ascii": {"ball.ply": ply(_columns(vertices), mixed)},
        "stl": {"ball.stl": _stl(vertices, faces, False)},
        "stl-ascii": {"ball.stl": _stl(vertices, faces, True)},
        "off": {"ball.off": _off(vertices, faces)},
    }


def _lzf(data: bytes) -> bytes:
    """LZF without any repetition: runs of up to 32 literal bytes."""
    parts = [data[at : at + 32] for at in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


def pcd(points: np.ndarray, form: str, normals: bool = False) -> bytes:
    """A ``.pcd`` of points ``[N, 3]`` in the form "ascii", "binary" or "binary_compressed"."""
    names = ["x", "y", "z"] + (["normal_x", "normal_y", "normal_z"] if normals else [])
    rows = np.hstack([points] * (len(names) // 3)).astype("<f4")
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        "SIZE" + " 4" * len(names),
        "TYPE" + " F" * len(names),
        "COUNT" + " 1" * len(names),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        f"DATA {form}",
        "",
    ]
    text = "\n".join(head).encode()
    if form == "ascii":
        lines = [" ".join(f"{value:g}" for value in row) for row in rows]
        return text + "\n".join([*lines, ""]).encode()
    if form == "binary":
        return text + rows.tobytes()
    unpacked = rows.T.tobytes()
    packed = _lzf(unpacked)
    return text + struct.pack("<II", len(packed), len(unpacked)) + packed


def clouds() -> dict[str, Files]:
    """Point clouds by name of the kind, one file each."""
    points = np.random.default_rng(2).normal(size=(24, 3)).round(3)
    lines = [" ".join(f"{value:g}" for value in row) for row in points]
    text = "\n".join([*lines, ""]).encode()
    coloured = "\n".join([f"{len(lines)}", *(f"{line} 5 10 20 30" for line in lines), ""])
    return {
        "xyz": {"cloud.xyz": text},
        "pts": {"cloud.pts": f"{len(lines)}\n".encode() + text},
        "pts-coloured": {"cloud.pts": coloured.encode()},
        "pcd-ascii": {"cloud.pcd": pcd(points, "ascii")},
        "pcd-binary": {"cloud.pcd": pcd(points, "binary")},
        "pcd-compressed": {"cloud.pcd": pcd(points, "binary_compressed")},
        "pcd-normals": {"cloud.pcd": pcd(points, "binary", True)},
        "ply-cloud": {"cloud.ply": ply(_columns(points, normals=True))},
        "ply-cloud-binary": {"cloud.ply": ply(_columns(points), form="binary_little_endian")},
    }
