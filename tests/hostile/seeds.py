"""Valid files of all formats: for each reader, files by name of the kind."""

import base64
import functools
import io
import json
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from helpers import micro
from helpers.gaussians import khr_glb, parts_of_spz, some, spz_4
from helpers.images import ADOBE_RGB, bytes_of, colour_profile
from helpers.matting import matting_network
from helpers.released import theirs
from PIL import Image
from plyfile import PlyData, PlyElement

from gamba_warp.ablation.plan import PLANS
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.names import splat_suffix
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.config import PRESETS
from gamba_warp.model.encoders import ImageEncoder
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.batches import open_data
from gamba_warp.train.checkpoint import RunState, Setup
from gamba_warp.train.sources.pack import write_pack

Files = dict[str, bytes]
Kinds = dict[str, Files]
EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\n"
    b"newpath 4 4 moveto 12 4 lineto 12 12 lineto fill\nshowpage\n%%EOF\n"
)
_POSE = [[1.0, 0, 0, 0], [0, 0, -1.0, -1.5], [0, 1.0, 0, 0]]
_SIZE = 8
_OWN = [  # fields of a Gaussian of a .ply beside its colours
    *((name, "<f4") for name in ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2")),
    *((f"rot_{i}", "<f4") for i in range(4)),
]


def as_json(value: Any) -> bytes:
    """The bytes of a JSON document."""
    return json.dumps(value).encode()


def rgba(size: int = 24) -> np.ndarray:
    """``[size, size, 4]`` uint8: a coloured disc on a transparent ground."""
    y, x = np.mgrid[:size, :size]
    far = np.hypot(x - size / 2 + 0.5, y - size / 2 + 0.5) * 2.6 / size
    colour = [8 * x % 256, 8 * y % 256, (x + y) * 5 % 256]
    return np.stack([*colour, np.where(far < 1, 255, 0)], -1).astype(np.uint8)


def png(size: int = _SIZE) -> bytes:
    """A small RGBA image."""
    return bytes_of(Image.fromarray(rgba(size)))


def images() -> Kinds:
    """Single images."""
    cut, grey = Image.fromarray(rgba()), Image.fromarray(rgba()[..., 0])
    on_white = Image.new("RGBA", cut.size, "white")
    on_white.alpha_composite(cut)
    plain, exif = on_white.convert("RGB"), Image.Exif()
    wide = rgba()[..., 0].astype(np.uint16) * 257
    exif[0x0112] = 6
    palette = bytes_of(plain.quantize(16), transparency=0)
    return {
        "png-rgba": {"photo.png": bytes_of(cut)},
        "png-16": {"photo.png": bytes_of(Image.fromarray(wide))},
        "png-16-key": {"photo.png": bytes_of(Image.fromarray(wide), transparency=0)},
        "png-profile": {"photo.png": bytes_of(cut, icc_profile=colour_profile(ADOBE_RGB))},
        "png-palette": {"photo.png": palette},
        "png-grey": {"photo.png": bytes_of(grey)},
        "png-bit": {"photo.png": bytes_of(grey.convert("1"))},
        "jpeg": {"photo.jpg": bytes_of(plain, "JPEG", exif=exif)},
        "jpeg-progressive": {"photo.jpg": bytes_of(plain, "JPEG", progressive=True)},
        "jpeg-cmyk": {"photo.jpg": bytes_of(plain.convert("CMYK"), "JPEG")},
        "jpeg-press": {
            "photo.jpg": bytes_of(plain.convert("CMYK"), "JPEG", icc_profile=colour_profile("CMYK"))
        },
        "webp": {"photo.webp": bytes_of(cut, "WEBP", lossless=True)},
        "webp-lossy": {"photo.webp": bytes_of(cut, "WEBP", quality=70)},
        "gif": {"photo.gif": bytes_of(plain.quantize(16), "GIF")},
        "tiff": {"photo.tif": bytes_of(cut, "TIFF")},
        "tiff-deflate": {"photo.tiff": bytes_of(cut, "TIFF", compression="tiff_deflate")},
        "tiff-float": {"photo.tif": bytes_of(Image.fromarray(wide / np.float32(65535)), "TIFF")},
        "bmp": {"photo.bmp": bytes_of(plain, "BMP")},
        "eps-as-png": {"photo.png": EPS},
    }


def masked_images() -> Kinds:
    """Images with ``mask.png`` beside them; and one that needs no mask."""
    cut = rgba()
    plain = Image.fromarray(np.where(cut[..., 3:] > 0, cut[..., :3], 255).astype(np.uint8))
    mask = bytes_of(Image.fromarray(cut[..., 3]))
    busy = Image.fromarray(np.random.default_rng(0).integers(0, 256, (24, 24, 3), np.uint8))
    return {
        "masked": {"photo.png": bytes_of(busy), "mask.png": mask},
        "masked-jpeg": {"photo.jpg": bytes_of(busy, "JPEG"), "mask.png": mask},
        "plain-ground": {"photo.png": bytes_of(plain)},
        "cut-out": {"photo.png": png(24)},
    }


def gaussians(count: int = 12, kind: Any = "ply", degree: int = 0) -> bytes:
    """A file of Gaussians of one of the formats, with harmonics of a degree."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        made = some(count, degree=degree)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("object" + splat_suffix(kind))
        if kind == "glb":
            return khr_glb(made)
        write_gaussians(path, made, kind)
        return path.read_bytes()


def splats() -> Kinds:
    """Gaussians in every supported format, some with harmonics."""
    harmonics = gaussians(degree=1)
    text = PlyData.read(io.BytesIO(harmonics))
    text.text = True
    seeds = {
        "gaussians": {"object.ply": gaussians()},
        "gaussians-text": {"object.ply": ply_bytes(text)},
        "gaussians-harmonics": {"object.ply": gaussians(degree=3)},
    }
    rows = PlyData.read(io.BytesIO(gaussians()))["vertex"].data
    plain = np.zeros(len(rows), [*_OWN, *((name, "u1") for name in ("red", "green", "blue"))])
    for name, *_ in _OWN:
        plain[name] = rows[name]
    plain["scale_0"][0], plain["opacity"][1:3] = -np.inf, [-np.inf, np.inf]
    lens = np.array([(9.0, 7)], [("focal", "<f4"), ("id", "u1")])
    elements = [PlyElement.describe(lens, "camera"), PlyElement.describe(plain, "vertex")]
    for form, text in (("gaussians-rgb", False), ("gaussians-rgb-text", True)):
        data = PlyData(elements, text, "<", comments=["said before end_header"])
        seeds[form] = {"object.ply": ply_bytes(data)}
    for kind in ("compressed-ply", "splat", "spz", "glb"):
        name = "object." + ("ply" if kind == "compressed-ply" else kind)
        seeds[f"gaussians-{kind}"] = {name: gaussians(300 if "ply" in kind else 12, kind, 1)}
    # Its frames are uncompressed, so that mutations reach the numbers; the extension is the axes.
    axes = struct.pack("<III", 0xADBE0003, 4, 4)
    four = spz_4(*parts_of_spz(gaussians(12, "spz", 1)), extensions=axes)
    return seeds | {"gaussians-spz-4": {"object.spz": four}}


def thinned_splats() -> Kinds:
    """The same, and a file with Gaussians that cannot be drawn."""
    data = PlyData.read(io.BytesIO(gaussians(degree=1)))
    rows = data["vertex"].data
    rows["x"][0], rows["f_rest_3"][1], rows["scale_1"][2] = np.nan, np.inf, 80
    for i in range(4):
        rows[f"rot_{i}"][3] = 0
    return splats() | {"gaussians-nan": {"object.ply": ply_bytes(data)}}


def ply(points: np.ndarray, more: dict, faces: Sequence = (), form: str = "ascii") -> bytes:
    """A ``.ply`` of points ``[V, 3]``, further columns, and faces of any number of corners."""
    columns = {name: points[:, i].astype("<f4") for i, name in enumerate("xyz")} | more
    table = np.rec.fromarrays([*columns.values()], names=[*columns])
    elements = [PlyElement.describe(np.asarray(table), "vertex")]
    if len(faces):
        corners = np.empty(len(faces), [("vertex_indices", object)])
        corners["vertex_indices"] = [np.array(face, "i4") for face in faces]
        types = {"len_types": {"vertex_indices": "u1"}, "val_types": {"vertex_indices": "i4"}}
        elements.append(PlyElement.describe(corners, "face", **types))
    order = ">" if "big" in form else "<"
    return ply_bytes(PlyData(elements, form == "ascii", order, comments=["made here"]))


def ply_bytes(data: PlyData) -> bytes:
    """Encode with ``plyfile``."""
    content = io.BytesIO()
    data.write(content)
    return content.getvalue()


@functools.cache
def meshes() -> Kinds:
    """Meshes with their side files; the first file is the mesh."""
    ball = trimesh.creation.icosphere(0)
    points, faces = ball.vertices.round(4), ball.faces.tolist()
    image = Image.fromarray(rgba(_SIZE))
    material = trimesh.visual.material.SimpleMaterial(image)
    visual = trimesh.visual.TextureVisuals(points[:, :2] / 2 + 0.5, material)
    painted = trimesh.Trimesh(points, faces, visual=visual, process=False)
    text, sides = trimesh.exchange.obj.export_obj(painted, return_texture=True, mtl_name="a.mtl")
    sides["a.mtl"] += b"\nd 1\nmap_d mask.png\n"
    scene = trimesh.Scene(painted)
    tree = trimesh.exchange.gltf.export_gltf(scene)
    sided = {"ball.gltf": tree.pop("model.gltf"), **tree}
    inline = json.loads(sided["ball.gltf"])
    for buffer in inline["buffers"]:
        data = base64.b64encode(tree[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{data}"
    colours = {n: np.full(len(points), 99, "u1") for n in ("red", "green", "blue")}
    mixed = [*faces[:-2], [0, 1, 7, 2]]
    return {
        "obj": {"ball.obj": ball.export(file_type="obj").encode()},
        "obj-textured": {"ball.obj": text.encode(), **sides, "mask.png": png()},
        "glb": {"ball.glb": scene.export(file_type="glb")},
        "gltf-inline": {"ball.gltf": as_json(inline)},
        "gltf-side": sided,
        "ply-ascii": {"ball.ply": ply(points, colours, faces)},
        "ply-binary": {"ball.ply": ply(points, colours, faces, "binary_little_endian")},
        "ply-big": {"ball.ply": ply(points, colours, faces, "binary_big_endian")},
        "ply-mixed": {"ball.ply": ply(points, {}, mixed, "binary_little_endian")},
        "ply-mixed-ascii": {"ball.ply": ply(points, {}, mixed)},
        "stl": {"ball.stl": ball.export(file_type="stl")},
        "stl-ascii": {"ball.stl": ball.export(file_type="stl_ascii").encode()},
        "off": {"ball.off": ball.export(file_type="off").encode()},
    }


def clouds() -> Kinds:
    """Point clouds, one file each."""
    points = np.random.default_rng(2).normal(size=(24, 3)).round(3)
    lines = [" ".join(f"{value:g}" for value in row) for row in points]
    text = "\n".join([*lines, ""]).encode()
    normals = {f"n{name}": points[:, i].astype("<f4") for i, name in enumerate("xyz")}
    return {
        "xyz": {"cloud.xyz": text},
        "ply-cloud": {"cloud.ply": ply(points, normals)},
        "ply-cloud-binary": {"cloud.ply": ply(points, {}, form="binary_little_endian")},
    }


def shapes() -> Kinds:
    """All kinds of shapes, without side files except a .gltf's numbers."""
    made = {**clouds(), **meshes(), **splats()}
    made.pop("gltf-side")
    return {name: dict([next(iter(files.items()))]) for name, files in made.items()}


def cameras() -> Kinds:
    """Two cameras as a file of each format."""
    poses = [np.eye(4), np.eye(4)]
    poses[1][:3, 3] = 0.5, -1.5, 2.0
    path = [{"camera_to_world": p.ravel().tolist(), "fov": 50.0, "aspect": 1.3} for p in poses]
    nerfstudio = {"camera_type": "perspective", "render_height": 6, "render_width": 8}
    nerfstudio |= {"fps": 24, "seconds": 4, "keyframes": [], "camera_path": path}
    made = {"nerfstudio": {"cameras.json": as_json(nerfstudio)}}
    dataset = transforms("chair")["chair/transforms.json"]
    return made | {"transforms": {"transforms.json": dataset}}


def npy(array: np.ndarray) -> bytes:
    """The bytes of a ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def transforms(uid: str, depth: bool = False) -> Files:
    """One object of two views in the layout ``transforms``."""
    frames, files = [], {}
    steps = (np.arange(_SIZE * _SIZE).reshape(_SIZE, _SIZE) * 500).astype(np.uint16)
    for name in ("000.png", "001.png"):
        frame = {"file_path": name, "transform_matrix": [*_POSE, [0, 0, 0, 1.0]]}
        files[f"{uid}/{name}"] = png()
        if depth:
            frame["depth_file_path"] = f"depth_{name}"
            files[f"{uid}/depth_{name}"] = bytes_of(Image.fromarray(steps))
        frames.append(frame)
    values = {"uid": uid, "name": "A chair", "group": uid, "attribution": {"creator": "Jay"}}
    values |= {"w": _SIZE, "h": _SIZE, "fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 4.0}
    values |= {"depth_unit": 1e-4, "frames": frames}
    return {f"{uid}/transforms.json": as_json(values), **files}


def split() -> Kinds:
    """A dataset of two objects, in two parts."""
    parts = {"version": 1, "train": ["chair"], "val": ["stool"], "test": []}
    nested = transforms("chair", depth=True) | transforms("stool")
    return {"transforms": {**nested, "split.json": as_json(parts)}}


def datasets() -> Kinds:
    """Datasets in each layout."""
    angle = {"camera_angle_x": 0.8, "frames": [{"file_path": "./r_0", "transform_matrix": _POSE}]}
    # NeRF's own layout: a file of each part, and names without a suffix
    nerf = {f"{part}/r_{i}.png": png() for part in ("train", "val") for i in range(2)}
    for part in ("train", "val"):
        paths = [f"./{part}/r_{i}" for i in range(2)]
        frames = [{"file_path": path, "rotation": 0.1, "transform_matrix": _POSE} for path in paths]
        nerf[f"transforms_{part}.json"] = as_json({"camera_angle_x": 0.8, "frames": frames})
    masked = transforms("chair")
    values = json.loads(masked["chair/transforms.json"])
    for frame in values["frames"]:
        frame["mask_path"] = f"mask_{frame['file_path']}"
        opaque = Image.fromarray(rgba(_SIZE)[..., :3])
        masked[f"chair/{frame['file_path']}"] = bytes_of(opaque)
        masked[f"chair/{frame['mask_path']}"] = bytes_of(Image.fromarray(rgba(_SIZE)[..., 3]))
    masked["chair/transforms.json"] = as_json(values)
    camera = {"x": [1.0, 0, 0], "y": [0, 0, -1.0], "z": [0, 1.0, 0], "origin": [0, -1.5, 0]}
    camera = as_json(camera | {"x_fov": 0.8, "y_fov": 0.8})
    folder = "chair/campos_512_v4/00000/00000"
    lrm = {"chair/intrinsics.npy": npy(np.array([[9.0, 9], [4, 4], [8, 8]]))}
    lrm |= {f"chair/rgba/{name}.png": png() for name in ("000", "001")}
    lrm |= {f"chair/pose/{name}.npy": npy(np.array(_POSE)) for name in ("000", "001")}
    return split() | {
        "blender": {"transforms.json": as_json(angle), "r_0.png": png()},
        "nerf": nerf,
        "masks": masked,
        "gobjaverse": {f"{folder}.json": camera, f"{folder}.png": png()},
        "openlrm": lrm,
    }


def shards() -> Kinds:
    """Shards of two objects of two views, the first with depth: with the files' bytes, resized."""
    made = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        put(split()["transforms"], folder / "data")
        for kind, size in (("bytes", None), ("resized", _SIZE // 2)):
            write_pack(folder / "data", folder / kind, size)
            files = sorted((folder / kind).iterdir())
            made[kind] = {path.name: path.read_bytes() for path in files if path.is_file()}
    return made


def put(files: Files, folder: Path) -> None:
    """Write files into a folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def catalogues() -> Kinds:
    """A folder of meshes with a catalogue."""
    entry = {"model": "b/ball.obj", "uid": "ball", "name": "Ball", "group": "balls"}
    entry |= {"attribution": {"creator": "Jay", "licence": "CC0"}}
    entry |= {"rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    catalogue = as_json({"objects": [entry]})
    mesh = meshes()["obj"]["ball.obj"]
    return {"catalogue": {"catalogue.json": catalogue, "b/ball.obj": mesh}}


# One block of 8 channels and 16 Gaussians.
_TINY = {"image_size": 8, "patch_size": 4, "width": 8, "depth": 1, "state_size": 2}
_TINY |= {"encoder_size": 8, "position_bins": 3}
TINY_SET = tuple(f"{name}={value}" for name, value in _TINY.items())


def tiny_config():
    """The configuration of the smallest model."""
    return replace(PRESETS["tiny"], **_TINY)


def models() -> Kinds:
    """A checkpoint of the smallest model."""
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_model(path, Gamba(tiny_config()))
        return {"model": {"model.safetensors": path.read_bytes()}}


def released() -> Kinds:
    """The authors' file of weights, at the smallest size, without an image encoder."""
    torch.manual_seed(0)
    config = replace(PRESETS["released"], **_TINY, dt_rank=1, decoder_width=8)
    model = Gamba(config, encoder=ImageEncoder(torch.nn.Identity(), 384, config))
    return {"released": {"released.pth": theirs(model)}}


def new_run(folder: Path) -> tuple[Setup, RunState]:
    """A run on a dataset of one object, written into a folder, before its first step."""
    parts = {"version": 1, "train": ["chair"], "val": [], "test": []}
    put({**transforms("chair"), "split.json": as_json(parts)}, folder / "data")
    views = {"batch_size": 1, "size": 8, "views_per_object": 1}
    config = micro.options(folder / "data", folder / "run", TINY_SET, views=views)
    torch.manual_seed(0)
    setup = Setup(config, open_data(config), micro.ALONE)
    return setup, RunState.begin(Gamba(config.model_config()), setup)


def checkpoints() -> Kinds:
    """A checkpoint of training, whose optimizer has made one step."""
    with tempfile.TemporaryDirectory() as name:
        setup, state = new_run(Path(name))
        for parameter in state.model.parameters():
            parameter.grad = torch.full_like(parameter, 1e-3)
        state.optimizer.step()
        state.step = 1
        state.save(setup)
        folder = next((Path(name) / "run" / "checkpoints").iterdir())
        files = sorted(folder.iterdir(), key=lambda path: path.name != "state.pt")
        return {"checkpoint": {path.name: path.read_bytes() for path in files}}


def plans() -> Kinds:
    """Plans of an ablation: a shipped one, and one with each kind of value."""
    options = {"minutes": 2.5, "lr": 0.1, "radial_mask": False, "extra": ["more"], "ema": None}
    plan = {
        **{"name": "mixed", "title": "Each kind of value", "seeds": [0, 7]},
        "base": {"preset": "tiny", "set": {"norm": "rms"}, "options": options},
        "evaluation": {"split": "val", "objects": 3, "views": 2, "size": 32},
        "rows": [{"name": "a", "paper": {"psnr": 1.5}}],
    }
    shipped = (PLANS / "paper-table2.json").read_bytes()
    return {"shipped": {"plan.json": shipped}, "plan": {"plan.json": as_json(plan)}}


def reports() -> Kinds:
    """Small reports of ``eval-views`` and of ``eval-geometry``."""
    common = {"status": "ok", "seconds": {"predict": 0.5}}
    records = {
        "views": {"truth_sha256": "0f", "views": [0, 1], "psnr": 20.5, "ssim": 0.8},
        "shapes": {"gt_sha256": "1f", "kind": "mesh", "chamfer": 0.05, "iou": 0.4},
    }
    records["views"]["mask_iou"] = None
    rules = {
        "views": {"max_psnr": 100.0, "reference": 0, "source": {"kind": "checkpoint"}},
        "shapes": {"occupancy": "solid", "frame": "gt", "surface": {"voxels": 128}},
    }
    made = {}
    for name, record in records.items():
        objects = [{"name": uid, **common, **record} for uid in ("chair", "a/stool")]
        objects.append({"name": "lamp", "status": "failed", "reason": "no such folder"})
        report = {"protocol": rules[name], "objects": objects, "versions": {"torch": "2"}}
        made[name] = {"report.json": as_json(report)}
    return made


def networks() -> Kinds:
    """A matting network."""
    return {"network": {"matte.onnx": matting_network()}}
