"""What a sound result of each reader is; every function returns what is wrong, or None."""

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gamba_warp.errors import MOST_LETTERS

from .second_reader import points_in, vertices_stated

_PIXELS = 64 << 20
_UNPACKED = 256 << 20  # bytes that the small archives of the seeds may become
_PARAMETERS = 1 << 30
_CODE = re.compile(r"<script>alert|onerror='alert")
_FOLDER = re.compile(r"[a-z0-9][a-z0-9_-]*")

Check = Callable[[Any, Path, Path], str | None]


def error(problem: Exception, folder: Path, names: list[str]) -> str | None:
    """Checks the words of a ``UserError``.

    Args:
        problem: the error.
        folder: of the case.
        names: of the files in it; the message names one of them, the folder or an option.
    """
    text = str(problem)
    if not text.strip():
        return "the message is empty"
    if any(ord(letter) < 32 or ord(letter) == 127 for letter in text):
        return "the message has several lines, or control characters"
    if len(text) > MOST_LETTERS:
        return f"the message has {len(text)} letters"
    known = [folder.name + "/", *(Path(name).name for name in names), "--", "config", "name"]
    if str(folder) not in text and not any(name and name in text for name in known):
        return "the message names no file"
    return None


def nothing(result: Any, path: Path, out: Path) -> str | None:
    """Any result is sound."""
    return None


def each(check: Check) -> Check:
    """A check of a list, in which errors stand for what could not be read."""

    def checked(result: Any, path: Path, out: Path) -> str | None:
        for item in result:
            wrong = _told(item, path) if isinstance(item, Exception) else check(item, path, out)
            if wrong:
                return wrong
        return None

    return checked


def _told(problem: Exception | str, path: Path) -> str | None:
    problem = problem if isinstance(problem, Exception) else Exception(problem)
    return error(problem, path, [path.name])


def picture(result: Any, path: Path, out: Path) -> str | None:
    """``[H, W, 4]`` float32 in [0, 1]."""
    if result.ndim != 3 or result.shape[2] != 4 or result.dtype != np.float32:
        return f"a picture of shape {result.shape} and {result.dtype}"
    if not 0 < result.shape[0] * result.shape[1] <= _PIXELS:
        return f"a picture of {result.shape}"
    if not (result.min() >= 0 and result.max() <= 1):  # also false for NaN
        return "pixels outside [0, 1]"
    return None


def cut_out(result: Any, path: Path, out: Path) -> str | None:
    """A square picture of at most 1280 pixels a side."""
    if result.shape[0] != result.shape[1] or result.shape[0] > 1280:
        return f"a cut-out of {result.shape}"
    return picture(result, path, out)


def alpha(result: Any, path: Path, out: Path) -> str | None:
    """``[24, 24]`` in [0, 1], for the picture that the reader gives."""
    if result.shape != (24, 24):
        return f"an alpha of {result.shape}"
    if not (result.min() >= 0 and result.max() <= 1):  # also false for NaN
        return "an alpha outside [0, 1]"
    return None


def gaussians(result: Any, path: Path, out: Path) -> str | None:
    """Finite Gaussians with unit rotations and positive scales, as many as the file has."""
    named = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    tensors = {name: value for name, value in named.items() if value is not None}
    for name, value in tensors.items():
        if not bool(value.isfinite().all()):
            return f"{name} are not finite"
    if not bool(((result.quats.norm(dim=-1) - 1).abs() < 1e-3).all()):
        return "rotations of another length than 1"
    if not bool((result.scales >= 0).all()):
        return "negative scales"
    for name in ("opacities",) if "harmonics" in tensors else ("opacities", "colors"):
        if not bool(((tensors[name] >= 0) & (tensors[name] <= 1)).all()):
            return f"{name} outside [0, 1]"
    stated = _gaussians_stated(path.read_bytes()) if path.is_file() else None
    if stated not in (None, result.num):
        return f"{result.num} Gaussians, the file states {stated}"
    return None


def _gaussians_stated(data: bytes) -> int | None:
    """The number of Gaussians in the header of a .ply or of an .spz of version 4."""
    if data.startswith(b"NGSP") and len(data) >= 12:
        return int.from_bytes(data[8:12], "little")
    # Another kind of file may have a .ply behind its own end.
    found = re.search(rb"element\s+vertex\s+(\d+)", data) if data.startswith(b"ply") else None
    return int(found[1]) if found else None


def mesh(result: Any, path: Path, out: Path) -> str | None:
    """Finite vertices, faces and materials that are there."""
    arrays = {n: getattr(result, n) for n in ("vertices", "normals", "uvs", "colors")}
    for name, value in arrays.items():
        if not np.isfinite(value).all():
            return f"{name} are not finite"
    faces, count = result.faces, len(result.faces)
    wrong = _faces(faces, len(result.vertices))
    if wrong:
        return wrong
    if not all(len(value) == count for name, value in arrays.items() if name != "vertices"):
        return "normals, UVs or colours do not fit the faces"
    if result.material_ids.min() < 0 or result.material_ids.max() >= len(result.materials):
        return "a material that is not there"
    for material in result.materials:
        if not np.isfinite(material.color).all():
            return "a material's colour is not finite"
        if material.texture is not None and max(material.texture.shape) > 2048:
            return f"a texture of {material.texture.shape}"
    if np.abs(result.vertices).max() > 0.51:
        return "vertices outside the unit cube"
    return next((w for line in result.warnings if (w := _line(line))), None)


def _line(text: str) -> str | None:
    """A warning is one line too."""
    return "a warning of several lines" if len(text) > 1000 or "\n" in text else None


def _faces(faces: Any, vertices: int) -> str | None:
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        return f"faces of shape {faces.shape}"
    if faces.min() < 0 or faces.max() >= vertices:
        return f"a face names vertex {faces.max()} of {vertices}"
    return None


def shape(result: Any, path: Path, out: Path) -> str | None:
    """A sound shape; of a cloud every number of the file, read by another reader."""
    if hasattr(result, "opacities"):
        return gaussians(result, path, out)
    if hasattr(result, "faces"):
        if not np.isfinite(result.vertices).all():
            return "vertices are not finite"
        stated = vertices_stated(path.read_bytes(), path.suffix.lower())
        if stated not in (None, len(result.vertices)):
            return f"{len(result.vertices)} vertices, the file states {stated}"
        return _faces(result.faces, len(result.vertices))
    positions = result.positions
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        return f"points of shape {positions.shape}"
    if not np.isfinite(positions).all():
        return "points are not finite"
    if result.normals is not None and len(result.normals) != len(positions):
        return "normals do not fit the points"
    wanted = points_in(path.read_bytes(), path.suffix.lower())
    if isinstance(wanted, str):
        return f"{len(positions)} points were read, but {wanted}"
    if wanted is not None and len(wanted) != len(positions):
        return f"{len(positions)} points, the file has {len(wanted)}"
    if wanted is not None and not np.allclose(positions, wanted, 1e-4, 1e-30):
        return "other points than the file's"
    return None


def report(result: Any, path: Path, out: Path) -> str | None:
    """Records that JSON can hold; failures with one line."""
    for record in result:
        try:
            json.dumps(record, allow_nan=False)
        except (ValueError, TypeError) as problem:
            return f"a record that is no JSON ({problem})"
        if record["status"] != "ok":
            reason = record.get("reason", "")
            if re.match(r"[A-Z]\w+(Error|Exception|Warning)\b", reason):
                return f"a raw exception: {reason[:100]}"
            wrong = _told(reason, path)
            if wrong:
                return wrong
    return None


def views(result: Any, path: Path, out: Path) -> str | None:
    """Finite, fitting views of objects; errors of one line for others."""
    loaded, told = result
    for line in told:
        wrong = _told(line, path)
        if wrong:
            return wrong
    return each(_object)(loaded, path, out)


def _object(item: Any, path: Path, out: Path) -> str | None:
    cameras, count = item.cameras, len(item.images)
    for name, value in (("poses", cameras.viewmats), ("Ks", cameras.Ks), ("images", item.images)):
        if not bool(value.isfinite().all()):
            return f"{name} are not finite"
        if len(value) != count:
            return f"{len(value)} {name} of {count} views"
    if tuple(item.images.shape[1:]) != (cameras.height, cameras.width, 4):
        return f"images of {tuple(item.images.shape)}"
    if item.depths is not None:
        if not bool(item.depths.isfinite().all()) or not bool((item.depths >= 0).all()):
            return "depths are not finite, or negative"
        if item.depths.shape != item.images.shape[:-1]:
            return f"depths of {tuple(item.depths.shape)}"
    if not bool((cameras.Ks[:, 0, 0] > 0).all()) or not bool((cameras.Ks[:, 1, 1] > 0).all()):
        return "focal lengths that are not positive"
    return None


def catalogue(result: Any, path: Path, out: Path) -> str | None:
    """Meshes whose uids are names of one folder, and whose values JSON can hold."""
    for item in result:
        if not item.uid or item.uid in (".", "..") or "/" in item.uid or "\0" in item.uid:
            return f"the uid {item.uid[:40]!r} leaves its folder"
        if len(item.uid.encode("utf-8", "surrogatepass")) > 255:
            return "an over-long uid"
        try:
            values = [item.uid, item.name, item.group, item.attribution]
            json.dumps(values, allow_nan=False, ensure_ascii=False).encode()
        except (ValueError, TypeError) as problem:
            return f"a name that is no JSON ({problem})"
        if item.rotation is not None:
            turn = np.asarray(item.rotation, np.float64)
            if turn.shape != (3, 3) or not np.isfinite(turn).all():
                return "a rotation that is no finite matrix"
    return None


def rendered(result: Any, path: Path, out: Path) -> str | None:
    """Objects that were rendered, or one line."""
    for item in result:
        wrong = _told(item, path) if isinstance(item, Exception) else None
        if wrong:
            return wrong
    for folder in out.iterdir():
        if folder.name.startswith("."):
            return f"{folder.name} is left behind"
        json.loads((folder / "transforms.json").read_bytes(), parse_constant=_no_number)
    return None


def _no_number(text: str) -> None:
    raise AssertionError(f"{text} in a file of ours")


def furniture(result: Any, path: Path, out: Path) -> str | None:
    """Models that are there, inside the folder; nothing beside it is touched."""
    target = out / "inner" / "furniture"
    if sorted(p.name for p in (out / "inner").iterdir()) != ["furniture", "neighbour.txt"]:
        return "something beside the target was made or removed"
    total = 0
    for inside in target.rglob("*"):
        if inside.is_symlink():
            return f"{inside.name} is a link"
        total += inside.lstat().st_size
    if total > _UNPACKED:
        return f"{total >> 20} MB were unpacked"
    entries = json.loads((target / "catalogue.json").read_bytes(), parse_constant=_no_number)
    for entry in entries["objects"]:
        model_file = (target / entry["model"]).resolve()
        if not model_file.is_relative_to(target.resolve()) or not model_file.is_file():
            return f"the model {entry['model'][:60]!r} is not there"
    return None if len(entries["objects"]) == result else "another number of models"


def model(result: Any, path: Path, out: Path) -> str | None:
    """A model of finite weights."""
    count = 0
    for name, value in result.stored_state().items():
        count += value.numel()
        if not bool(value.isfinite().all()):
            return f"{name} is not finite"
    return f"{count} parameters" if count > _PARAMETERS else None


def released(result: Any, path: Path, out: Path) -> str | None:
    """A configuration, and finite weights of its sizes."""
    settings, weights = result
    for name, value in weights.items():
        if not bool(value.isfinite().all()):
            return f"{name} is not finite"
    return config(settings, path, out)


def fingerprint(trainer: Any) -> str:
    """A hash of all that a trainer restores."""
    digest = hashlib.sha256(repr([trainer.step, trainer.skipped, trainer.elapsed]).encode())
    state = [trainer.model.state_dict(), trainer.optimizer.state_dict()["state"]]
    state.append(trainer.ema.model.state_dict() if trainer.ema else {})
    for name, value in sorted(_flat(state).items()):
        digest.update(name.encode())
        digest.update(value.detach().numpy().tobytes() if hasattr(value, "detach") else b"")
    return digest.hexdigest()


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, (dict, list)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, inner in items for k, v in _flat(inner, f"{name}.{key}").items()}
    return {name: value}


def training(result: Any, path: Path, out: Path) -> str | None:
    """Finite weights, averages and moments, and counts that are whole and not negative."""
    for network in (result.model, result.ema.model):
        wrong = model(network, path, out)
        if wrong:
            return wrong
    for name, value in _flat(result.optimizer.state_dict()["state"]).items():
        if hasattr(value, "isfinite") and not bool(value.isfinite().all()):
            return f"the optimizer's {name} is not finite"
    for name in ("step", "skipped", "skipped_in_row"):
        value = getattr(result, name)
        if type(value) is not int or not 0 <= value < 2**63:
            return f"{name} is {value!r}"
    if not (isinstance(result.elapsed, (int, float)) and 0 <= result.elapsed < float("inf")):
        return f"elapsed is {result.elapsed!r}"
    return None


def config(result: Any, path: Path, out: Path) -> str | None:
    """Finite numbers, and a network that fits in memory."""
    values = dataclasses.asdict(result)
    json.dumps(values, allow_nan=False)
    inner = result.width * result.expand
    block = inner * (2 * result.width + result.width + 3 * result.state_size + result.step_rank)
    if result.mixer == "attention":
        block = (4 + 2 * result.attention_mlp) * result.width**2
    tokens = result.num_gaussians * result.width + 3 * result.position_bins * result.width
    if result.decoder == "triplane":
        block, tokens = 2 * block, tokens + 3 * result.triplane_size**2 * result.width
    total = result.depth * block + tokens
    return f"about {total:.0e} parameters" if total > 64 * _PARAMETERS else None


def protocol(result: Any, path: Path, out: Path) -> str | None:
    """A protocol that a report can hold."""
    try:
        json.dumps(result.to_json(), allow_nan=False)
    except ValueError as problem:
        return f"a protocol that no report can hold ({problem})"
    return None


def page(result: Any, path: Path, out: Path) -> str | None:
    """A page in which no name became code."""
    return "a name became code in a page" if _CODE.search(result) else None


def pages(result: Any, path: Path, out: Path) -> str | None:
    """Pages, the last of which is HTML, in which no name became code."""
    return page(result[-1], path, out)


def arrays(result: Any, path: Path, out: Path) -> str | None:
    """Nested containers of arrays of plain numbers."""
    for value in _flat(result).values():
        if isinstance(value, np.ndarray) and value.dtype.hasobject:
            return "an array of objects"
        if callable(value):
            return f"a pickle made {value!r}"
    return None


def cameras(result: Any, path: Path, out: Path) -> str | None:
    """Finite cameras that turn rigidly, with focal lengths above 0 and pictures of bounded size."""
    cameras, rate = result.cameras, result.fps
    rotations = cameras.viewmats[:, :3, :3]
    if not (cameras.viewmats.isfinite().all() and cameras.Ks.isfinite().all()):
        return "cameras that are not finite"
    if float((rotations @ rotations.mT - np.eye(3)).abs().max()) > 0.03:
        return "a camera that is scaled"
    if float(cameras.Ks[:, [0, 1], [0, 1]].min()) <= 0:
        return "a focal length that is not above 0"
    if not (1 <= cameras.width <= 16_384 and 1 <= cameras.height <= 16_384):
        return f"pictures of {cameras.width}x{cameras.height}"
    if rate is not None and not 0 < rate <= 1000:
        return f"{rate} pictures a second"
    return None


def plan(result: Any, path: Path, out: Path) -> str | None:
    """A plan whose folders stay inside the ablation's, and whose words are no other options."""
    found, commands = result
    for row, stages in zip(found.rows, commands):
        if not _FOLDER.fullmatch(row.name):
            return f"the name {row.name[:40]!r} is no folder's"
        for stage in stages:
            if any("\0" in word for word in stage.words):
                return "a word with a NUL, with which no process can be started"
            outs = [i for i, word in enumerate(stage.words) if word.startswith("--out")]
            if len(outs) != 1 or not stage.words[outs[0] + 1].startswith("ROW/"):
                return "a command that writes elsewhere"
    return None


def shown(result: Any, path: Path, out: Path) -> str | None:
    """Pictures in place of true views: colours in [0, 1], and masks of their size or none."""
    rgb, mask = result.shown.rgb, result.shown.alpha
    if not (rgb.isfinite().all() and rgb.min() >= 0 and rgb.max() <= 1):
        return "a colour outside of [0, 1]"
    return "masks of another size" if mask is not None and mask.shape != rgb.shape[:3] else None


def scans(result: Any, path: Path, out: Path) -> str | None:
    """Sound meshes, and nothing of a model in the folder but its own files."""
    for folder in (out / "gso" / "meshes").iterdir():
        if folder.name.startswith("."):
            return f"{folder.name} is left behind"
        strange = [p.name for p in (folder.iterdir() if folder.is_dir() else ()) if p.is_symlink()]
        if strange:
            return f"{strange[0]} is a link"
    return each(mesh)(result, path, out)


def faulty(result: Any, path: Path, out: Path) -> str | None:
    """Sound unless the file says that it is not."""
    return "it says so" if result == "wrong" else None
