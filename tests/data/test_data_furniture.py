"""The furniture package: from its archives to rendered views, groups, and bad sources."""

import json
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
from helpers.images import bytes_of
from helpers.meshes import render_views
from helpers.refusals import refused
from PIL import Image

from gamba_warp.data.dataset import open_dataset, split_of
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.train.data import furniture
from gamba_warp.train.data.groups import ObjectInfo, split_groups, textures_of, words_of
from gamba_warp.train.sources.commands import data_furniture_command

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PROPERTIES = r"""# a comment = not a value
id=Some#Library
name=Blend Swap CC-BY
id#1=A
name#1=Caf\u00e9 chair 01
category#1=Kitchen
icon#1=/b/cafe.png
model#1=/b/cafe/chair.obj
creator#1=Jay
id#2=B
name#2=Café chair 02
icon#2=/b/other.png
model#2=/b/other/chair.obj
creator#2=Kay
modelRotation#2=1 0 0 0 \
  0 -1 0 1 0
"""


def write_library(path, properties=PROPERTIES, more=()):
    icon = bytes_of(Image.fromarray(np.zeros((8, 8, 4), np.uint8)))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", properties.encode("latin-1"))
        archive.writestr("PluginFurnitureCatalog_fr.properties", "name#1=Chaise")
        archive.writestr("LICENSE.TXT", "free")
        for name in ("cafe", "other"):
            archive.writestr(f"b/{name}.png", icon)
            archive.writestr(f"b/{name}/chair.obj", TRIANGLE)
        for name in more:
            archive.writestr(name, "more")
    return path


def write_deb(folder, files):
    """Write a package of these files by dpkg's own program."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("there is no dpkg-deb")
    package = folder / f"package {len(files)}"
    (package / "DEBIAN").mkdir(parents=True)
    text = "Package: p\nVersion: 1\nArchitecture: all\nMaintainer: m\nDescription: d\n"
    (package / "DEBIAN" / "control").write_text(text)
    place = package / "usr/share/sweethome3d/furniture"
    place.mkdir(parents=True)
    for name, data in files.items():
        (place / name).write_bytes(data)
    deb = folder / f"{len(files)}.deb"
    subprocess.run(["dpkg-deb", "--build", str(package), str(deb)], check=True)
    return deb


def test_package_to_views(tmp_path):
    library = write_library(tmp_path / "BlendSwap-CC-BY.sh3f")
    deb = write_deb(tmp_path, {library.name: library.read_bytes(), "x": b"no"})
    out = tmp_path / "models"
    assert data_furniture_command(out, deb=deb) == 0
    assert {p.name for p in out.iterdir()} == {"BlendSwap-CC-BY", "icons", "catalogue.json"}
    assert (out / "BlendSwap-CC-BY" / "LICENSE.TXT").exists()
    entries = json.loads((out / "catalogue.json").read_text())["objects"]
    assert [e["uid"] for e in entries] == ["blendswap-cc-by-cafe", "blendswap-cc-by-other"]
    assert entries[0]["attribution"]["creator"] == "Jay"
    assert entries[0]["attribution"]["licence"] == "CC BY 3.0"
    for entry in entries:
        assert (out / entry["model"]).exists()
        assert Image.open(out / "icons" / f"{entry['uid']}.png").size == (8, 8)
    meshes = find_meshes(out)
    assert [m.name for m in meshes] == ["Café chair 01", "Café chair 02"]
    assert len({m.group for m in meshes}) == 1  # numbered variants stay together
    assert meshes[0].rotation is None and meshes[1].rotation == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]

    assert render_views(out, tmp_path / "data", views=1, size=16, workers=1) == 0
    assert len(open_dataset(tmp_path / "data", split_of(meshes[0].group))) == 2
    assert data_furniture_command(out, tree=library.parent) == 0  # the other kind of source
    assert json.loads((out / "catalogue.json").read_text())["objects"] == entries


def test_bad_sources(tmp_path, monkeypatch):
    out = tmp_path / "models"
    refused("nowhere.deb: no such file", data_furniture_command, out, deb=tmp_path / "nowhere.deb")
    (tmp_path / "text.deb").write_text("not a package")
    refused("text.deb: cannot be unpacked", data_furniture_command, out, deb=tmp_path / "text.deb")
    deb = write_deb(tmp_path, {"a.sh3f": b"0" * 5000})
    refused("a.sh3f: not a furniture library", data_furniture_command, out, deb=deb)
    refused("contains no .sh3f", data_furniture_command, out, deb=write_deb(tmp_path, {}))
    refused("no such folder", data_furniture_command, out, tree=tmp_path / "nowhere")
    write_library(tmp_path / "b.sh3f", "name=x\nmodel#1=/b/gone/chair.obj\n")
    refused("b.sh3f: not a furniture library", data_furniture_command, out, tree=tmp_path)
    monkeypatch.setattr(furniture, "INSTALLED", tmp_path / "not installed")
    monkeypatch.setattr(furniture.shutil, "which", lambda name: None)
    refused("apt-get is missing.*--deb", data_furniture_command, out)
    assert not (out / "catalogue.json").exists()
    assert not list(out.glob(".download-*"))


def tree_of(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}


@pytest.mark.parametrize("name", ["...sh3f", "icons.sh3f", "catalogue.json.sh3f", ".git.sh3f"])
def test_the_name_of_a_library_removes_nothing(tmp_path, name):
    out = tmp_path / "safe" / "models"
    (out / "icons").mkdir(parents=True)
    for keep in (tmp_path / "safe" / "mine.txt", out / "icons" / "mine.png", out / "notes.txt"):
        keep.write_text("mine")
    before = tree_of(tmp_path / "safe")
    (tmp_path / "tree").mkdir()
    write_library(tmp_path / "tree" / name)
    refused("sh3f: ", data_furniture_command, out, tree=tmp_path / "tree")
    assert tree_of(tmp_path / "safe") == before


def test_what_is_there_stays(tmp_path):
    """A foreign folder, and libraries of an interrupted run."""
    tree, out = tmp_path / "tree", tmp_path / "models"
    tree.mkdir()
    for name in "AB":
        write_library(tree / f"{name}.sh3f")
    (out / "B").mkdir(parents=True)
    (out / "B" / "mine.txt").write_text("mine")
    refused("models/B: is not the library", data_furniture_command, out, tree=tree)
    assert tree_of(out / "B") == {"mine.txt"} and not (out / "catalogue.json").exists()
    (out / "B").rename(tmp_path / "elsewhere")
    made = (out / "A" / "LICENSE.TXT").stat()
    assert data_furniture_command(out, tree=tree) == 0
    assert (out / "A" / "LICENSE.TXT").stat() == made and (out / "B" / "LICENSE.TXT").exists()
    assert len(json.loads((out / "catalogue.json").read_text())["objects"]) == 4


@pytest.mark.parametrize(
    "properties, more, reason",
    [
        (PROPERTIES, ["../x"], "leaves"),
        (PROPERTIES, ["a", "A"], "twice"),
        ("model#1=/../x/chair.obj\nicon#1=/b/cafe.png", [], "leaves"),
        ("model#1=/b/cafe/gone.obj\nicon#1=/b/cafe.png", [], "is missing"),
        ("model#1=/b/cafe/chair.obj\nicon#1=/../b/cafe.png", [], "holds no"),
        ("model#1=\nicon#1=/b/cafe.png", [], "not text"),
        *[
            (f"model#1=b/cafe/chair.obj\nicon#1=b/cafe.png\nmodelRotation#1={turn}", [], "rotation")
            for turn in ("1 2 3", "a b c", "nan " * 9, "0 " * 9, "1e300 " * 9, "1 1 1 " * 3)
        ],
    ],
    ids=range(12),
)
def test_hostile_libraries_leave_nothing_behind(tmp_path, properties, more, reason):
    (tmp_path / "tree").mkdir()
    write_library(tmp_path / "tree" / "A.sh3f", properties, more)
    caught = refused(None, data_furniture_command, tmp_path / "out", tree=tmp_path / "tree")
    assert "A.sh3f: " in caught and reason in caught
    assert tree_of(tmp_path) == {"tree", "tree/A.sh3f", "out"}


def groups(*items):
    """Groups of objects "library/name/textures", as sets of their numbers."""
    named = []
    for number, item in enumerate(items):
        library, name, *textures = item.split("/")
        named.append(ObjectInfo(str(number), library, name, frozenset(textures)))
    found = split_groups(named)
    sides = {name: {uid for uid in found if found[uid] == name} for name in found.values()}
    return sorted("".join(sorted(uids)) for uids in sides.values()), found


def test_words_end_at_the_first_number():
    assert words_of("Concept Sedan 02 red") == ["concept", "sedan"]
    assert words_of("42") == ["42"]


def test_one_kind_of_one_library_is_a_group():
    sides, found = groups("A/Blue sedan 01", "A/Concept Sedan 02", "B/Fast sedan", "A/Van 3")
    assert sides == ["01", "2", "3"]
    assert found == {"0": "A-sedan", "1": "A-sedan", "2": "B-sedan", "3": "A-van"}


def test_kinds_alone_meet_across_libraries():
    assert groups("A/Chair", "B/Chair", "A/Red chair", "B/Bar stool")[0] == ["012", "3"]


def test_names_that_begin_alike_meet_in_one_library():
    names = ("A/Arrow turn right", "A/Arrow turn right and ahead", "B/Arrow turn right and back")
    assert groups(*names, "A/Arrow straight on")[0] == ["01", "2", "3"]
    # One word in common is no twin: "Glass table" and "Glass".
    assert groups("A/Glass", "A/Glass table top")[0] == ["0", "1"]


def test_shared_textures_meet_and_pass_it_on():
    items = ("A/Oak desk/x", "B/Pine bed/x/y", "C/Small crate/y", "C/Wine crate", "D/Lamp/z")
    sides, found = groups(*items)
    assert sides == ["0123", "4"]
    assert found["0"] == "C-crate"  # the most frequent name


def test_textures_are_known_by_their_content(tmp_path):
    for name, content in {"a.jpg": b"wood", "b.png": b"wood", "c d.png": b"steel"}.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "x.mtl").write_text("newmtl m\nmap_Kd -s 1 1 1 a.jpg\n map_d gone.png\n")
    (tmp_path / "y.mtl").write_text("newmtl m\nmap_Kd b.png\nmap_Ka ../../etc/passwd\n")
    (tmp_path / "x.obj").write_text("mtllib x.mtl\nmtllib lost.mtl\nv 0 0 0\n")
    (tmp_path / "y.obj").write_text("mtllib y.mtl\n")
    (tmp_path / "z.stl").write_bytes(b"mtllib y.mtl\n")
    assert textures_of(tmp_path / "x.obj") == textures_of(tmp_path / "y.obj")
    assert len(textures_of(tmp_path / "x.obj")) == 1
    assert not textures_of(tmp_path / "z.stl")
