"""Gaussians of known shapes to surfaces."""

import math
from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from helpers.refusals import refused
from helpers.views import cloud_of

from gamba_warp.cameras import fibonacci_sphere
from gamba_warp.errors import UserError
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.rasterize import depth_quantile
from gamba_warp.render import render
from gamba_warp.surfaces.density import MOST_POINTS, opacity_volume
from gamba_warp.surfaces.extract import Surface, cleaned_mesh, extract_surface, unit_frame
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.surfaces.options import SurfaceOptions
from gamba_warp.surfaces.solid import distances, solid_of
from gamba_warp.surfaces.texture import Texture, point_colors, vertex_normals
from gamba_warp.surfaces.tsdf import CLEAR, Views, fuse, look_around, sphere_cameras
from gamba_warp.versions import import_open3d

UNCHANGED = SurfaceOptions(min_component=0, close_holes=0)  # of a mesh that is cleaned
QUICK = dict(voxels=64, views=24, pixels=128)
SEEN = SurfaceOptions(views=24, pixels=96, transmittance=0.9)


def at(points, sigma=0.010, opacity=0.9, colors=0.5):
    """Round Gaussians at ``points [N, 3]``."""
    return cloud_of(points, sigma, opacity, colors)


def on(mesh, count=4000, **options):
    """Gaussians spread over a trimesh, evenly."""
    points, _ = trimesh.sample.sample_surface_even(mesh, count, seed=0)
    return at(points, **options)


def test_a_mesh_with_holes_becomes_a_closed_solid():
    """A cap that is missing, a cavity and a crumb; checked by three libraries."""
    ball = trimesh.creation.icosphere(3, 0.5)
    ball.update_faces(ball.triangles_center[:, 2] < 0.46)
    cavity = trimesh.creation.icosphere(2, 0.2)
    cavity.invert()
    crumb = trimesh.creation.box((0.06, 0.06, 0.06)).apply_translation((0.6, 0, 0))
    given = trimesh.util.concatenate([ball, cavity, crumb])
    for most in (0, 900):
        vertices, faces = solid_of(given.vertices, given.faces, 32, most)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
        assert mesh.volume == pytest.approx(ball.convex_hull.volume, rel=0.05)  # cap, grid
        solid = manifold3d.Manifold(manifold3d.Mesh(vertices.astype(np.float32), faces))
        assert solid.status() == manifold3d.Error.NoError and solid.genus() == 0
        o3d = import_open3d()
        corners = o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
        assert o3d.geometry.TriangleMesh(*corners).is_watertight()
        assert not most or len(faces) <= most
        assert distances(ball.vertices, vertices, faces).mean() < 0.01  # a third of a voxel
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    refused("encloses nothing", solid_of, flat, np.array([[0, 1, 2]]), 16)


def as_trimesh(surface):
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize("method", ["tsdf", "density"])
def test_a_sphere_within_a_voxel(method):
    """In front of the centres: by the near Gaussians' edges, or by the width of the level set."""
    ball = at(0.4 * fibonacci_sphere(4000))
    surface = extract_surface(ball, SurfaceOptions(method=method, **QUICK))
    error = (np.linalg.norm(surface.vertices, axis=1) - 0.4) * QUICK["voxels"]
    assert abs(error.mean()) < 1 and math.sqrt(np.mean(error**2)) < 1
    assert np.mean(abs(error) < 1) > 0.95 and abs(error).max() < 1.5
    assert error.mean() > 0  # the bias is known: outwards, by less than one and a half sigma
    mesh = as_trimesh(surface)
    volume = 4 / 3 * math.pi * (0.4 + error.mean() / QUICK["voxels"]) ** 3
    assert abs(mesh.volume - volume) < 0.02 * volume  # positive: the outside is in front
    assert surface.is_watertight() == mesh.is_watertight


def test_what_has_no_volume_has_no_density():
    """A scale of 0, which a file says by a logarithm of -inf."""
    ball = at(0.4 * fibonacci_sphere(600), sigma=0.03)
    ball.quats = torch.randn(600, 4)
    flat = torch.arange(600) % 5 == 0
    ball.scales[flat, 0] = 0
    want, where = opacity_volume(ball.select(~flat), 24)
    volume, origin = opacity_volume(ball, 24)
    np.testing.assert_array_equal(volume, want)
    np.testing.assert_array_equal(origin, where)
    refused("no visible Gaussian", opacity_volume, ball.select(flat), 24)


def test_two_objects_stay_two():
    points = 0.2 * fibonacci_sphere(1500)
    pair = at(np.concatenate([points - [0.28, 0, 0], points + [0.28, 0, 0]]))
    surface = extract_surface(pair, SurfaceOptions(**QUICK))
    parts = as_trimesh(surface).split(only_watertight=False)
    assert len(parts) == 2 and np.abs(np.abs([p.centroid[0] for p in parts]) - 0.28).max() < 0.01
    largest = extract_surface(pair, SurfaceOptions(largest=True, **QUICK))
    assert len(as_trimesh(largest).split(only_watertight=False)) == 1


@pytest.mark.parametrize("method", ["tsdf", "density"])
def test_a_torus_keeps_its_hole(method):
    torus = trimesh.creation.torus(0.32, 0.12)
    options = SurfaceOptions(method=method, close_holes=1000, **QUICK)
    mesh = as_trimesh(extract_surface(on(torus, 6000), options))
    assert mesh.euler_number == 0 and mesh.volume > 0


def test_colors_of_a_sphere_of_two():
    points = 0.4 * fibonacci_sphere(4000)
    red, blue = torch.tensor([0.9, 0.1, 0.2]), torch.tensor([0.1, 0.3, 0.8])
    colors = torch.where(torch.from_numpy(points[:, 2:] > 0), red, blue)
    for method in ("tsdf", "density"):
        options = SurfaceOptions(method=method, colors=True, **QUICK)
        surface = extract_surface(at(points, colors=colors), options)
        height = surface.vertices[:, 2]
        for side, color in ((height > 0.06, red), (height < -0.06, blue)):
            # a twentieth of the other side shines through, more in a gap
            error = np.abs(surface.colors[side] - color.numpy())
            assert error.mean() < 0.05 and error.max() < 0.2


def test_an_unseen_vertex_takes_the_nearest_color():
    views = look_around(at(0.4 * fibonacci_sphere(2000)), SEEN)
    ball = trimesh.creation.icosphere(3, 0.4)
    inside = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    vertices = np.concatenate([ball.vertices, inside])
    faces = np.concatenate([ball.faces, [np.arange(3) + len(ball.vertices)]])
    normals = vertex_normals(vertices, faces)
    assert np.abs(point_colors(vertices, normals, views, 64) - 0.5).max() < 0.02


def test_space_that_is_seen_through_is_cleared():
    """Depth of one view makes a wall out of a speck; the others see past it."""
    views = look_around(at(0.3 * fibonacci_sphere(2000)), SEEN)
    cameras = views.cameras
    depth = views.depth.clone()
    depth[0, :24] = float(cameras.viewmats[0, 2, 3])  # a wall through the centre, beside the ball
    walled = Views(cameras, depth, views.rgb)
    cut = fuse(walled, 64, 5.0, 1.0)[0]
    depth[1:][depth[1:] >= CLEAR] = 0.0
    kept = fuse(Views(cameras, depth, views.rgb), 64, 5.0, 1.0)[0]
    reach = [np.linalg.norm(vertices, axis=1) for vertices in (cut, kept)]
    assert np.mean(reach[1] > 0.34) > 2 * np.mean(reach[0] > 0.34)


def ball_with_speck():
    ball = trimesh.creation.icosphere(4, 0.4)
    speck = trimesh.creation.icosphere(1, 0.02).apply_translation([0.8, 0, 0])
    return ball, trimesh.util.concatenate([ball, speck])


@pytest.mark.parametrize(
    "options", [{"min_component": 0.02}, {"min_diameter": 0.1}, {"largest": True}]
)
def test_floaters_go(options):
    ball, both = ball_with_speck()
    assert len(cleaned_mesh(both.vertices, both.faces, UNCHANGED)[1]) == len(both.faces)
    vertices, faces = cleaned_mesh(both.vertices, both.faces, replace(UNCHANGED, **options))
    assert len(faces) == len(ball.faces) and np.linalg.norm(vertices, axis=1).max() < 0.41


def test_holes_up_to_a_size_are_closed():
    ball = trimesh.creation.icosphere(3, 0.4)
    around = np.unique(ball.faces[(ball.faces == 5).any(1)])
    small = ball.faces[~(ball.faces == 5).any(1)]  # a ring of five or six edges
    large = ball.faces[~np.isin(ball.faces, around).any(1)]
    for faces, closed in ((small, True), (large, False)):
        vertices, faces = cleaned_mesh(ball.vertices, faces, replace(UNCHANGED, close_holes=6))
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.is_watertight == closed
        assert not closed or abs(mesh.volume - ball.volume) < 0.01 * ball.volume


def test_decimation():
    ball = trimesh.creation.icosphere(4, 0.4)
    vertices, faces = cleaned_mesh(ball.vertices, ball.faces, replace(UNCHANGED, faces=500))
    assert 450 < len(faces) <= 500 and len(np.unique(faces)) == len(vertices)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.4).max() < 0.01
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0


def test_smoothing_flattens_and_keeps_the_size():
    ball = trimesh.creation.icosphere(4, 0.4)
    noise = np.random.default_rng(0).normal(0, 0.003, ball.vertices.shape)
    vertices, _ = cleaned_mesh(ball.vertices + noise, ball.faces, replace(UNCHANGED, smooth=10))
    radii = np.linalg.norm(vertices, axis=1)
    assert radii.std() < 0.0015 and abs(radii.mean() - 0.4) < 0.001


def test_a_clean_mesh_of_nothing():
    refused("no part", cleaned_mesh, np.zeros((3, 3)), np.array([[0, 1, 2]]), UNCHANGED)


@pytest.mark.parametrize("method", ["tsdf", "density"])
@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda some: some.opacities.zero_(), "no Gaussian"),
        (lambda some: some.means.add_(5), "within"),
        (lambda some: some.scales[3, 1].fill_(math.nan), "1 of 20 Gaussians are not finite"),
        (lambda some: some.means[3, 1].fill_(math.inf), "1 of 20 Gaussians are not finite"),
    ],
)
def test_what_has_no_surface(method, change, reason):
    some = at(0.3 * fibonacci_sphere(20))
    options = SurfaceOptions(method=method, **QUICK)
    refused("no Gaussian", extract_surface, some.select(torch.zeros(20) > 0), options)
    change(some)
    refused(reason, extract_surface, some, options)


@pytest.mark.parametrize("method", ["tsdf", "density"])
def test_one_gaussian_has_a_surface(method):
    surface = extract_surface(at([[0.0, 0, 0]], sigma=0.1), SurfaceOptions(method=method, **QUICK))
    assert 0.05 < np.ptp(surface.vertices, axis=0).max() < 0.6


@pytest.mark.parametrize("method", ["tsdf", "density"])
def test_far_gaussians_change_nothing(method):
    near = at(0.4 * fibonacci_sphere(3000))
    far = at(np.concatenate([near.means.numpy(), [[900.0, 3, 5], [-40.0, 0, 0]]]))
    options = SurfaceOptions(method=method, **QUICK)
    got = [extract_surface(some, options).vertices for some in (near, far)]
    want, got = (vertices[np.lexsort(vertices.T)] for vertices in got)  # Open3D's order varies
    assert got.shape == want.shape and np.abs(got - want).max() < 1e-6


def test_unit_frame_passes_over_floaters():
    points = np.array([3.0, 4, 5]) + 20 * fibonacci_sphere(3000) * [1, 0.5, 0.5]
    some = at(np.concatenate([points, [[9000.0, 3, 5]]]), sigma=0.1)
    center, side = unit_frame(some)
    assert np.abs(center.numpy() - [3, 4, 5]).max() < 0.3 and abs(side / 40 - 1) < 0.03


def test_a_grid_that_is_too_large():
    corners = np.array([[x, y, z] for x in (-0.9, 0.9) for y in (-0.9, 0.9) for z in (-0.9, 0.9)])
    assert (1.8 * 1024) ** 3 > MOST_POINTS
    refused("1024 voxels a unit: a grid of", opacity_volume, at(corners), 1024)


def test_depth_quantile_against_its_definition():
    """Every pixel's transmittance in float64, Gaussian after Gaussian."""
    generator = torch.Generator().manual_seed(0)
    count = 60
    scene = Gaussians(
        means=(torch.rand(count, 3, generator=generator) - 0.5) * 0.7,
        quats=torch.randn(count, 4, generator=generator),
        scales=0.02 + 0.1 * torch.rand(count, 3, generator=generator),
        opacities=0.1 + 0.8 * torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
    )
    cameras = sphere_cameras(3, 0.8, 37)
    meta = render(scene, cameras).meta
    y, x = torch.meshgrid(*(torch.arange(37).double() + 0.5,) * 2, indexing="ij")
    for transmittance in (0.9, 0.5):
        got = depth_quantile(meta, transmittance)
        assert got.shape == (3, 37, 37, 1) and got.dtype == torch.float32
        for v in range(3):
            clear = torch.ones(37, 37, dtype=torch.float64)
            want = torch.zeros(37, 37, dtype=torch.float64)
            for i in meta["depths"][v].argsort().tolist():
                a, k, e = meta["conics"][v, i].double()
                mean = meta["means2d"][v, i].double()
                dx, dy = x - mean[0], y - mean[1]
                q = a * (dx + k * dy) ** 2 + e * dy**2
                alpha = (meta["opacities"][v, i].double() * torch.exp(-0.5 * q)).clamp(max=0.99)
                after = clear * (1 - torch.where(alpha < 1 / 255, 0.0, alpha))
                crossed = (clear > transmittance) & (after <= transmittance)
                want[crossed] = meta["depths"][v, i].double()
                clear = after
            same = got[v, ..., 0].double() == want
            assert same.float().mean() > 0.998  # a pixel may lie on the threshold
            assert (want > 0).any() and (want == 0).any()
    with pytest.raises(ValueError, match="transmittance"):
        depth_quantile(meta, 1.0)


@pytest.mark.parametrize("seen", [[(5, 6)], []])
def test_a_few_pixels_that_the_fusion_passes_over_are_no_surface_in_one_line(seen):
    """Open3D looks at every fourth pixel, and raises where none of these has a depth."""
    cameras = sphere_cameras(3, 0.5, 32)
    depth = torch.full((3, 32, 32), CLEAR)
    for row, column in seen:
        depth[:, row, column] = 1.5
    with pytest.raises(UserError, match="^the fused depth has no surface$"):
        fuse(Views(cameras, depth, torch.zeros(3, 32, 32, 3)), 64, 5.0, 1.0)


def test_a_textured_obj_stays_closed(tmp_path):
    """Corners at seams of the texture share their vertex, as another program reads it."""
    import pymeshlab

    box = trimesh.creation.box()
    uvs = np.random.default_rng(4).random((len(box.faces), 3, 2))
    image = Texture(uvs, np.full((8, 8, 3), 0.5, np.float32))
    save_mesh(tmp_path / "a.obj", Surface(np.array(box.vertices), box.faces, texture=image))
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "a.obj"))
    found = meshes.get_topological_measures()
    assert found["boundary_edges"] == 0 and found["vertices_number"] == 8
    mesh = load_mesh(tmp_path / "a.obj")
    np.testing.assert_allclose(mesh.uvs, uvs, atol=1e-6)
