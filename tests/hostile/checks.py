"""Checks of the results of readers: every function asserts that a result is valid."""

import dataclasses
import hashlib
import json
import math
import re
from pathlib import Path

import numpy as np

from gamba_warp.errors import MOST_LETTERS

from .second_reader import points_in, vertices_stated

_PIXELS = 64 << 20
_PARAMETERS = 1 << 30
_CODE = re.compile(r"<script>alert|onerror='alert")
_FOLDER = re.compile(r"[a-z0-9][a-z0-9_-]*")


def check_message(problem, folder, names):
    """Check the message of a ``UserError``, or a reason: one line that names a file or an option.

    Args:
        problem: the error, or its message.
        folder: of the case.
        names: files in it; the message must name one of them, the folder or an option.
    """
    text = str(problem)
    assert text.strip(), "the message is empty"
    odd = any(ord(letter) < 32 or ord(letter) == 127 for letter in text)
    assert not odd, "the message has several lines, or control characters"
    assert len(text) <= MOST_LETTERS, f"the message has {len(text)} letters"
    known = [folder.name + "/", *(Path(name).name for name in names), "--", "config", "name"]
    named = str(folder) in text or any(name and name in text for name in known)
    assert named, "the message names no file"


def each(check):
    """Make a check of a list with errors in place of unreadable items."""

    def checked(result, path, out):
        for item in result:
            if isinstance(item, Exception):
                check_message(item, path, [path.name])
            else:
                check(item, path, out)

    return checked


def _finite(**values):
    for name, value in values.items():
        good = value.isfinite() if hasattr(value, "isfinite") else np.isfinite(value)
        assert bool(good.all()), f"{name} not finite"


def _in_unit(name, value):
    inside = bool(((value >= 0) & (value <= 1)).all())  # also false for NaN
    assert inside, f"{name} outside [0, 1]"


def _as_json(what, value, **options):
    try:
        return json.dumps(value, allow_nan=False, **options).encode()
    except (ValueError, TypeError) as problem:
        raise AssertionError(f"{what} that is no JSON ({problem})") from problem


def image(result, path, out):
    """``[H, W, 4]`` float32 in [0, 1]."""
    right = result.ndim == 3 and result.shape[2] == 4 and result.dtype == np.float32
    assert right, f"an image of shape {result.shape} and {result.dtype}"
    assert 0 < result.shape[0] * result.shape[1] <= _PIXELS, f"an image of {result.shape}"
    _in_unit("pixels", result)


def cut_out(result, path, out):
    """A square image of at most 1280 pixels a side."""
    square = result.shape[0] == result.shape[1] <= 1280
    assert square, f"a cut-out of {result.shape}"
    image(result, path, out)


def alpha(result, path, out):
    """``[24, 24]`` in [0, 1], for the image that the reader gives."""
    assert result.shape == (24, 24), f"an alpha of {result.shape}"
    _in_unit("an alpha", result)


def gaussians(result, path, out, lost=0):
    """Finite Gaussians with unit rotations and positive scales, as many as the file has."""
    named = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    tensors = {name: value for name, value in named.items() if value is not None}
    _finite(**tensors)
    assert bool(((result.quats.norm(dim=-1) - 1).abs() < 1e-3).all()), "rotations of no unit length"
    assert bool((result.scales >= 0).all()), "negative scales"
    for name in ("opacities",) if "harmonics" in tensors else ("opacities", "colors"):
        _in_unit(name, tensors[name])
    data, stated = path.read_bytes() if path.is_file() else b"", None
    if data.startswith(b"NGSP") and len(data) >= 12:  # an .spz of version 4
        stated = int.from_bytes(data[8:12], "little")
    # Another kind of file may have a .ply after its own end.
    elif data.startswith(b"ply") and (f := re.search(rb"element\s+vertex\s+(\d+)", data)):
        stated = int(f[1])
    there = result.num + lost
    assert stated in (None, there), f"{there} Gaussians, the file states {stated}"


def thinned(result, path, out):
    """Valid Gaussians, with those left out as many as in the file."""
    kept, lines = result
    said = [re.fullmatch(r"(\d+) of \d+ Gaussians have .*: left out", line) for line in lines]
    assert all(said), f"what is left out is not said: {lines}"
    gaussians(kept, path, out, sum(int(found[1]) for found in said))


def mesh(result, path, out):
    """Finite vertices, and existing faces and materials."""
    arrays = {n: getattr(result, n) for n in ("vertices", "normals", "uvs", "colors")}
    _finite(**arrays)
    _faces(result.faces, len(result.vertices))
    for name in ("normals", "uvs", "colors"):
        assert len(arrays[name]) == len(result.faces), f"{name} do not fit the faces"
    ids = result.material_ids
    there = ids.min() >= 0 and ids.max() < len(result.materials)
    assert there, "a material that is not there"
    for material in result.materials:
        _finite(**{"a material's colour": material.color})
        size = () if material.texture is None else material.texture.shape
        assert max(size, default=0) <= 2048, f"a texture of {size}"
    assert np.abs(result.vertices).max() <= 0.51, "vertices outside the unit cube"
    for text in result.warnings:
        assert len(text) <= 1000 and "\n" not in text, "a warning of several lines"


def _faces(faces, vertices):
    assert faces.ndim == 2 and faces.shape[1] == 3 and len(faces), f"faces of shape {faces.shape}"
    there = faces.min() >= 0 and faces.max() < vertices
    assert there, f"a face names vertex {faces.max()} of {vertices}"


def shape(result, path, out):
    """A valid shape; for a cloud all numbers of the file, according to another reader."""
    if hasattr(result, "opacities"):
        return gaussians(result, path, out)
    data, suffix = path.read_bytes(), path.suffix.lower()
    if hasattr(result, "faces"):
        _finite(vertices=result.vertices)
        count, stated = len(result.vertices), vertices_stated(data, suffix)
        # Vertices without a face are left out.
        assert stated is None or count <= stated, f"{count} vertices, the file states {stated}"
        return _faces(result.faces, count)
    positions = result.positions
    assert positions.ndim == 2 and positions.shape[1] == 3 and len(positions), "no points"
    _finite(points=positions)
    normals = positions if result.normals is None else result.normals
    assert len(normals) == len(positions), "normals do not fit the points"
    wanted = points_in(data, suffix)
    assert not isinstance(wanted, str), f"{len(positions)} points were read, but {wanted}"
    if wanted is not None:
        fits = f"{len(positions)} points, the file has {len(wanted)}"
        assert len(wanted) == len(positions), fits
        assert np.allclose(positions, wanted, 1e-4, 1e-30), "other points than the file's"


def views(result, path, out):
    """Finite, consistent views of objects; errors of one line for others."""
    loaded, reasons = result
    for line in reasons:
        check_message(line, path, [path.name])
    each(_object)(loaded, path, out)


def _object(item, path, out):
    cameras, images = item.cameras, item.images
    values = {"poses": cameras.viewmats, "Ks": cameras.Ks, "images": images}
    _finite(**values)
    for name, value in values.items():
        assert len(value) == len(images), f"{len(value)} {name} of {len(images)} views"
    right = tuple(images.shape[1:]) == (cameras.height, cameras.width, 4)
    assert right, f"images of {tuple(images.shape)}"
    if item.depths is not None:
        _finite(depths=item.depths)
        assert bool((item.depths >= 0).all()), "negative depths"
        assert item.depths.shape == images.shape[:-1], f"depths of {tuple(item.depths.shape)}"
    focal = cameras.Ks[:, [0, 1], [0, 1]]
    assert bool((focal > 0).all()), "focal lengths that are not positive"


def catalogue(result, path, out):
    """Meshes whose uids are names of one folder, with values valid in JSON."""
    for item in result:
        inside = item.uid not in ("", ".", "..") and "/" not in item.uid and "\0" not in item.uid
        assert inside, f"the uid {item.uid[:40]!r} leaves its folder"
        assert len(item.uid.encode("utf-8", "surrogatepass")) <= 255, "an over-long uid"
        values = [item.uid, item.name, item.group, item.attribution]
        _as_json("a name", values, ensure_ascii=False)
        if item.rotation is not None:
            turn = np.asarray(item.rotation, np.float64)
            right = turn.shape == (3, 3) and np.isfinite(turn).all()
            assert right, "a rotation that is no finite matrix"


def model(result, path, out):
    """A model of finite weights."""
    state = result.stored_state()
    _finite(**state)
    count = sum(value.numel() for value in state.values())
    assert count <= _PARAMETERS, f"{count} parameters"


def released(result, path, out):
    """A configuration, and finite weights of its sizes."""
    settings, weights = result
    _finite(**weights)
    config(settings, path, out)


def fingerprint(state):
    """A hash of the state of a run."""
    digest = hashlib.sha256(repr([state.step, state.skipped, state.elapsed]).encode())
    parts = [state.optimizer.state_dict()["state"]]
    parts += [model.state_dict() for model in state.models.values()]
    for name, value in sorted(_flat(parts).items()):
        digest.update(name.encode())
        digest.update(value.detach().numpy().tobytes() if hasattr(value, "detach") else b"")
    return digest.hexdigest()


def _flat(value, name=""):
    """Leaves of nested lists and dictionaries, by their paths."""
    if isinstance(value, (dict, list)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, inner in items for k, v in _flat(inner, f"{name}.{key}").items()}
    return {name: value}


def training(result, path, out):
    """Finite weights, averages and moments, and nonnegative integer counts."""
    for network in (result.model, result.ema.model):
        model(network, path, out)
    moments = _flat(result.optimizer.state_dict()["state"])
    _finite(**{f"moments{k}": v for k, v in moments.items() if hasattr(v, "isfinite")})
    for name in ("step", "skipped", "skipped_in_row"):
        value = getattr(result, name)
        assert type(value) is int and 0 <= value < 2**63, f"{name} is {value!r}"
    elapsed = result.elapsed
    good = isinstance(elapsed, (int, float)) and 0 <= elapsed < math.inf
    assert good, f"elapsed is {elapsed!r}"


def config(result, path, out):
    """Finite numbers, and a network that fits in memory."""
    json.dumps(dataclasses.asdict(result), allow_nan=False)
    inner = result.width * result.expand
    block = inner * (2 * result.width + result.width + 3 * result.state_size + result.step_rank)
    if result.mixer == "attention":
        block = (4 + 2 * result.attention_mlp) * result.width**2
    tokens = result.num_gaussians * result.width + 3 * result.position_bins * result.width
    if result.decoder == "triplane":
        block, tokens = 2 * block, tokens + 3 * result.triplane_size**2 * result.width
    total = result.depth * block + tokens
    assert total <= 64 * _PARAMETERS, f"about {total:.0e} parameters"


def page(result, path, out):
    """A page in which no name became code."""
    assert not _CODE.search(result), "a name became code in a page"


def pages(result, path, out):
    """Pages, the last of which is HTML, in which no name became code."""
    page(result[-1], path, out)


def cameras(result, path, out):
    """Finite cameras with rotations, focal lengths above 0 and images of bounded size."""
    cameras, rate = result.cameras, result.fps
    _finite(poses=cameras.viewmats, Ks=cameras.Ks)
    rotations = cameras.viewmats[:, :3, :3]
    scaled = float((rotations @ rotations.mT - np.eye(3)).abs().max()) > 0.03
    assert not scaled, "a camera that is scaled"
    focal = float(cameras.Ks[:, [0, 1], [0, 1]].min())
    assert focal > 0, "a focal length that is not above 0"
    for side in (cameras.width, cameras.height):
        assert 1 <= side <= 16_384, f"images of {cameras.width}x{cameras.height}"
    assert rate is None or 0 < rate <= 1000, f"{rate} images a second"


def plan(result, path, out):
    """A plan whose folders stay inside the ablation's, and whose words are not other options."""
    found, commands = result
    for row, stages in zip(found.rows, commands):
        assert _FOLDER.fullmatch(row.name), f"the name {row.name[:40]!r} is no folder's"
        for words in stages.values():
            startable = not any("\0" in word for word in words)
            assert startable, "a word with a NUL, with which no process can be started"
            outs = [i for i, word in enumerate(words) if word.startswith("--out")]
            inside = len(outs) == 1 and Path(words[outs[0] + 1]).parent == out
            assert inside, "a command that writes elsewhere"


def faulty(result, path, out):
    """Valid unless the file says otherwise."""
    assert result != "wrong", "it says so"
