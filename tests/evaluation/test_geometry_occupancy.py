"""Volume IoU of open meshes, and known answers."""

import math
import sys
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from helpers.children import ran
from helpers.meshes import as_mesh, cube

from gamba_warp.eval.shapes import occupancy
from gamba_warp.eval.shapes.flags import clean_mesh
from gamba_warp.eval.shapes.metrics import compare, shape_iou, volume_iou
from gamba_warp.eval.shapes.occupancy import (
    RULES,
    VOTERS,
    directions,
    enclosed,
    grid_around,
    majority,
    open_parts,
    solid,
    syncdreamer_grid,
)
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.shapes.shape import Mesh


def known_shapes() -> dict[str, Mesh]:
    """Closed meshes of fine triangles by name; the longest side is 1 or a little less."""

    def mesh(*sources) -> Mesh:
        return as_mesh(trimesh.util.concatenate(list(sources)))

    box = trimesh.creation.box()
    for _ in range(4):
        box = box.subdivide()
    cavity = trimesh.creation.icosphere(4, 0.4)
    cavity.invert()
    left, right = trimesh.creation.icosphere(4, 0.35), trimesh.creation.icosphere(4, 0.35)
    left.apply_translation([-0.15, 0, 0])
    right.apply_translation([0.15, 0, 0])
    return {
        "ball": mesh(trimesh.creation.icosphere(4, 0.5)),
        "cube": mesh(box),
        "torus": mesh(trimesh.creation.torus(0.35, 0.15, major_sections=64, minor_sections=32)),
        "shell": mesh(trimesh.creation.icosphere(4, 0.5), cavity),
        "two balls": mesh(left, right),
    }


def with_hole(mesh: Mesh, fraction: float, seed: int) -> Mesh:
    """Cut out the faces nearest to a random point, up to ``fraction`` of the area."""
    area = np.linalg.norm(mesh.normals(), axis=1)
    middle = mesh.corners().mean(1)
    at = np.random.default_rng(seed).choice(len(middle), p=area / area.sum())
    order = np.argsort(((middle - middle[at]) ** 2).sum(1), kind="stable")
    kept = np.cumsum(area[order]) > fraction * area.sum() * (1 + 1e-9)
    return Mesh(mesh.vertices, mesh.faces[np.sort(order[kept])])


def with_flips(mesh: Mesh, fraction: float, seed: int) -> Mesh:
    """Turn over about ``fraction`` of the faces, drawn at random."""
    faces = mesh.faces.copy()
    chosen = np.random.default_rng(seed).random(len(faces)) < fraction
    faces[chosen] = faces[chosen][:, ::-1]
    return Mesh(mesh.vertices, faces)


def doubled(mesh: Mesh) -> Mesh:
    """Add every face again with the other orientation, as in files for culling renderers."""
    return Mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))


def drift(mesh, damage=lambda mesh: mesh):
    """Return the IoU by rule of the damaged mesh's occupancy with that of the closed mesh."""
    grid = grid_around(mesh, resolution=16)
    gt, broken = enclosed(mesh, grid), clean_mesh(damage(mesh))[0]
    return {name: volume_iou(rule.fill(broken, grid), gt) for name, rule in RULES.items()}


SHAPES = known_shapes()
# IoU of the rule "solid" with the closed original, by the fraction of the area that is cut out, at
# least: the figures of eval/README.md less 0.02 for other places of the hole and coarser voxels
LEAST = {0.01: 0.97, 0.05: 0.95, 0.1: 0.89, 0.2: 0.78, 0.5: 0.44}


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_closed_and_full(name):
    mesh = SHAPES[name]
    assert mesh.is_closed() and clean_mesh(mesh)[1] == []
    volume = {
        "ball": math.pi / 6,
        "cube": 1.0,
        "torus": 2 * math.pi**2 * 0.35 * 0.15**2,
        "shell": math.pi / 6,
        # of two balls less their common lens
        "two balls": 8 / 3 * math.pi * 0.35**3
        - math.pi * (0.7 - 0.3) ** 2 * (0.3**2 + 4 * 0.3 * 0.35) / (12 * 0.3),
    }[name]
    assert abs(solid(mesh, grid_around(mesh, resolution=24)).sum() / 24**3 / volume - 1) < 0.02


@pytest.mark.parametrize("fraction", LEAST)
def test_drift_of_the_default_rule(fraction):
    for name, mesh in SHAPES.items():
        grid = grid_around(mesh, resolution=12)
        gt = solid(mesh, grid)
        for seed in range(2):
            holed = with_hole(mesh, fraction, seed)
            assert not holed.is_closed()
            iou = volume_iou(solid(holed, grid), gt)
            assert iou >= LEAST[fraction], f"{name}, hole {fraction}, seed {seed}: {iou}"


def test_the_default_rule_does_not_mind_orientation():
    """A case where the winding number finds nothing."""
    for mesh in (SHAPES["ball"], SHAPES["torus"]):
        values = drift(mesh, lambda m: with_flips(with_hole(m, 0.05, 0), 0.5, 0))
        assert values["solid"] > 0.95 > 0.1 > values["winding"]
        values = drift(mesh, lambda m: doubled(with_hole(m, 0.05, 0)))
        assert values["solid"] > 0.95


def scattered(count, size, seed):
    """Triangles anywhere in the unit cube, most of them across each other."""
    drawn = np.random.default_rng(seed)
    places = drawn.uniform(-0.5, 0.5, (count, 1, 3)) + drawn.normal(0, size, (count, 3, 3))
    return Mesh(places.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


@pytest.mark.parametrize("name", ["few", "many", "cube", "shell"])
def test_steps_far_from_every_face_need_no_ray(name, monkeypatch):
    """The same voxels are enclosed as where a ray is cast along every step of the grid."""
    known = {"few": scattered(7, 0.4, 0), "many": scattered(900, 0.1, 1), "cube": cube((0.3, 0, 0))}
    mesh = known.get(name) or SHAPES[name]
    grids = grid_around(mesh, resolution=29), syncdreamer_grid(33)
    found = [enclosed(mesh, grid) for grid in grids]
    fraction = occupancy._near(mesh, grids[0]).mean()
    assert 0 < fraction < 1 or name == "few"
    monkeypatch.setattr(occupancy, "_near", lambda _, grid: np.ones(grid.shape, bool))
    for ours, grid in zip(found, grids):
        assert (ours == enclosed(mesh, grid)).all()
    assert found[0].any() == (name != "few")


def test_votes_that_are_decided_are_not_taken():
    """Early stopping once the majority is decided gives the result of all rays."""
    for mesh in (with_hole(SHAPES["torus"], 0.2, 0), scattered(40, 0.3, 2)):
        grid = grid_around(mesh, resolution=13)
        rays = [occupancy._rays(grid.points(), way) for way in directions()]
        votes = sum(mesh.scene().count_intersections(part).numpy() % 2 for part in rays)
        assert len(np.unique(votes)) > VOTERS // 2
        assert (majority(mesh, grid) == (2 * votes > VOTERS)).all()
    half = np.array(directions())[: VOTERS // 2]
    assert (half[:, 2] > 0).all()  # so no direction is also among the opposites


def test_rules_agree_on_a_closed_ball():
    values = drift(SHAPES["ball"])
    assert values == dict.fromkeys(RULES, 1.0)


def test_open_sheets_hold_nothing(monkeypatch):
    """Flat sheets, alone and beside closed parts; facing sheets are another case."""
    corners = np.array([[-0.4, -0.4, 0.0], [0.4, -0.4, 0], [0.4, 0.4, 0], [-0.4, 0.4, 0]])
    square = np.array([[0, 1, 2], [0, 2, 3]])
    turn = trimesh.transformations.rotation_matrix(0.6, [1, 2, 3])[:3, :3]
    sheets = [corners, corners + [0.9, 0, 0]]
    both = Mesh(np.concatenate(sheets) @ turn.T, np.concatenate([square, square + 4]))
    grid = grid_around(both, resolution=24)
    majority_of = Mock(wraps=occupancy._add_majority)
    monkeypatch.setattr(occupancy, "_add_majority", majority_of)
    assert len(open_parts(both)) == 2 and not solid(both, grid).any()
    (call,) = majority_of.call_args_list
    assert call.args[1] is both, "a flat part alone takes no rays"
    small = cube(side=0.25)
    vertices = np.concatenate([small.vertices, corners + [0, 0, 0.3]])
    beside = Mesh(vertices, np.concatenate([small.faces, square + 8]))
    assert solid(beside, grid_around(beside, resolution=24)).sum() == 6**3
    empty = shape_iou(both, both, replace(PRESETS["default"], iou_voxels=16))
    assert empty["iou"] is None and empty["iou_reason"] == "neither shape fills a voxel"


@pytest.mark.parametrize("voxels", [8, 32, 64])
@pytest.mark.parametrize("shift", [(0.25, 0, 0), (0.5, 0.25, 0), (0.3, 0.2, 0.1), (1.5, 0, 0)])
def test_cubes_shifted(shift, voxels):
    overlap = np.prod(1 - np.minimum(1, np.abs(shift)))
    got = shape_iou(cube(shift), cube(), replace(PRESETS["default"], iou_voxels=voxels))
    on_voxels = all(value * voxels % 1 == 0 for value in shift)
    # off the voxels' faces a layer of half a voxel may count or not on each side
    assert abs(got["iou"] - overlap / (2 - overlap)) <= (1e-12 if on_voxels else 0.03)


@pytest.mark.parametrize(
    "other, want, error",
    [(cube(side=4.0), 1 / 64, 2e-3), (cube(side=1e3), 0.0, 1e-5), (cube((1e5, 0, 0)), 0.0, 0.0)],
)
def test_predictions_of_another_size_or_place_still_count(other, want, error):
    got = shape_iou(other, cube(), replace(PRESETS["default"], iou_voxels=16))
    assert abs(got["iou"] - want) <= error and got["iou_voxel"] > 1 / 16


@pytest.mark.parametrize("radius", [0.25, 0.4, 0.49])
def test_spheres(radius):
    meshes = [as_mesh(trimesh.creation.icosphere(4, r)) for r in (radius, 0.5)]
    got = compare(*meshes, replace(PRESETS["default"], num_points=30_000, iou_voxels=32))
    # nearest samples are not straight across: at most a noise floor longer, squared against it
    slack = got["noise_floor"] ** 2 / (0.5 - radius) + 5e-4
    facets = 5e-4  # how far the balls' faces lie within their spheres
    assert -facets < got["chamfer"] - (0.5 - radius) < slack
    assert -facets < got["hausdorff"] - (0.5 - radius) < 6 * got["noise_floor"]
    assert abs(got["iou"] - (2 * radius) ** 3) < 0.01 and got["normal_consistency"] > 0.99


MANY = """
import resource, sys
import numpy as np
import trimesh
from gamba_warp.cli import run
trimesh.creation.box().export(sys.argv[2])
head = "ply\\nformat binary_little_endian 1.0\\nelement vertex 5000000\\n"
head += "".join(f"property float {axis}\\n" for axis in "xyz") + "end_header\\n"
with open(sys.argv[1], "wb") as file:
    file.write(head.encode())
    file.write(np.random.default_rng(0).random((5_000_000, 3), np.float32).tobytes())
code = run("eval-geometry", sys.argv[1:] + ["--points", "5000"])
print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
sys.exit(code)
"""


def test_five_million_points_in_memory(tmp_path):
    """Drawn from; with --points 5000000 it takes 2 GB and minutes."""
    done = ran(sys.executable, "-c", MANY, tmp_path / "many.ply", tmp_path / "box.stl")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split("peak")[1]) < 4096, "MB"


@pytest.mark.parametrize("rule", ["solid", "parity"])
@pytest.mark.parametrize("side, shift, want", [(0.8, 0.0, 0.512), (1.0, 0.1, 0.9 / 1.1)])
def test_the_stated_error_of_the_voxels_holds(rule, side, shift, want):
    """Cubes whose faces lie between the points of the grid."""
    chosen = replace(PRESETS["default"], occupancy=rule, iou_voxels=32)
    got = shape_iou(cube((shift, 0, 0), side), cube(), chosen)
    assert 0.005 < abs(got["iou"] - want) <= got["iou_error"] < 0.2
    finer = shape_iou(cube((shift, 0, 0), side), cube(), replace(chosen, iou_voxels=64))
    assert finer["iou_error"] == pytest.approx(got["iou_error"] / 2, rel=0.1)
