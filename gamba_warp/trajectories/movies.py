"""Images along a camera path, and their files: GIF, MP4, folders of PNG."""

from __future__ import annotations

import itertools
import re
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ..cameras import Cameras
from ..conventions import GREY
from ..errors import UserError
from ..files import atomic_folder, atomic_path
from ..gaussians import Gaussians
from ..images import to_uint8
from ..render import render
from ..versions import require
from .files import save_path
from .paths import FRONT, Viewpoint, turntable

SECONDS = 3.0  # of one turn of a turntable
CAMERAS = "transforms.json"  # in a folder of images
_CHUNK_PIXELS = 1 << 20  # pixels rendered in one launch, which takes a few hundred MB
_CHUNK_GAUSSIANS = 1 << 22  # Gaussians projected in one launch, over all of its views
_GIF_BYTES = 512 << 20  # Pillow holds all frames of a GIF, one byte per pixel
_PALETTE_PIXELS = 1 << 15  # sample for a palette of 255 colours
_OURS = re.compile(rf"\d{{4,}}(-depth)?\.png|{re.escape(CAMERAS)}")
_DEPTH_STEPS = 65_535


@torch.inference_mode()
def render_path(
    gaussians: Gaussians,
    cameras: Cameras,
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0),
    depth: bool = False,
    **options,
) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Render along a path, several views per launch, and yield the images one by one.

    Args:
        gaussians: one object without batch dimension, on the device that renders.
        cameras: ``[V]``.
        background: RGB in [0, 1]; None makes RGBA images with straight alpha.
        depth: render the expected depth too.
        options: further arguments of ``rasterization``.

    Yields:
        For each view the image ``[H, W, 3|4]`` uint8, and the depth ``[H, W]`` float32 along the
        camera's axis, 0 on the background, or None.
    """
    cameras = cameras.to(gaussians.means.device, torch.float32)
    color = None if background is None else gaussians.means.new_tensor(background)
    pixels = _CHUNK_PIXELS // (cameras.width * cameras.height)
    chunk = max(1, min(pixels, _CHUNK_GAUSSIANS // max(1, gaussians.num)))
    for start in range(0, len(cameras.viewmats), chunk):
        seen = render(gaussians, cameras[start : start + chunk], color, depth, **options)
        rgb = seen.rgb
        if background is None:
            rgb = torch.cat([rgb / seen.alpha.clamp_min(1e-6), seen.alpha], -1)
        depths = None
        if seen.depth is not None:
            depths = torch.where(seen.alpha > 0.5, seen.depth, 0.0)[..., 0].cpu().numpy()
        for number, image in enumerate(rgb.cpu().numpy()):
            yield to_uint8(image), None if depths is None else depths[number]


def require_movie(kind: str) -> None:
    """Refuse ``mp4`` without its library, before any view is rendered.

    Raises:
        ModuleNotFoundError: as ``versions.require``.
    """
    if kind == "mp4":
        require("imageio_ffmpeg")


def save_movie(
    path: str | Path,
    frames: Iterable[np.ndarray],
    rate: float,
    sample: np.ndarray,
    background: tuple[int, int, int] = (255, 255, 255),
) -> None:
    """Write frames as an endless ``.gif`` or an ``.mp4`` (H.264), by the suffix, atomically.

    Args:
        path: ends in ``.gif`` or ``.mp4``.
        frames: each ``[H, W, 3]`` uint8; for MP4 the last row or column is repeated if their number
            is odd, since H.264 needs even sizes.
        rate: frames per second.
        sample: ``[K, H, W, 3]`` some of the frames, for the palette of a GIF.
        background: RGB that a GIF keeps exactly.

    Raises:
        UserError: another suffix, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise UserError(f"{path}: a turntable is written as a .gif or an .mp4")
    with atomic_path(path) as temporary:
        if suffix == ".gif":
            _write_gif(temporary, frames, rate, sample, background)
        else:
            _write_mp4(temporary, frames, rate)


def check_gif(width: int, height: int, frames: int) -> None:
    """Refuse a GIF that would take too much memory, before anything is rendered.

    Raises:
        UserError: it would; the message names alternatives.
    """
    if width * height * frames > _GIF_BYTES:
        raise UserError(
            f"{frames} frames of {width}x{height} are too many for a .gif; write an .mp4 or "
            "images (--kind png), or give a smaller --size"
        )


def _write_gif(
    path: Path,
    frames: Iterable[np.ndarray],
    rate: float,
    sample: np.ndarray,
    background: tuple[int, int, int],
) -> None:
    palette = _palette(sample, background)

    def images() -> Iterator[Image.Image]:
        for frame in frames:
            image = Image.fromarray(frame).quantize(palette=palette)  # dithered
            # Pillow's colour lookup is coarse, so that white may become a similar colour.
            red, green, blue = (frame[..., i] == background[i] for i in range(3))
            image.paste(0, mask=Image.fromarray(red & green & blue))
            yield image

    remaining = images()
    # GIF counts time in units of 10 ms, and viewers slow down frames under 20 ms.
    duration = max(20, round(100 / rate) * 10)
    next(remaining).save(path, save_all=True, append_images=remaining, duration=duration, loop=0)


def _palette(frames: np.ndarray, background: tuple[int, int, int]) -> Image.Image:
    """Return one palette for all frames, of the background and 255 others, against flicker."""
    pixels = frames.reshape(-1, 3)
    pixels = pixels[(pixels != background).any(1)]
    pixels = pixels[:: 1 + len(pixels) // _PALETTE_PIXELS]
    if len(pixels) == 0:
        pixels = frames.reshape(-1, 3)[:1]
    colours = Image.fromarray(pixels[None]).quantize(255, kmeans=1).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*background, *colours[: 3 * 255]])
    return palette


def _write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    import imageio_ffmpeg

    remaining = iter(frames)
    first = next(remaining)
    height, width = first.shape[:2]
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    size = f"{width + width % 2}x{height + height % 2}"
    # imageio's own writer ignores ffmpeg's exit code, and so a full disk.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", size, "-r", f"{rate:.6f}", "-i", "-", "-an"]
    command += ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "10"]
    command += ["-movflags", "+faststart", f"file:{path}"]
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages)
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # it ended early; the exit code is checked below
                for frame in itertools.chain([first], remaining):
                    process.stdin.write(np.pad(frame, odd, mode="edge").tobytes())
            with suppress(BrokenPipeError):
                process.stdin.close()
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        if code:
            messages.seek(0)
            lines = messages.read().decode(errors="replace").strip().splitlines()
            raise OSError(f"ffmpeg ended with code {code} ({lines[0] if lines else ''})")


def check_folder(path: Path) -> None:
    """Refuse a folder with other files than ours, because it would be replaced.

    Raises:
        UserError: it has other files, or is not a folder.
    """
    if not path.exists():
        return
    if not path.is_dir():
        raise UserError(f"{path}: is a file; images go into a folder")
    other = next((p.name for p in path.iterdir() if not _OURS.fullmatch(p.name)), None)
    if other is not None:
        raise UserError(f"{path}: holds other files ({other}); give another --out")


def save_images(
    folder: Path,
    views: Iterable[tuple[np.ndarray, np.ndarray | None]],
    cameras: Cameras,
    rate: float,
) -> None:
    """Write a folder of ``0000.png`` and so on with ``transforms.json``, atomically.

    Depth becomes a 16-bit ``0000-depth.png``, 0 where unknown; the length of a step is the frame's
    ``depth_unit``.

    Args:
        folder: replaced if it exists; see ``check_folder``.
        views: from ``render_path``, with depths in the cameras' own unit.
        cameras: ``[V]``, in the frame of the rendered file.
        rate: images per second, for ``transforms.json``.

    Raises:
        UserError: it cannot be written.
    """
    check_folder(folder)
    with atomic_folder(folder, replace=True) as temporary:
        extra = []
        for number, (image, depth) in enumerate(views):
            name = f"{number:04d}"
            Image.fromarray(image).save(temporary / f"{name}.png")
            fields: dict[str, object] = {"file_path": f"{name}.png"}
            if depth is not None:
                unit = max(float(depth.max()), 1e-9) / _DEPTH_STEPS
                steps = (depth / unit).round().astype(np.uint16)
                Image.fromarray(steps).save(temporary / f"{name}-depth.png")
                fields |= {"depth": f"{name}-depth.png", "depth_unit": unit}
            extra.append(fields)
        save_path(temporary / CAMERAS, cameras, rate, extra)


def turntable_frames(
    gaussians: Gaussians, view: Viewpoint = FRONT, *, size: int = 256, frames: int = 48
) -> np.ndarray:
    """Render one full turn on grey, from the reference view, with several views per launch.

    Args:
        gaussians: one object without batch dimension, in the reference frame, on the device that
            renders.
        view: of the first frame; the others have its elevation.
        size: side of the square frames, pixels, >= 1.
        frames: number of views, >= 1.

    Returns:
        ``[frames, size, size, 3]`` uint8.
    """
    cameras = turntable(frames, view, size)
    return np.stack([image for image, _ in render_path(gaussians, cameras, (GREY, GREY, GREY))])


def save_turntable(path: str | Path, frames: np.ndarray, seconds: float = SECONDS) -> None:
    """Write frames as an endless ``.gif`` or an ``.mp4`` (H.264), by the suffix, atomically.

    Args:
        path: ends in ``.gif`` or ``.mp4``.
        frames: ``[F, H, W, 3]`` uint8; for MP4 the last row or column is repeated if their number
            is odd, since H.264 needs even sizes.
        seconds: length of one turn.

    Raises:
        UserError: another suffix, or the file cannot be written.
    """
    grey = int(to_uint8(np.array(GREY)))
    sample = frames[:: max(1, len(frames) // 8)]
    save_movie(path, frames, len(frames) / seconds, sample, (grey, grey, grey))
