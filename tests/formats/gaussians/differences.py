"""Differences between two sets of Gaussians, in any order.

``published`` reads files with other packages and by the published layouts, without our code.
"""

import gaussforge
import numpy as np
import torch
from helpers.gaussians import covariances, rotations
from plyfile import PlyData


def differences(want, got):
    """Return the largest difference of each attribute, with Gaussians paired by their centres.

    ``angle`` is that between the axes of an ellipsoid, radians: a half turn about one of its own
    axes does not change it, so readers may return another rotation of the same ellipsoid.
    """
    distance = torch.cdist(want.means.double(), got.means.double())
    order = distance.argmin(1)
    assert got.num == want.num and len(set(order.tolist())) == want.num
    got = got.select(order)
    axes, others = (rotations(each.quats.double()) for each in (want, got))
    cosines = (axes * others).sum(1).abs().clamp(max=1)
    found = {
        "means": distance.min(1).values.max(),
        "angle": cosines.arccos().max(),
        "logs": (want.scales.log() - got.scales.log()).abs().max(),
        "opacities": (want.opacities - got.opacities).abs().max(),
        "colors": (want.colors - got.colors).abs().max(),
    }
    if want.harmonics is not None and got.harmonics is not None:
        found["harmonics"] = (want.harmonics - got.harmonics).abs().max()
    return {name: float(value) for name, value in found.items()}


# Tolerances of the formats: half a step of their numbers, for the Gaussians of
# ``helpers.gaussians.some`` in a unit cube. Angles: three numbers, each half a step off.
ALLOWED = {
    "ply": dict(means=0, angle=1e-3, logs=1e-6, opacities=1e-6, colors=1e-6, harmonics=0),
    # 8 bits: 1/128 of a number of the quaternion, which is twice that as an angle
    "splat": dict(means=0, angle=0.04, logs=1e-6, opacities=0.501 / 255, colors=0.501 / 255),
    # positions 16 bits behind the point; logarithms 1/16; colours 1/255 of C0/0.15
    "spz": {
        **{"means": 0.9 / 2**16, "angle": 4e-3, "logs": 0.501 / 16, "opacities": 0.501 / 255},
        **{"colors": 0.501 / 255 * 1.881, "harmonics": 0.501 / 128},
    },
    # within a chunk at most as wide as the cube: 11, 10, 11 bits; logarithms within ln(1000)
    "compressed-ply": {
        **{"means": 0.5 * 1.5 / 1023, "angle": 5e-3, "logs": 0.51 * 7 / 1023},
        **{"opacities": 0.501 / 255, "colors": 0.501 * 1.4 / 255, "harmonics": 4.01 / 256},
    },
}


def check(kind, want, got):
    """Assert that the read Gaussians are within the tolerance of the format."""
    for name, value in differences(want, got).items():
        assert value <= ALLOWED[kind][name], (kind, name, value, ALLOWED[kind][name])


def published(path, kind):
    """The centres ``[N, 3]`` and covariances of a file, turned from its format's axes to OpenCV's.

    A .ply is read by plyfile; .splat, .spz and compressed .ply by gaussforge, which leaves the axes
    as they are. The axes of .spz (right, up, back) are those that its specification names; the
    others have none of their own, and every viewer takes them for OpenCV's, as 3DGS wrote them.
    """
    data = path
    if kind != "ply":
        name = kind.replace("-", ".")
        data = path.with_name("theirs.ply")
        theirs = gaussforge.GaussForge().convert(path.read_bytes(), name, "ply")
        data.write_bytes(theirs["data"])
    vertex = PlyData.read(data)["vertex"]
    centres = np.stack([vertex[name] for name in "xyz"], 1)
    quats = np.stack([vertex[f"rot_{i}"] for i in range(4)], 1)
    scales = np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], 1))
    turn = np.array([1, -1, -1] if kind == "spz" else [1, 1, 1])
    return centres * turn, covariances(quats, scales) * np.outer(turn, turn)
