"""The preset syncdreamer gives the numbers of SyncDreamer's own script, on meshes made here.

The numbers are those of ``get_chamfer_iou`` in eval_mesh.py of SyncDreamer's repository (commit
cc373c8e) with mesh2sdf 1.1.0, run once. Two things were replaced there, for want of a GPU and of
Blender: the CUDA rasterizer by one in numpy, which interpolates depth in the image at the pixels'
centres as that one does, and the depth images of the ground truth by the same rasterizer's. Shapes
are turned, so that no face lies in the lattice's planes, where mesh2sdf's rounding decides.
"""

import numpy as np
import pytest
import trimesh
from helpers.meshes import as_mesh, cube

from gamba_warp.eval.shapes.metrics import compare
from gamba_warp.eval.shapes.occupancy import Grid, parity
from gamba_warp.eval.shapes.protocol import PRESETS

THEIRS = {  # Chamfer distance and Volume IoU
    "ball": (0.0979962, 0.5103978),
    "box": (0.0182917, 0.7400599),
    "torus": (0.0167593, 0.7316778),
    "half": (0.0744072, 0.6546189),
    "both": (0.0595608, 0.3208033),
    "capsule": (0.0383713, 0.6251947),
}
MOVE = trimesh.transformations.translation_matrix


def turn(axis, degrees):
    return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)


ASLANT = turn((1, 2, 3), 25)


def moved(mesh, matrix):
    mesh = mesh.copy()
    mesh.apply_transform(matrix)
    return mesh


def unit(mesh):
    """Centred, with a longest side of 1."""
    low, high = mesh.bounds
    mesh = moved(mesh, MOVE(-(low + high) / 2))
    mesh.apply_scale(1 / (high - low).max())
    return mesh


def pair_of(name):
    make = trimesh.creation
    if name == "ball":
        small = moved(make.icosphere(3, 0.4), MOVE((0.03, -0.02, 0.01)))
        return small, unit(make.icosphere(4, 0.5))
    if name == "box":
        box = moved(make.box((0.9, 0.5, 0.3)), ASLANT)
        return moved(box, turn((0, 0, 1), 12) @ MOVE((0.02, 0.01, 0))), unit(box)
    if name == "torus":
        small = make.torus(0.38, 0.1, major_sections=40, minor_sections=20)
        large = make.torus(0.4, 0.12, major_sections=48, minor_sections=24)
        return moved(small, ASLANT), unit(moved(large, ASLANT))
    if name == "half":  # open
        ball = make.icosphere(4, 0.5)
        half = ball.copy()
        half.update_faces(ball.triangles_center[:, 2] < 0.1)
        half.remove_unreferenced_vertices()
        return half, unit(ball)
    if name == "both":  # two parts that overlap, whose common space is outside by parity
        box = make.box((0.7, 0.3, 0.2), MOVE((0.1, 0, 0.3)))
        both = trimesh.util.concatenate([make.cylinder(0.2, 0.8, sections=24), box])
        both = moved(both, ASLANT)
        return moved(both, MOVE((0, 0.02, -0.03))), unit(both)
    small, large = make.capsule(0.5, 0.2, count=(20, 20)), make.capsule(0.55, 0.22, count=(24, 24))
    return moved(small, turn((1, 0, 0), 20)), unit(large)


@pytest.mark.parametrize("name", THEIRS)
def test_the_numbers_are_those_of_the_public_script(name):
    got = compare(*map(as_mesh, pair_of(name)), PRESETS["syncdreamer"])
    chamfer, iou = THEIRS[name]
    assert abs(got["chamfer"] - chamfer) <= 1e-5 and abs(got["iou"] - iou) <= 1e-5


def test_rays_through_edges_and_corners_meet_one_face():
    """Every line of the grid runs through edges or corners of a box of two triangles a side."""
    grid = Grid(np.full(3, -0.75), 0.25, (7, 7, 7))
    want = np.zeros((7, 7, 7), bool)
    want[2:5, 2:5, 2:5] = True  # the places on its faces are outside
    assert (parity(cube(), grid) == want).all()
    aside = Grid(grid.origin + 0.01, 0.25, (7, 7, 7))
    want[1:5, 1:5, 1:5] = True
    assert (parity(cube(), aside) == want).all()
