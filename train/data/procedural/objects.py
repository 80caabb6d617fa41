"""Random objects, and files of many."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gamba_warp.batch import progress_bar
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE
from gamba_warp.formats.meshes import TexturedMesh

from .composition import composition
from .looks import Maker, finished

GROUP = "procedural"  # one group, so that all objects are in one part of the split: train
ATTRIBUTION = {"creator": "gamba data procedural", "licence": "CC0 1.0", "source": ""}
TURNED = 0.12  # fraction of objects that are turned about y by any angle


def make_object(rng: np.random.Generator) -> TexturedMesh:
    """Draw one object, closed and with a volume.

    Args:
        rng: random generator; object n of seed s uses ``np.random.default_rng([s, n])``.

    Returns:
        The object, y up, its front along +z, at any size and position, with at most ``MAX_FACES``
        faces.
    """
    while True:
        maker = Maker(rng)
        parts = composition(maker)
        if rng.random() < TURNED:
            angle = float(rng.uniform(0, 360))
            parts = [part.rotate([0, angle, 0]) for part in parts]
        mesh = finished(parts, maker.looks)
        if mesh is not None:  # else it is empty or hardly more than a sheet
            return mesh


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
    ours = all(path.name.startswith("procedural-") for path in out.glob("*.glb"))
    if (out / CATALOGUE).exists() and not ours:
        raise UserError(f"{out / CATALOGUE}: lists other objects; choose another --out")
    entries = []
    for number in progress_bar(range(count), unit="object"):
        uid = f"procedural-{seed}-{number:05d}"
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
        selected = mesh.material_ids == number
        look = mesh.materials[number]
        corners = mesh.vertices[mesh.faces[selected]].reshape(-1, 3)
        part = trimesh.Trimesh(
            vertices=corners,
            faces=np.arange(len(corners)).reshape(-1, 3),
            vertex_normals=mesh.normals[selected].reshape(-1, 3),
            process=False,
        )
        image = None if look.texture is None else Image.fromarray(look.texture[..., :3])
        factor = np.rint(255 * look.color).astype(np.uint8)
        surface = PBRMaterial(baseColorTexture=image, baseColorFactor=factor, metallicFactor=0.0)
        part.visual = TextureVisuals(uv=mesh.uvs[selected].reshape(-1, 2), material=surface)
        scene.add_geometry(part)
    return export_glb(scene)
