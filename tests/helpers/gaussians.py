"""Random Gaussians for tests of files and pages, conversions of quaternions, and a .glb's bytes."""

import json

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
