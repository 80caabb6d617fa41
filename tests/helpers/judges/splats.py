"""How near one set of Gaussians is to another, in whatever order a file has them."""

import torch


def rotations(quats):
    """``[N, 3, 3]`` float64 of wxyz quaternions of any length."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).double().unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def differences(want, got):
    """The largest difference of each attribute, the Gaussians paired by their centres.

    ``angle`` is that between the axes of an ellipsoid, radians: a half turn about one of its own
    axes leaves it what it is, so readers may return another rotation of the same ellipsoid.
    """
    distance = torch.cdist(want.means.double(), got.means.double())
    order = distance.argmin(1)
    assert got.num == want.num and len(set(order.tolist())) == want.num
    got = got.select(order)
    cosines = (rotations(want.quats) * rotations(got.quats)).sum(1).abs().clamp(max=1)
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


# What the layout of each format allows: half a step of its numbers, for the Gaussians of
# ``helpers.gaussians.some``, which lie in a unit cube. Angles: three numbers, each half a step off.
ALLOWED = {
    "ply": {
        **{"means": 0, "angle": 1e-3, "logs": 1e-6, "opacities": 1e-6},
        **{"colors": 1e-6, "harmonics": 0},
    },
    "glb": {
        **{"means": 0, "angle": 1e-3, "logs": 0, "opacities": 0},
        **{"colors": 1e-6, "harmonics": 1e-6},
    },
    # 8 bits: 1/128 of a number of the quaternion, which is twice that as an angle
    "splat": {
        "means": 0,
        "angle": 0.04,
        "logs": 1e-6,
        "opacities": 0.501 / 255,
        "colors": 0.501 / 255,
    },
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
    """Asserts that what was read is as near as the format allows."""
    for name, value in differences(want, got).items():
        assert value <= ALLOWED[kind][name], (kind, name, value, ALLOWED[kind][name])
