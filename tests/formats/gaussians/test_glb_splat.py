import json
import struct

import numpy as np
import pytest
import torch
import trimesh
from helpers.gaussians import covariances, some
from helpers.judges.npm import npm_package, run_node
from helpers.judges.splats import attributes, read_glb
from helpers.meshes import glb

from gamba_warp.formats.gaussians.glb import save_glb
from gamba_warp.formats.gaussians.splat import save_splat
from gamba_warp.formats.materials import to_linear
from gamba_warp.formats.ply import SH_C0

KHR = "KHR_gaussian_splatting"


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
    linear = torch.where(
        gaussians.colors <= 0.04045,
        gaussians.colors / 12.92,
        ((gaussians.colors + 0.055) / 1.055) ** 2.4,
    )
    np.testing.assert_allclose(values["COLOR_0"][:, :3], linear, atol=1e-6)  # as glTF has colours
    np.testing.assert_array_equal(values["COLOR_0"][:, 3], gaussians.opacities)


def test_a_reader_without_the_extension_sees_the_points(tmp_path):
    gaussians = some()
    save_glb(tmp_path / "a.glb", gaussians)
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, gaussians.means * torch.tensor([1, -1, -1]))
    assert np.abs(cloud.colors[:, :3] / 255 - to_linear(gaussians.colors)).max() < 0.6 / 255


def renamed(data):
    """Return the file with names of attributes that glTF without the extension allows."""
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + size])
    (primitive,) = tree["meshes"][0]["primitives"]
    names = primitive["attributes"]
    primitive["attributes"] = {name.replace(f"{KHR}:", "_"): at for name, at in names.items()}
    del primitive["extensions"], tree["extensionsUsed"]
    return glb(json.dumps(tree).encode(), data[28 + size :])


@pytest.mark.parametrize("degree", [0, 3])
def test_the_validator_of_khronos_accepts_it(tmp_path, degree):
    """The validator knows no extension's attributes yet (its issue 252): all else must be valid."""
    modules = npm_package("gltf-validator", "2.0.0-dev.3.10")
    path = tmp_path / "chair.glb"
    save_glb(path, some(degree=degree))
    program = """
    const validator = require(process.argv[1]), fs = require("fs");
    validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))
      .then(report => console.log(JSON.stringify(report.issues)));"""

    def issues():
        printed = run_node("-e", program, modules / "gltf-validator", path, cwd=tmp_path)
        return json.loads(printed)["messages"]

    found = {(issue["code"], issue["pointer"].rpartition("/")[2]) for issue in issues()}
    _, values = attributes(*read_glb(path))
    ours = {f"{KHR}:{name}" for name in values} - {f"{KHR}:POSITION", f"{KHR}:COLOR_0"}
    assert found == {("MESH_PRIMITIVE_INVALID_ATTRIBUTE", name) for name in ours} | {
        ("UNSUPPORTED_EXTENSION", "0")
    }
    path.write_bytes(renamed(path.read_bytes()))
    assert issues() == []
    data = path.read_bytes()
    path.write_bytes(data.replace(b'"max": [', b'"max": [9', 1))  # what is wrong is seen
    assert issues()


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
