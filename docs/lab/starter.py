"""Makes the starter set in ``starter/``: forty of the furniture models, small enough to ship.

``gamba data furniture --out FURNITURE``, then
``PYTHONPATH=docs python -m lab.starter FURNITURE --out starter``. The same call gives the same
files, but the set in the repository is older, with other cameras. The split is that of the whole
furniture set (by group, see ``gamba_warp.data.dataset``), so held-out objects here are not training
objects there. The repository stores ``data/`` as one file, which ``make setup`` unpacks:
``cd starter; tar --sort=name --mtime=@0 --owner=0 --group=0 -cf data.tar data``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import tyro

from gamba_warp.batch import progress_bar
from gamba_warp.data.dataset import open_dataset, split_of, write_split
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.images import load_rgba
from gamba_warp.train.data.render import render_object
from gamba_warp.train.data.settings import Settings

SETTINGS = Settings()  # the command's own

OBJECTS = """
blendswap-cc-0-barrel blendswap-cc-0-basketball blendswap-cc-0-chairwithcushion
blendswap-cc-0-crate blendswap-cc-0-littleplant blendswap-cc-0-oaktable blendswap-cc-0-rock1
blendswap-cc-0-stonelantern blendswap-cc-0-tablewithtablecloth blendswap-cc-0-umbrella
blendswap-cc-by-bulldog blendswap-cc-by-chest blendswap-cc-by-hamburger blendswap-cc-by-lamp
blendswap-cc-by-plaidchair blendswap-cc-by-siamesecat blendswap-cc-by-toytrain
blendswap-cc-by-tulip reallusion-sitmale03 scopia-birthday_cake scopia-bowlwithfruits
scopia-citybus scopia-dog scopia-fireplace1 scopia-living_lamp scopia-maceta
scopia-rattanarmchair scopia-renault-scenic scopia-shopping-basket scopia-small-oven
scopia-sneakers scopia-table3
blendswap-cc-0-cuckooclock scopia-cat scopia-futon scopia-jacuzzi
blendswap-cc-0-horse2 blendswap-cc-0-teddybear scopia-dog-house scopia-toaster
""".split()

# Single images by another renderer, of objects outside the training split.
ICONS = """
blendswap-cc-0-horse2 blendswap-cc-0-kitchenaid blendswap-cc-0-teddybear
blendswap-cc-by-decorativeplant blendswap-cc-by-fordfocus katorlegaz-fire-hydrant
scopia-bonsai-tree scopia-cardboard-box scopia-dog-house scopia-doll-house scopia-jacuzzi
scopia-toaster
""".split()

INTRO = """# Where the starter set comes from

Everything here is made from models of Sweet Home 3D's furniture libraries. `data/` holds new
renderings. `meshes/` holds the models' triangles without materials, moved to a common frame:
longest side 1, centred, z up. `icons/` holds the libraries' own images, unchanged. Thanks to
everybody named below.

Licences: [CC BY 3.0](https://creativecommons.org/licenses/by/3.0/),
[CC BY 3.0 US](https://creativecommons.org/licenses/by/3.0/us/),
[CC0 1.0](https://creativecommons.org/publicdomain/zero/1.0/).

| object | name | in | creator | licence | source |
| --- | --- | --- | --- | --- | --- |
"""


def starter(furniture: tyro.conf.Positional[Path], out: Path) -> None:
    """Make the starter set from the furniture models.

    Args:
        furniture: output folder of `gamba data furniture`.
        out: the new folder.
    """
    import trimesh

    made = [out / name for name in ("data", "meshes", "icons")]
    if not (out / "ATTRIBUTION.md").is_file():
        for folder in made:
            if folder.exists():
                raise UserError(f"{folder}: was not made by this command; move it away")
    meshes = {mesh.uid: mesh for mesh in find_meshes(furniture)}
    missing = [uid for uid in (*OBJECTS, *ICONS) if uid not in meshes]
    if missing:
        raise UserError(f"{furniture}: has no {missing[0]}")
    groups = {uid: meshes[uid].group for uid in OBJECTS}
    held_out = [uid for uid in OBJECTS if split_of(groups[uid]) != "train"]
    leaked = [uid for uid in ICONS if split_of(meshes[uid].group) == "train"]
    if leaked:
        raise UserError(f"the icon of {leaked[0]} shows a training object")
    output_folder(out)
    rows = []
    for uid in sorted({*OBJECTS, *ICONS}):
        mesh, folders = meshes[uid], ["icons"] if uid in ICONS else []
        if uid in OBJECTS:
            part = split_of(mesh.group)
            folders = [f"data ({part})", *(["meshes"] if part != "train" else []), *folders]
        known = (mesh.attribution[name] for name in ("creator", "licence", "source"))
        rows.append("| " + " | ".join([f"`{uid}`", mesh.name, ", ".join(folders), *known]) + " |")
    with atomic_path(out / "ATTRIBUTION.md") as temporary:
        temporary.write_text(INTRO + "\n".join(rows) + "\n", encoding="utf-8")
    for folder in made:
        shutil.rmtree(folder, ignore_errors=True)
        output_folder(folder)
    for uid in progress_bar(OBJECTS, unit="object"):
        render_object(meshes[uid], out / "data", SETTINGS)
    write_split(out / "data", groups)
    views = open_dataset(out / "data")
    for uid in held_out:
        model, placement = load_mesh(meshes[uid].path), views.files(uid).placement
        assert placement is not None  # it was rendered above
        vertices = placement.points(model.vertices)  # in the world of its views
        bare = trimesh.Trimesh(vertices, model.faces, process=True)  # merges equal vertices
        with atomic_path(out / "meshes" / f"{uid}.ply") as temporary:
            bare.export(temporary, vertex_normal=False)
    for uid in ICONS:
        source = furniture / "icons" / f"{uid}.png"
        if load_rgba(source)[..., 3].min() > 0:
            raise UserError(f"{source}: has no transparent background")
        shutil.copyfile(source, out / "icons" / source.name)


if __name__ == "__main__":
    try:
        tyro.cli(starter)
    except UserError as error:
        sys.exit(f"gamba: {error}")
