import json
import struct

import numpy as np
import pytest
import torch
import trimesh
from helpers.gaussians import some

from gamba_warp.errors import UserError
from gamba_warp.formats.gaussians.glb import save_glb
from gamba_warp.formats.gaussians.splat import save_splat
from gamba_warp.formats.ply import SH_C0


def read_glb(path):
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    binary = data[28 + size :]
    assert kind == b"BIN\0" and binary_size == len(binary) and binary_size % 4 == 0
    assert document["buffers"] == [{"byteLength": len(binary)}]
    return document, binary


def attributes(document, binary):
    (primitive,) = document["meshes"][0]["primitives"]
    out = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        size = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126
        assert view["byteLength"] == accessor["count"] * size * 4 and view["byteOffset"] % 4 == 0
        values = np.frombuffer(binary, "<f4", accessor["count"] * size, view["byteOffset"])
        out[name.removeprefix("KHR_gaussian_splatting:")] = values.reshape(-1, size)
    return primitive, out


def covariances(quats_wxyz, scales):
    w, x, y, z = np.moveaxis(np.asarray(quats_wxyz, np.float64), -1, 0)
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    half = rotation * np.asarray(scales, np.float64)[:, None, :]
    return half @ half.swapaxes(1, 2)


def unit(quats):
    return quats / quats.norm(dim=-1, keepdim=True)


def test_glb_follows_the_khronos_extension(tmp_path):
    gaussians = some()
    save_glb(tmp_path / "chair.glb", gaussians)
    document, binary = read_glb(tmp_path / "chair.glb")
    primitive, values = attributes(document, binary)
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["nodes"] == [{"mesh": 0, "name": "chair"}] and primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}

    turn = np.array([1, -1, -1])  # y up
    np.testing.assert_array_equal(values["POSITION"], gaussians.means.numpy() * turn)
    bounds = document["accessors"][0]
    np.testing.assert_array_equal(bounds["min"], values["POSITION"].min(0))
    np.testing.assert_array_equal(bounds["max"], values["POSITION"].max(0))
    np.testing.assert_array_equal(values["SCALE"], gaussians.scales)  # linear
    np.testing.assert_array_equal(values["OPACITY"][:, 0], gaussians.opacities)
    np.testing.assert_allclose(np.linalg.norm(values["ROTATION"], axis=1), 1, atol=1e-6)
    got = covariances(np.roll(values["ROTATION"], 1, axis=1), values["SCALE"])  # xyzw stored
    want = covariances(unit(gaussians.quats), gaussians.scales) * np.outer(turn, turn)
    np.testing.assert_allclose(got, want, atol=1e-8)
    rgb = values["SH_DEGREE_0_COEF_0"] * SH_C0 + 0.5
    np.testing.assert_allclose(rgb, gaussians.colors, atol=1e-6)
    np.testing.assert_array_equal(values["COLOR_0"][:, :3], gaussians.colors)


def test_a_reader_without_the_extension_sees_the_points(tmp_path):
    gaussians = some()
    save_glb(tmp_path / "a.glb", gaussians)
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, gaussians.means * torch.tensor([1, -1, -1]))
    assert np.abs(cloud.colors[:, :3] / 255 - gaussians.colors.numpy()).max() < 0.6 / 255


@pytest.mark.parametrize("rotated", [True, False])
def test_splat_records(tmp_path, rotated):
    gaussians = some(rotated=rotated)
    save_splat(tmp_path / "a.splat", gaussians)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 37 * 32
    numbers = np.frombuffer(data, "<f4").reshape(37, 8)
    small = np.frombuffer(data, "u1").reshape(37, 32)[:, 24:]
    order = (gaussians.scales.prod(1) * gaussians.opacities).argsort(descending=True)
    sorted_ = gaussians.select(order)
    np.testing.assert_array_equal(numbers[:, :3], sorted_.means)
    np.testing.assert_array_equal(numbers[:, 3:6], sorted_.scales)
    # 8 bits: half a step
    rgba = torch.cat([sorted_.colors, sorted_.opacities[:, None]], 1).numpy()
    np.testing.assert_allclose(small[:, :4] / 255, rgba, atol=0.501 / 255)
    quats = unit(sorted_.quats) if rotated else torch.eye(4)[:1].expand(37, 4)
    # the largest byte stands for 127/128, so 1 is off by a whole step
    np.testing.assert_allclose((small[:, 4:].astype(float) - 128) / 128, quats, atol=1.001 / 128)


@pytest.mark.parametrize("save, suffix", [(save_glb, "glb"), (save_splat, "splat")])
def test_refusals(tmp_path, save, suffix):
    path = tmp_path / f"a.{suffix}"
    gaussians = some()
    save(path, gaussians, min_opacity=0.5)
    before = path.read_bytes()
    with pytest.raises(UserError, match="no Gaussian has an opacity"):
        save(path, gaussians, min_opacity=2)
    gaussians.scales[1, 1] = float("inf")
    with pytest.raises(UserError, match=rf"a\.{suffix}: not written, 1 of 37"):
        save(path, gaussians)
    with pytest.raises(UserError, match=f"cannot write /dev/null/a.{suffix}"):
        save(f"/dev/null/a.{suffix}", some())
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1
