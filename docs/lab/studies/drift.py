"""Drift of the rules of occupancy on damaged known shapes.

``make study WHAT=drift`` prints the table of ``eval/README.md``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np

from gamba_warp.batch import progress_bar
from gamba_warp.eval.shapes.flags import clean_mesh
from gamba_warp.eval.shapes.metrics import volume_iou
from gamba_warp.eval.shapes.occupancy import RULES, enclosed, grid_around
from gamba_warp.eval.shapes.shape import Mesh

if TYPE_CHECKING:
    from trimesh import Trimesh

HOLES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5)  # shares of the area


def known_shapes() -> dict[str, Mesh]:
    """Closed meshes of fine triangles by name; the longest side is 1 or a little less."""
    from trimesh import creation, util

    def mesh(*sources) -> Mesh:
        joined = cast("Trimesh", util.concatenate(list(sources)))
        return Mesh(np.array(joined.vertices), np.array(joined.faces))

    box = creation.box()
    for _ in range(4):
        box = box.subdivide()
    cavity = creation.icosphere(4, 0.4)
    cavity.invert()
    left, right = creation.icosphere(4, 0.35), creation.icosphere(4, 0.35)
    left.apply_translation([-0.15, 0, 0])
    right.apply_translation([0.15, 0, 0])
    return {
        "ball": mesh(creation.icosphere(4, 0.5)),
        "cube": mesh(box),
        "torus": mesh(creation.torus(0.35, 0.15, major_sections=64, minor_sections=32)),
        "shell": mesh(creation.icosphere(4, 0.5), cavity),
        "two balls": mesh(left, right),
    }


def with_hole(mesh: Mesh, share: float, seed: int) -> Mesh:
    """Cut out the faces nearest to a random point of the surface, up to ``share`` of the area."""
    area = np.linalg.norm(mesh.normals(), axis=1)
    middle = mesh.corners().mean(1)
    at = np.random.default_rng(seed).choice(len(middle), p=area / area.sum())
    order = np.argsort(((middle - middle[at]) ** 2).sum(1), kind="stable")
    kept = np.cumsum(area[order]) > share * area.sum() * (1 + 1e-9)
    return Mesh(mesh.vertices, mesh.faces[np.sort(order[kept])])


def with_flips(mesh: Mesh, share: float, seed: int) -> Mesh:
    """Turn over about ``share`` of the faces, drawn at random."""
    faces = mesh.faces.copy()
    chosen = np.random.default_rng(seed).random(len(faces)) < share
    faces[chosen] = faces[chosen][:, ::-1]
    return Mesh(mesh.vertices, faces)


def doubled(mesh: Mesh) -> Mesh:
    """Add every face again with the other orientation, as in files for culling renderers."""
    return Mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))


DAMAGES: dict[str, Callable[[Mesh, int], Mesh]] = {
    "no hole, half of the faces turned over": lambda mesh, seed: with_flips(mesh, 0.5, seed),
    "hole 5 %, a tenth turned over": lambda mesh, seed: with_flips(
        with_hole(mesh, 0.05, seed), 0.1, seed
    ),
    "hole 5 %, half turned over": lambda mesh, seed: with_flips(
        with_hole(mesh, 0.05, seed), 0.5, seed
    ),
    "hole 5 %, every face doubled": lambda mesh, seed: doubled(with_hole(mesh, 0.05, seed)),
}


def drift(mesh: Mesh, damage: Callable[[Mesh, int], Mesh], voxels: int, seeds: int) -> dict:
    """Mean IoU, over seeds, of the damaged mesh's occupancy with that of the closed original.

    Args:
        mesh: a closed one; its true occupancy is what it encloses, cavities included.
        damage: a function of the mesh and a seed, which returns the damaged mesh.
        voxels: number of voxels in a unit of length.
        seeds: number of damaged meshes, at least one.

    Returns:
        ``{rule: iou}`` for all ``RULES``.
    """
    grid = grid_around(mesh, resolution=voxels)
    truth = enclosed(mesh, grid)
    values: dict[str, list[float]] = {name: [] for name in RULES}
    for seed in range(seeds):
        broken = clean_mesh(damage(mesh, seed)).mesh
        for name, rule in RULES.items():
            values[name].append(volume_iou(rule.fill(broken, grid), truth) or 0.0)
    return {name: float(np.mean(some)) for name, some in values.items()}


def main(voxels: int = 32, seeds: int = 3) -> None:
    """Print the table as Markdown.

    Args:
        voxels: Number of voxels in a unit of length.
        seeds: Number of places of the hole for each row.
    """
    print(f"| shape | damage | {' | '.join(RULES)} |\n| --- | --- |{' --- |' * len(RULES)}")
    damages = {
        f"hole {100 * share:g} %": lambda mesh, seed, share=share: with_hole(mesh, share, seed)
        for share in HOLES
    }
    for name, mesh in known_shapes().items():
        for damage, function in progress_bar({**damages, **DAMAGES}.items(), desc=name):
            values = drift(mesh, function, voxels, seeds)
            print(f"| {name} | {damage} | {' | '.join(f'{v:.3f}' for v in values.values())} |")
