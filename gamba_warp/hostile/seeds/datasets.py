"""Sound datasets in each layout, folders of meshes, and archives."""

from __future__ import annotations

import gzip
import io
import json
import tarfile
import zipfile
import zlib

import numpy as np

from ...data.gso import NAMES
from .pictures import Files, depth_png, png
from .shapes import meshes

_POSE = [[1.0, 0, 0, 0], [0, 0, -1.0, -1.5], [0, 1.0, 0, 0]]
_SIZE = 8
_DATE = (2020, 1, 1, 0, 0, 0)
PROPERTIES = r"""id=Some#Library
name=Blend Swap CC-BY
license=CC0
id#1=A
name#1=Caf\u00e9 chair 01
category#1=Kitchen
icon#1=/b/chair.png
model#1=/b/chair/chair.obj
creator#1=Jay
id#2=B
name#2=Stool 02
icon#2=/b/stool.png
model#2=/b/stool/stool.obj
creator#2=Kay
modelRotation#2=1 0 0 0 0 -1 0 1 0
"""
_TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def npy(array: np.ndarray) -> bytes:
    """The bytes of a ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def transforms(uid: str, depth: bool = False) -> Files:
    """One object of two views in the layout ``transforms``."""
    frames, files = [], {}
    for name in ("000.png", "001.png"):
        frame = {"file_path": name, "transform_matrix": [*_POSE, [0, 0, 0, 1.0]]}
        files[f"{uid}/{name}"] = png(_SIZE)
        if depth:
            frame["depth_file_path"] = f"depth_{name}"
            files[f"{uid}/depth_{name}"] = depth_png(_SIZE)
        frames.append(frame)
    values = {"uid": uid, "name": "A chair", "group": uid, "attribution": {"creator": "Jay"}}
    values |= {"w": _SIZE, "h": _SIZE, "fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 4.0}
    values |= {"depth_unit": 1e-4, "frames": frames}
    return {f"{uid}/transforms.json": json.dumps(values).encode(), **files}


def shown() -> dict[str, Files]:
    """True views of an object beside what a method shows: by name, and with cameras of its own."""
    true = transforms("chair")
    named = {name: content for name, content in true.items() if name.endswith(".png")}
    with_cameras = {name: content for name, content in true.items() if "000" not in name}
    cameras = json.loads(true["chair/transforms.json"])
    cameras["frames"] = cameras["frames"][1:]
    with_cameras["chair/transforms.json"] = json.dumps(cameras).encode()
    data = {f"data/{name}": content for name, content in true.items()}
    return {
        kind: data | {f"seen/{name}": content for name, content in files.items()}
        for kind, files in (("by-name", named), ("by-camera", with_cameras))
    }


def datasets() -> dict[str, Files]:
    """Datasets by name of the layout."""
    split = {"version": 1, "train": ["chair"], "val": ["stool"], "test": []}
    nested = transforms("chair", depth=True) | transforms("stool")
    angle = {"camera_angle_x": 0.8, "frames": [{"file_path": "./r_0", "transform_matrix": _POSE}]}
    camera = {"x": [1.0, 0, 0], "y": [0, 0, -1.0], "z": [0, 1.0, 0], "origin": [0, -1.5, 0]}
    folder = "chair/campos_512_v4/00000/00000"
    lrm = {f"chair/rgba/{name}.png": png(_SIZE) for name in ("000", "001")}
    lrm |= {f"chair/pose/{name}.npy": npy(np.array(_POSE)) for name in ("000", "001")}
    return {
        "transforms": {**nested, "split.json": json.dumps(split).encode()},
        "blender": {"transforms.json": json.dumps(angle).encode(), "r_0.png": png(_SIZE)},
        "gobjaverse": {
            f"{folder}.json": json.dumps(camera | {"x_fov": 0.8, "y_fov": 0.8}).encode(),
            f"{folder}.png": png(_SIZE),
        },
        "openlrm": {"chair/intrinsics.npy": npy(np.array([[9.0, 9], [4, 4], [8, 8]])), **lrm},
    }


def packs() -> dict[str, Files]:
    """A pack of two objects of two views, the first with depth; and one whose shard is a tar."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, _SIZE, _SIZE, 4), np.uint8)
    depths = rng.integers(0, 9000, (2, _SIZE, _SIZE)).astype("<u2")
    K = [9.0, 0, 4, 0, 9, 4, 0, 0, 1]
    pose = [*np.ravel(_POSE), 0, 0, 0, 1]
    sums = [[zlib.crc32(p.tobytes()) for p in pair] for pair in zip(images, depths)]
    rows = [[*pose, *K, *pair, 0] for pair in sums]
    cameras = np.array(rows, "<f8")
    shard = cameras.tobytes() + images.tobytes() + depths.tobytes()
    values = {"shard": "shard-00000.bin", "views": 2, "width": _SIZE, "height": _SIZE}
    values |= {"crc": zlib.crc32(cameras.tobytes()), "cameras": 0, "images": cameras.nbytes}
    values |= {"name": "A chair", "attribution": {"creator": "Jay"}, "depth_unit": 1e-4}
    chair = {"uid": "chair", "split": "train", "depths": cameras.nbytes + images.nbytes}
    stool = {"uid": "b/stool", "split": "val"}
    index = {"format": "gamba-pack", "version": 1, "finished": True, "size": _SIZE}
    index["objects"] = [values | chair, values | stool]
    tar = tarred({"00000000.cameras.npy": npy(cameras), "00000000.images.npy": npy(images)}, "")
    starts = {"cameras": tar.index(cameras.tobytes()), "images": tar.index(images.tobytes())}
    packed = index | {"objects": [values | stool | starts | {"shard": "shard-00000.tar"}]}
    return {
        "arrays": {"pack.json": json.dumps(index).encode(), "shard-00000.bin": shard},
        "webdataset": {"pack.json": json.dumps(packed).encode(), "shard-00000.tar": tar},
    }


def mesh_folders() -> dict[str, Files]:
    """Folders of meshes with a catalogue."""
    obj = meshes()["obj"]["ball.obj"]
    attribution = {"creator": "Jay", "licence": "CC0"}
    entry = {"model": "b/ball.obj", "uid": "ball", "name": "Ball", "group": "balls"}
    entry |= {"attribution": attribution, "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    catalogue = json.dumps({"objects": [entry]}).encode()
    return {"catalogue": {"catalogue.json": catalogue, "b/ball.obj": obj}}


def gobjaverse() -> dict[str, Files]:
    """Copies of G-Objaverse: a folder and a tar, with lists; and what the set's script leaves."""
    view = {f"00000{end}": data for end, data in _published_view().items()}
    tar = tarred({f"10011/campos_512_v4/00000/{n}": data for n, data in view.items()}, "")
    index = {"0/10010": "000-000/aaaa.glb", "0/10011": "000-001/bbbb.glb"}
    quality = [{"object_index": "aaaa.glb", "label": "Food"}, {"object_index": "bbbb.glb"}]
    lists = {
        "index.json": json.dumps(index).encode(),
        "quality.json": json.dumps(quality).encode(),
        "list.json.gz": gzip.compress(json.dumps({"ball": ["aaaa", "bbbb"]}).encode(), mtime=0),
    }
    folder = {f"0/10010/campos_512_v4/00000/{name}": data for name, data in view.items()}
    return {
        "lists": {"0/10011.tar": tar, **folder, **lists},
        "script": {
            **{f"0/10010/00000/{name}": data for name, data in view.items()},
            "list.txt": b"0/10010\n",
        },
    }


def _published_view() -> Files:
    """The files of a view of G-Objaverse, by their ends."""
    camera = {"x": [1.0, 0, 0], "y": [0, 0, -1.0], "z": [0, 1.0, 0], "origin": [0, -1.5, 0]}
    camera |= {"x_fov": 0.691, "y_fov": 0.691, "max_depth": 5.0, "bbox": [[-0.5] * 3, [0.5] * 3]}
    return {".json": json.dumps(camera).encode(), ".png": png(_SIZE), "_nd.exr": b"not read"}


def scanned() -> dict[str, Files]:
    """Copies of Google Scanned Objects, as a folder and as a zip of one model."""
    ball = meshes()["obj"]["ball.obj"]
    text = b'name: "A"\nauthors {\n  name: "Google"\n}\nlegal {\n  license: "CC BY 4.0"\n}\n'
    files = {
        "meshes/model.obj": b"mtllib model.mtl\nusemtl material_0\n" + ball,
        "meshes/model.mtl": b"newmtl material_0\nmap_Kd texture.png\nKd 1.0 1.0 1.0\n",
        "materials/textures/texture.png": png(_SIZE),
        "metadata.pbtxt": text,
        "thumbnails/0.jpg": b"a picture",
    }
    first, second = NAMES[:2]
    folder = {f"{first}/{name}": data for name, data in files.items()}
    return {"folder": folder, "zip": {f"{second}.zip": zipped(files)}}


def zipped(members: Files, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip archive."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), data, method)
    return content.getvalue()


def tarred(members: Files, form: str = "xz") -> bytes:
    """A tar archive, packed by "xz" or "gz", or not at all."""
    content = io.BytesIO()
    mode = f"w:{form}" if form else "w"
    with tarfile.open(fileobj=content, mode=mode) as tar:  # pyright: ignore
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return content.getvalue()


def ar(members: Files) -> bytes:
    """An ar archive, as dpkg makes it."""
    parts = [b"!<arch>\n"]
    for name, data in members.items():
        parts.append(f"{name:<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(data):<10}`\n".encode())
        parts.append(data + b"\n" * (len(data) % 2))
    return b"".join(parts)


def library_members() -> Files:
    """What is in a furniture library."""
    icon = png(8)
    return {
        "PluginFurnitureCatalog.properties": PROPERTIES.encode(),
        "LICENSE.TXT": b"free",
        "b/chair.png": icon,
        "b/chair/chair.obj": _TRIANGLE,
        "b/stool.png": icon,
        "b/stool/stool.obj": _TRIANGLE,
    }


def furniture() -> dict[str, Files]:
    """Furniture as a folder of libraries, and as Debian's package."""
    library = zipped(library_members())
    inner = tarred({"./usr/share/sweethome3d/furniture/Some.sh3f": library})
    package = {"debian-binary": b"2.0\n", "control.tar.xz": b"x", "data.tar.xz": inner}
    return {
        "libraries": {"Some.sh3f": library},
        "package": {"furniture.deb": ar(package)},
    }
