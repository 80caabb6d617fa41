"""``gamba render``: images and movies of Gaussians along a camera path."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast

import tyro
from msgspec import Meta

from ..batch import check_not_read, for_each, plan_outputs, progress_bar, warn
from ..conventions import DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..untrusted.ranges import Distance, Elevation, Fov, Rate, ranged
from .results import Results, reported

Kind = Literal["gif", "mp4", "png"]
_SUFFIXES = (".gif", ".mp4", ".png")


@reported
@ranged
def render_command(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    /,
    trajectory: Annotated[str, tyro.conf.arg(metavar="turntable|spiral|FILE")] = "turntable",
    out: Path = Path("out"),
    kind: Kind | None = None,
    size: Annotated[str | None, tyro.conf.arg(metavar="W|WxH")] = None,
    frames: Annotated[int, Meta(ge=1, le=10_000)] | None = None,
    fps: Rate | None = None,
    elevation: Elevation | None = None,
    fov: Fov | None = None,
    distance: Distance | None = None,
    background: str = "white",
    depth: bool = False,
    drop_bad: bool = False,
    device: DeviceChoice = "auto",
) -> Results:
    """Render Gaussians along a camera path to a GIF, a video, or a folder of images.

    A turntable and a spiral go around the object's centre, with -y up as in gamba's files. Cameras
    of a file are in the frame of the Gaussians.

    Args:
        inputs: Gaussians (.ply in the 3DGS layout), or folders of them.
        trajectory: turntable, spiral (two turns, up and down), or a file of cameras: gamba's
            (docs/cameras.md), transforms.json, or nerfstudio's camera path.
        out: Folder for the results; for a single input also a .gif, an .mp4, a .png of one view, or
            - for such a file on the standard output.
        kind: Kind of output; png is a folder of images and a transforms.json. By default
            that of --out, else gif.
        size: Width of the images, or width and height, pixels; by default the file's, else 512.
        frames: Number of images of a turntable (48) or spiral (96).
        fps: Images per second; by default the file's, else 3 seconds per turn.
        elevation: Elevation of a turntable's camera above the object, degrees.
        fov: Field of view of the image's shorter side, degrees; 49.1 by default. Without
            --distance the object keeps its size in the image.
        distance: Distance of the camera from the object's centre, in units of its longest side.
        background: white, black, gray, #rrggbb, or none (transparent, png only).
        depth: Also 16-bit depth maps (png only).
        drop_bad: Leave out invalid Gaussians (a value that is not finite, a rotation of length
            zero), and print their number; without it such a file is refused.
        device: Device that renders; auto is the GPU if there is one.
    """
    from ..formats.read import find_gaussians, read_gaussians
    from ..surfaces.extract import unit_frame
    from ..trajectories.film import Film, parse_background, parse_size, plan_path, shoot
    from ..trajectories.movies import require_movie

    single = out.suffix.lower() in _SUFFIXES and not out.is_dir()
    suffix = out.suffix.lower()[1:]
    if suffix[:1].isalpha() and not single and not out.is_dir():
        raise UserError(f"--out {out}: expected a folder, or a file {', '.join(_SUFFIXES)}")
    if single and kind not in (None, suffix):
        raise UserError(f"--out {out}: its name says {suffix}, but --kind {kind}")
    kind = cast(Kind, suffix) if single else kind or "gif"
    require_movie(kind)
    if single and kind == "png":
        frames = 1 if frames is None and trajectory in ("turntable", "spiral") else frames
    view = {"elevation": elevation, "distance": distance, "fov": fov}
    plan = plan_path(trajectory, None if size is None else parse_size(size), frames, view)
    film = Film(*plan, parse_background(background), depth)
    film.rate = film.rate if fps is None else fps
    if kind != "png" and (film.background is None or depth):
        flag = "--depth" if depth else "--background none"
        raise UserError(f"{flag} needs images: give --kind png")
    files, failures = find_gaussians(inputs)
    if not files:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    chosen = pick_device(device)
    reads = [Path(trajectory)] if film.own else []
    if single:
        count, png = len(film.cameras.viewmats), kind == "png"
        if len(files) != 1:
            raise UserError(f"--out {out}: {len(files)} files are given; give a folder")
        if png and depth:
            raise UserError(f"--out {out}: --depth makes two images of a view; give a folder")
        if png and count != 1:
            raise UserError(f"--out {out}: one image, but there are {count} views; give a folder")
        check_not_read([out], [*files, *reads])
        targets = {str(out): files[0]}
    else:
        suffix = "" if kind == "png" else f".{kind}"
        names = plan_outputs(files, [suffix], out, reads)
        targets = {str(out / (name + suffix)): path for name, path in names.items()}
    output_folder(out.parent if single else out)

    def one(target: str, path: Path) -> None:
        count = len(film.cameras.viewmats)
        left_out: list[str] = []
        gaussians = read_gaussians(path, left_out if drop_bad else None)
        warn(path, left_out)
        with progress_bar(total=count, desc=path.name, unit="view", leave=False) as bar:
            shoot(Path(target), kind, gaussians, unit_frame(gaussians), film, chosen, bar.update)

    for_each(targets, one, "render", "file", failures)
    return Results("file", len(files), out, failures)
