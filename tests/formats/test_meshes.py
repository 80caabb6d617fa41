import re
import unicodedata

import numpy as np
import pytest
import trimesh
from helpers.images import ADOBE_RGB, colour_profile, colours
from helpers.meshes import MTL, QUAD, write_quad
from PIL import Image

from gamba_warp.color_spaces import to_display, to_linear
from gamba_warp.formats.meshes import default_up, load_mesh


def test_textured_obj(tmp_path):
    mesh = load_mesh(write_quad(tmp_path))
    assert len(mesh.faces) == 2 and mesh.warnings == []
    material = mesh.materials[mesh.material_ids[0]]
    assert material.texture.shape == (16, 16, 4)
    assert material.color.tolist() == [1, 1, 1, 1]  # a texture replaces the plain colour
    corners = mesh.vertices[mesh.faces]
    # u grows with x, v with height
    np.testing.assert_allclose(mesh.uvs[..., 0], (corners[..., 0] + 1) / 2)
    np.testing.assert_allclose(mesh.uvs[..., 1], corners[..., 1] / 2)
    np.testing.assert_allclose(np.abs(mesh.normals[..., 2]), 1)


def test_normalized(tmp_path):
    path = write_quad(tmp_path)
    assert default_up(path) == "y" and default_up("a.ply") == "z"
    before = load_mesh(path)
    mesh, transform, scale = before.normalized("y")
    assert scale == 0.5
    np.testing.assert_allclose(mesh.vertices.min(0), [-0.5, 0, -0.5])
    np.testing.assert_allclose(mesh.vertices.max(0), [0.5, 0, 0.5])
    points = np.hstack([before.vertices, np.ones((4, 1))])
    np.testing.assert_allclose(scale * points @ transform.T, mesh.vertices, atol=1e-12)
    np.testing.assert_allclose(np.abs(mesh.normals[..., 1]), 1)
    np.testing.assert_allclose(before.normalized("z")[0].vertices.max(0), [0.5, 0.5, 0])
    # x to y, y to z, z to x; then y-up to z-up
    turned, _, _ = before.normalized("y", [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(turned.vertices.max(0), [0, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(np.abs(turned.normals[..., 0]), 1)


@pytest.mark.parametrize(
    "changes, warning",
    [
        ({"mtl": None}, "quad.mtl: not found"),
        ({"texture": None, "mtl": MTL.replace("Kd 0.1 0.1 0.1", "")}, "paint.png: not found"),
        ({"obj": QUAD.replace("usemtl paint", "usemtl other")}, "no material: grey"),
    ],
)
def test_missing_parts_are_grey_and_named(tmp_path, changes, warning):
    mesh = load_mesh(write_quad(tmp_path, **changes))
    assert any(warning in line for line in mesh.warnings), mesh.warnings
    material = mesh.materials[0]
    assert material.texture is None
    np.testing.assert_allclose(material.color, [*[to_linear(0.6)] * 3, 1])


def test_broken_texture_becomes_the_plain_colour(tmp_path):
    path = write_quad(tmp_path)
    for content in ((tmp_path / "paint.png").read_bytes()[:60], b"no image", None):
        (tmp_path / "paint.png").unlink()
        if content is not None:
            (tmp_path / "paint.png").write_bytes(content)
        mesh = load_mesh(path)
        assert mesh.materials[0].texture is None
        assert any("paint.png" in line for line in mesh.warnings), content
        # 0.1 is rounded to 8 bits on the way
        np.testing.assert_allclose(mesh.materials[0].color[:3], to_linear(0.1), atol=1e-3)


def test_texture_without_uvs_becomes_its_mean(tmp_path):
    mesh = load_mesh(write_quad(tmp_path, obj=QUAD.replace("1/1 2/2 3/3 4/4", "1 2 3 4")))
    assert mesh.warnings == ["a textured part has no UV coordinates"]
    np.testing.assert_array_equal(mesh.materials[0].texture, [[[127, 127, 63, 255]]])


@pytest.mark.parametrize(
    "name", ["PAINT.png", ".\\paint.PNG", "-clamp on -s 1 1 1 paint.png", "C:\\art\\paint.png"]
)
def test_texture_names_of_other_systems(tmp_path, name):
    mesh = load_mesh(write_quad(tmp_path, mtl=MTL.replace("paint.png", name)))
    assert mesh.materials[0].texture is not None, mesh.warnings


def test_texture_names_may_be_decomposed(tmp_path):
    """Archives made on macOS store an umlaut as a letter and a mark."""
    stored = unicodedata.normalize("NFD", "wörk.png")
    path = write_quad(tmp_path, mtl=MTL.replace("paint.png", "wörk.png"), texture=stored)
    assert load_mesh(path).materials[0].texture is not None


def test_colours_that_are_not_rgb_are_named(tmp_path):
    mesh = load_mesh(write_quad(tmp_path, mtl="newmtl paint\nKd xyz 0.1 0.2 0.3\n"))
    assert mesh.warnings == ["the colour of paint is not read: Kd xyz 0.1 0.2 0.3"]


def test_negative_indices_count_back_from_their_line(tmp_path):
    head, face = QUAD.rsplit("f ", 1)
    far = "v 9 9 9\nv 8 9 9\nv 9 8 9\nvt 0.5 0.5\nf "
    good = load_mesh(write_quad(tmp_path, obj=f"{head}f {face}{far}5/5 6/5 7/5\n"))
    negative = f"{head}f -4/-4 -3/-3 -2/-2 -1/-1\n{far}-3/-1 -2/-1 -1/-1\n"
    relative = load_mesh(write_quad(tmp_path, obj=negative))
    np.testing.assert_allclose(relative.vertices[relative.faces], good.vertices[good.faces])
    np.testing.assert_allclose(relative.uvs, good.uvs)


@pytest.mark.parametrize("old", ["vt 0 0", "vt 1 0"])  # where others say how many numbers
def test_a_texture_coordinate_of_one_number_has_v_0(tmp_path, old):
    plain = "usemtl nothing\nf 1 2 3\n"  # two materials
    want = load_mesh(write_quad(tmp_path, obj=QUAD + plain))
    assert QUAD.count(old) == 1
    short = QUAD.replace(old, old[:-2]) + plain
    for text in (short, short.replace("\n", "\r\n"), short.replace("vt 0 1", "vt 0 1 0")):
        np.testing.assert_array_equal(load_mesh(write_quad(tmp_path, obj=text)).uvs, want.uvs)
    flat = load_mesh(write_quad(tmp_path, obj=re.sub("(vt .) .", r"\1", QUAD)))
    np.testing.assert_array_equal(flat.uvs[..., 0], load_mesh(write_quad(tmp_path)).uvs[..., 0])
    assert not flat.uvs[..., 1].any()


def test_transparency_of_mtl(tmp_path):
    for line, alpha in (("d 0.25", 0.25), ("Tr 0.25", 0.75)):
        path = write_quad(tmp_path, mtl=f"newmtl paint\nKd 0.5 1 0\n{line}\n")
        want = [*to_linear([0.5, 1, 0]), alpha]
        np.testing.assert_allclose(load_mesh(path).materials[0].color, want, rtol=1e-6)
    path = write_quad(tmp_path, mtl=MTL + "map_d mask.png\n")
    for value in (np.uint8(64), np.uint16(64 * 257)):
        Image.fromarray(np.full((4, 4), value)).save(tmp_path / "mask.png")
        assert (load_mesh(path).materials[0].texture[..., 3] == 64).all()


def test_colour_profiles_of_textures(tmp_path):
    """They are used beside an .obj; glTF ignores them, as its renderers do."""
    path, image = write_quad(tmp_path), colours("RGB", (16, 16))
    image.save(tmp_path / "paint.png")
    before = load_mesh(path).materials[0].texture
    image.info["icc_profile"] = colour_profile(ADOBE_RGB)
    image.save(tmp_path / "paint.png")
    profiled = load_mesh(path)
    moved = profiled.materials[0].texture[..., :3].astype(int) - before[..., :3]
    assert np.abs(moved).max() > 20 and not profiled.warnings
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), image=image)
    box.export(tmp_path / "a.glb")
    assert b"iCCP" in (tmp_path / "a.glb").read_bytes()
    np.testing.assert_array_equal(load_mesh(tmp_path / "a.glb").materials[0].texture, before)
    image.save(tmp_path / "paint.png", icc_profile=b"none")
    assert "paint.png: its colour profile is not used" in load_mesh(path).warnings[0]


def test_other_formats(tmp_path):
    box = trimesh.creation.box()
    for suffix in (".ply", ".stl", ".off"):
        box.export(tmp_path / f"box{suffix}")
        mesh = load_mesh(tmp_path / f"box{suffix}")
        assert len(mesh.faces) == 12
        # a cube is flat-shaded, though its vertices are shared
        assert np.allclose(np.abs(mesh.normals).max(-1), 1), suffix
    box.visual.vertex_colors = np.tile([10, 200, 30, 255], (8, 1))
    box.export(tmp_path / "paint.ply")
    mesh = load_mesh(tmp_path / "paint.ply")
    assert (mesh.colors == [10, 200, 30, 255]).all()
    assert mesh.materials[0].color.tolist() == [1, 1, 1, 1]


def test_smooth_normals_are_kept(tmp_path):
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "ball.ply")
    mesh = load_mesh(tmp_path / "ball.ply")
    assert ((mesh.normals * mesh.vertices[mesh.faces]).sum(-1) > 0.999).all()


def test_display_curve_inverts():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(to_display(to_linear(values)), values, atol=2e-6)  # float32
    np.testing.assert_allclose(to_linear(0.5), 0.2140, atol=1e-4)
