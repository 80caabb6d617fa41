"""Random Gaussians for tests of files and pages, and the bytes of a .glb and an .spz."""

import gzip
import json
import struct

import numpy as np
import torch

from gamba_warp.formats.gaussians.arrays import flip_axes
from gamba_warp.gaussians import SH_C0, Gaussians

from .meshes import glb


def some(n=37, rotated=True, degree=0):
    """Draws ``n`` Gaussians; the quaternions are not normalised, or None if not ``rotated``.

    With harmonics of a ``degree`` over 0, some base colours lie outside [0, 1].
    """
    quats = torch.randn(n, 4) * 3 if rotated else None
    K = (degree + 1) ** 2 - 1
    return Gaussians(
        means=torch.rand(n, 3) - 0.5,
        quats=quats,
        scales=torch.rand(n, 3) * 0.1 + 1e-4,
        opacities=torch.rand(n) * 0.98 + 0.01,
        colors=torch.rand(n, 3) * (1.4 if degree else 1) - (0.2 if degree else 0),
        harmonics=torch.rand(n, K, 3) * 1.8 - 0.9 if degree else None,
    )


def rotations(quats, unit=True):
    """``[..., 3, 3]`` of wxyz quaternions of any length, or as they are if not ``unit``."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True) if unit else quats).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def covariances(quats, scales):
    """``[..., 3, 3]`` float64, as an array, of arrays or tensors."""
    turns = rotations(torch.as_tensor(quats).double())
    half = (turns * torch.tensor(np.asarray(scales)).double()[..., None, :]).numpy()
    return half @ half.swapaxes(-1, -2)


def khr_glb(gaussians):
    """The bytes of a .glb with rotated Gaussians, by ``KHR_gaussian_splatting``."""
    gaussians, name = flip_axes(gaussians), "KHR_gaussian_splatting"
    arrays = {
        "POSITION": gaussians.means,
        f"{name}:ROTATION": torch.nn.functional.normalize(gaussians.quats).roll(-1, 1),  # xyzw
        f"{name}:SCALE": gaussians.scales,
        f"{name}:OPACITY": gaussians.opacities[:, None],
        f"{name}:SH_DEGREE_0_COEF_0": (gaussians.colors - 0.5) / SH_C0,
    }
    orders = [(l, n) for l in range(1, gaussians.degree + 1) for n in range(2 * l + 1)]
    for i, (l, n) in enumerate(orders):
        arrays[f"{name}:SH_DEGREE_{l}_COEF_{n}"] = gaussians.harmonics[:, i]
    views, accessors, binary = [], [], b""
    for i, values in enumerate(arrays.values()):
        data = values.numpy().astype("<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        accessors.append({"bufferView": i, "componentType": 5126, "count": len(values)})
        accessors[i]["type"], binary = kind, binary + data
    options = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": {key: i for i, key in enumerate(arrays)}}
    tree = {
        **{"asset": {"version": "2.0"}, "extensionsUsed": [name], "scene": 0},
        **{"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]},
        "meshes": [{"primitives": [primitive | {"extensions": {name: options}}]}],
        **{"buffers": [{"byteLength": len(binary)}], "bufferViews": views, "accessors": accessors},
    }
    return glb(json.dumps(tree).encode(), binary)


ZSTD = b"\x28\xb5\x2f\xfd"


def raw_frame(data):
    """A ZSTD frame of one raw block, built by the format's description without a library."""
    block = (len(data) << 3 | 1).to_bytes(3, "little")
    return ZSTD + b"\xa0" + struct.pack("<I", len(data)) + block + data


def spz_4(streams, count, degree, bits=12, pack=raw_frame, extensions=b"", **other):
    """An .spz of version 4; ``other`` replaces values of the header and of the table."""
    frames = other.get("frames") or [pack(stream) for stream in streams]
    sizes = other.get("sizes") or [(len(f), len(s)) for f, s in zip(frames, streams)]
    flags = other.get("flags", 2 if extensions else 0)
    version, number = other.get("version", 4), other.get("number", len(sizes))
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, number)
    head += struct.pack("<I12x", other.get("table", 32 + len(extensions)))
    table = b"".join(struct.pack("<QQ", *entry) for entry in sizes)
    return head + extensions + table + b"".join(frames)


def parts_of_spz(data):
    """The streams, count, degree and bits of an .spz of version 3, as ``spz_4`` takes them."""
    inner, streams, at = gzip.decompress(data), [], 16
    count, degree, bits = struct.unpack_from("<IBB", inner, 8)
    for each in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)):
        streams += [inner[at : at + each * count]] if each else []
        at += each * count
    return streams, count, degree, bits
