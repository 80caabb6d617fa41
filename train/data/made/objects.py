"""Random objects, and files of many."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from manifold3d import Manifold
from PIL import Image

from gamba_warp.batch import progress_bar
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE
from gamba_warp.formats.meshes import TexturedMesh

from .composition import composition
from .creatures import biped, bird, block_figure, crawler, figure, plush, quadruped, snake, swimmer
from .devices import device, instrument, tool
from .house import cushion, furniture, lamp, organiser, rack
from .looks import Maker, finished
from .packages import carton, pouch
from .toys import blocks, game, pieces
from .vehicles import plane, train_of, vehicle
from .vessels import bottle, bowl, food, mug, plant, teapot
from .wear import bag, hat, shoe, wearable

GROUP = "made"  # one group, so that all objects lie in one part of the split: train
ATTRIBUTION = {"creator": "made by gamba data made", "licence": "CC0 1.0", "source": ""}
FREE = 0.37  # share of free compositions
TURNED = 0.12  # share of objects that are turned about y by any angle

Plan = Callable[[Maker], list[Manifold]]
# Relative frequency of each plan.
PLANS: tuple[tuple[Plan, float], ...] = (
    *((quadruped, 4.0), (plush, 4.0), (biped, 2.0), (bird, 1.5), (swimmer, 1.2), (crawler, 1.2)),
    *((snake, 0.5), (figure, 3.5), (block_figure, 1.5)),
    *((mug, 3.0), (teapot, 1.5), (bottle, 5.0), (bowl, 3.0), (plant, 2.5), (food, 2.5)),
    *((carton, 7.0), (pouch, 2.0)),
    *((lamp, 1.2), (furniture, 5.0), (rack, 2.5), (organiser, 1.5), (cushion, 2.0)),
    *((shoe, 8.0), (bag, 3.5), (hat, 1.8), (wearable, 2.0)),
    *((tool, 4.0), (device, 6.0), (instrument, 2.0)),
    *((vehicle, 4.5), (plane, 2.0), (train_of, 2.0)),
    *((blocks, 3.0), (game, 3.5), (pieces, 1.5)),
)
_WEIGHTS = np.cumsum([weight for _, weight in PLANS]) / sum(weight for _, weight in PLANS)


def make_object(rng: np.random.Generator) -> TexturedMesh:
    """Draw one object, closed and with a volume.

    Args:
        rng: random generator; object n of seed s uses ``np.random.default_rng([s, n])``.

    Returns:
        The object, y up, its front along +z, at any size and position, with at most ``MAX_FACES``
        faces.
    """
    while True:
        plan = (
            composition
            if rng.random() < FREE
            else PLANS[int(np.searchsorted(_WEIGHTS, rng.random()))][0]
        )
        made = made_by(plan, rng)
        if made is not None:
            return made


def made_by(plan: Plan, rng: np.random.Generator) -> TexturedMesh | None:
    """Make the object of one plan; None if it is empty or hardly more than a sheet."""
    maker = Maker(rng)
    parts = plan(maker)
    if rng.random() < TURNED:
        angle = float(rng.uniform(0, 360))
        parts = [part.rotate([0, angle, 0]) for part in parts]
    return finished(parts, maker.looks)


def make_files(out: Path, count: int, seed: int) -> None:
    """Write objects as ``.glb`` files, with their ``catalogue.json``.

    Args:
        out: folder for the files; must not have another catalogue.
        count: number of objects.
        seed: seed of all of them.

    Raises:
        UserError: the folder has a catalogue of other objects, or cannot be written.
    """
    out = output_folder(out)
    ours = all(path.name.startswith("made-") for path in out.glob("*.glb"))
    if (out / CATALOGUE).exists() and not ours:
        raise UserError(f"{out / CATALOGUE}: lists other objects; choose another --out")
    entries = []
    for number in progress_bar(range(count), unit="object"):
        uid = f"made-{seed}-{number:05d}"
        entry = {"model": f"{uid}.glb", "uid": uid, "name": uid.replace("-", " ")}
        entries.append({**entry, "group": GROUP, "attribution": ATTRIBUTION})
        if (out / f"{uid}.glb").exists():
            continue
        mesh = make_object(np.random.default_rng([seed, number]))
        with atomic_path(out / f"{uid}.glb") as temporary:
            temporary.write_bytes(_glb(mesh))
    write_json(out / CATALOGUE, {"objects": entries})


def _glb(mesh: TexturedMesh) -> bytes:
    """Encode a mesh as binary glTF, one part per material."""
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    for number in np.unique(mesh.material_ids):
        mine = mesh.material_ids == number
        look = mesh.materials[number]
        corners = mesh.vertices[mesh.faces[mine]].reshape(-1, 3)
        part = trimesh.Trimesh(
            vertices=corners,
            faces=np.arange(len(corners)).reshape(-1, 3),
            vertex_normals=mesh.normals[mine].reshape(-1, 3),
            process=False,
        )
        picture = None if look.texture is None else Image.fromarray(look.texture[..., :3])
        factor = np.rint(255 * look.color).astype(np.uint8)
        surface = PBRMaterial(baseColorTexture=picture, baseColorFactor=factor, metallicFactor=0.0)
        part.visual = TextureVisuals(uv=mesh.uvs[mine].reshape(-1, 2), material=surface)
        scene.add_geometry(part)
    return export_glb(scene)
