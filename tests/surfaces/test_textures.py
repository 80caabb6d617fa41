"""Textures of surfaces: an atlas whose image shows what vertex colours of few faces cannot."""

import numpy as np
import pytest
import trimesh
from helpers.views import cloud_of
from PIL import Image

from gamba_warp.cameras import fibonacci_sphere
from gamba_warp.cli import run
from gamba_warp.errors import UserError
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.formats.ply import save_ply
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.surfaces.options import SurfaceOptions
from gamba_warp.surfaces.texture import Texture, bake_texture, covered_texels, unwrapped
from gamba_warp.surfaces.tsdf import look_around

RADIUS = 0.4


def stripes(points):
    """Colours that change ten times from pole to pole."""
    odd = np.floor(points[:, 2] / RADIUS * 5).astype(int) % 2 == 1
    return np.where(odd[:, None], [0.9, 0.2, 0.1], [0.1, 0.3, 0.8])


@pytest.fixture(scope="module")
def ball():
    points = RADIUS * fibonacci_sphere(6000)
    return cloud_of(points, 0.008, 0.95, stripes(points))


@pytest.fixture(scope="module")
def baked(ball):
    mesh = trimesh.creation.icosphere(2, RADIUS)
    views = look_around(ball, SurfaceOptions(views=24, pixels=128))
    return mesh, bake_texture(mesh.vertices, mesh.faces, views, 64, 256)


def sampled(texture, face, weights):
    """The colours of places in faces, by the nearest texel."""
    uv = (texture.uvs[face] * weights[..., None]).sum(1)
    side = len(texture.image)
    column = np.floor(uv[:, 0] * side).astype(int).clip(0, side - 1)
    row = np.floor((1 - uv[:, 1]) * side).astype(int).clip(0, side - 1)
    return texture.image[row, column]


def test_few_faces_show_what_their_corners_cannot(baked):
    """320 faces have no vertex in many of the stripes; the texture has them all."""
    mesh, texture = baked
    rng = np.random.default_rng(0)
    face = rng.integers(0, len(mesh.faces), 4000)
    weights = rng.dirichlet([1, 1, 1], 4000)
    points = (mesh.vertices[mesh.faces[face]] * weights[..., None]).sum(1)
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    # At the edges of the stripes the Gaussians themselves are blurred.
    band = points[:, 2] / RADIUS * 5
    clear = np.abs(band - np.rint(band)) > 0.25
    error = np.abs(sampled(texture, face, weights) - stripes(points)).max(1)[clear]
    assert np.median(error) < 0.1 and np.mean(error < 0.25) > 0.95
    corners = stripes(mesh.vertices)[mesh.faces[face]]
    by_corners = np.abs((corners * weights[..., None]).sum(1) - stripes(points)).max(1)[clear]
    assert np.mean(by_corners < 0.25) < 0.75


def test_faces_do_not_overlap_and_each_has_its_texels():
    mesh = trimesh.creation.box((0.8, 0.6, 0.4)).subdivide().subdivide()
    uvs = unwrapped(mesh.vertices, mesh.faces, 256)
    assert uvs.shape == (len(mesh.faces), 3, 2) and uvs.min() >= 0 and uvs.max() <= 1
    texels, owner, weights = covered_texels(uvs, 256)
    # A texel on the edge of two faces is of both.
    assert len(texels) - len(np.unique(texels)) < 0.02 * len(texels)
    assert set(owner) == set(range(len(mesh.faces)))
    assert np.abs(weights.sum(1) - 1).max() < 1e-9
    assert len(np.unique(texels)) > 0.3 * 256**2  # the square is not wasted


def test_texels_of_one_triangle():
    """By hand: the lower left half of an image of 4 x 4; v is up, rows go down."""
    texels, owner, weights = covered_texels(np.array([[[0, 0], [1, 0], [0, 1.0]]]), 4)
    assert sorted(texels) == [0, 4, 5, 8, 9, 10, 12, 13, 14, 15] and not owner.any()
    (corner,) = np.flatnonzero(texels == 12)  # the centre of the lowest left texel
    np.testing.assert_allclose(weights[corner], [0.75, 0.125, 0.125])


def test_a_image_that_is_too_small(ball, monkeypatch):
    """xatlas leaves each face some room; where no centre of a texel falls into it, that is said."""
    views = look_around(ball, SurfaceOptions(views=8, pixels=32))
    mesh = trimesh.creation.icosphere(1, RADIUS)
    nowhere = np.zeros((len(mesh.faces), 3, 2))
    monkeypatch.setattr("gamba_warp.surfaces.texture.unwrapped", lambda *_: nowhere)
    with pytest.raises(UserError, match="--texture: 4 pixels are too few for 80 faces"):
        bake_texture(mesh.vertices, mesh.faces, views, 64, 4)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_textured_files_are_read_back(tmp_path, baked, kind):
    mesh, texture = baked
    surface = Surface(mesh.vertices, mesh.faces, None, texture)
    save_mesh(tmp_path / f"a b.{kind}", surface)
    again = load_mesh(tmp_path / f"a b.{kind}")
    assert not again.warnings and len(again.faces) == len(mesh.faces)
    (material,) = again.materials
    assert material.texture is not None and material.texture.shape == (256, 256, 4)
    got = again.vertices * [1, -1, -1]
    want = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(got[again.faces], want, atol=1e-6)
    back = Texture(again.uvs.astype(np.float64), material.texture[..., :3] / 255)
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], 200)
    face = np.arange(200)
    # 8 bits, and float32 places of texels: a place at the edge of one may fall into the next
    error = np.abs(sampled(back, face, weights) - sampled(texture, face, weights)).max(1)
    assert np.mean(error < 0.51 / 255) > 0.97
    names = {"glb": {"a b.glb"}, "obj": {"a b.obj", "a b.mtl", "a b.png"}}[kind]
    assert {path.name for path in tmp_path.iterdir()} == names


def test_the_command_writes_textures(tmp_path, ball):
    save_ply(tmp_path / "ball.ply", ball)
    out = tmp_path / "out"
    options = ["--voxels", "32", "--views", "8", "--pixels", "64", "--faces", "200"]
    options += ["--texture", "64", "--mesh", "obj", "glb", "ply"]
    assert run("export", [str(tmp_path / "ball.ply"), "--out", str(out), *options]) == 0
    ends = ("glb", "mtl", "obj", "ply", "png")
    assert sorted(path.name for path in out.iterdir()) == [f"ball-mesh.{end}" for end in ends]
    assert Image.open(out / "ball-mesh.png").size == (64, 64)
    assert trimesh.load(out / "ball-mesh.ply").visual.kind == "vertex"
