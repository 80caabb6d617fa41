"""Turntables, which show a reconstruction from all around, as GIF or MP4."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ..cameras import Cameras, intrinsics, orbit
from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..errors import UserError
from ..files import atomic_path
from ..gaussians import Gaussians
from ..images import to_uint8
from ..render import render

SECONDS = 3.0  # length of one turn
_CHUNK_PIXELS = 1 << 20  # pixels rendered in one launch, which takes a few hundred MB


@torch.inference_mode()
def turntable_frames(
    gaussians: Gaussians,
    *,
    size: int = 256,
    frames: int = 48,
    elevation: float = 0.0,
    distance: float = DEFAULT_DISTANCE,
    fov: float = DEFAULT_FOV,
) -> np.ndarray:
    """Renders one full turn on white, from the reference view on, with several views a launch.

    Args:
        gaussians: one object without batch dimension, in the reference frame, on the device that
            renders.
        size: side of the square frames, pixels, >= 1.
        frames: number of views, >= 1.
        elevation: degrees; a camera of positive elevation looks down.
        distance: distance of the camera from the object's centre, object units.
        fov: vertical field of view, degrees.

    Returns:
        ``[frames, size, size, 3]`` uint8.
    """
    device = gaussians.means.device
    viewmats = orbit(torch.arange(frames) * (360.0 / frames), elevation, distance)
    Ks = intrinsics(size, size, fov).expand(frames, 3, 3)
    cameras = Cameras(viewmats, Ks, size, size).to(device)
    white = torch.ones(3, device=device)
    chunk = max(1, _CHUNK_PIXELS // (size * size))
    pictures = [
        render(gaussians, cameras[i : i + chunk], background=white).rgb.cpu().numpy()
        for i in range(0, frames, chunk)
    ]
    return to_uint8(np.concatenate(pictures))


def save_turntable(path: str | Path, frames: np.ndarray, seconds: float = SECONDS) -> None:
    """Writes frames as an endless ``.gif`` or an ``.mp4`` (H.264), by the suffix, atomically.

    Args:
        path: ends in ``.gif`` or ``.mp4``.
        frames: ``[F, H, W, 3]`` uint8; for MP4 the last row or column is repeated if their number
            is odd, since H.264 needs even sizes.
        seconds: length of one turn.

    Raises:
        UserError: the suffix is another one, or the file cannot be written.
    """
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise UserError(f"{path}: a turntable is a .gif or an .mp4")
    with atomic_path(path) as temporary:
        writers[suffix](temporary, frames, seconds)


def _write_gif(path: Path, frames: np.ndarray, seconds: float) -> None:
    palette = _palette(frames[:: max(1, len(frames) // 8)])
    pictures = []
    for frame in frames:
        picture = Image.fromarray(frame).quantize(palette=palette)  # dithered
        # Pillow looks colours up so coarsely that white may become a neighbour of white.
        picture.paste(0, mask=Image.fromarray((frame == 255).all(-1)))
        pictures.append(picture)
    # GIF counts time in units of 10 ms, and viewers slow down frames under 20 ms.
    duration = max(20, round(seconds * 100 / len(frames)) * 10)
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=duration, loop=0, optimize=True
    )


def _palette(frames: np.ndarray) -> Image.Image:
    """Makes one palette of white and 255 others for all frames, so that colours do not flicker."""
    pixels = frames.reshape(-1, 3)
    pixels = pixels[(pixels < 255).any(1)]
    if len(pixels) == 0:
        pixels = frames.reshape(-1, 3)[:1]
    colours = Image.fromarray(pixels[None]).quantize(255, kmeans=1).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *colours[: 3 * 255]])
    return palette


def _write_mp4(path: Path, frames: np.ndarray, seconds: float) -> None:
    import imageio_ffmpeg

    count, height, width = frames.shape[:3]
    even = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    size, rate = f"{even.shape[2]}x{even.shape[1]}", f"{count / seconds:.6f}"
    # imageio's own writer passes over ffmpeg's exit code, so a full disk would go unnoticed.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-", "-an", "-c:v", "libx264"]
    command += ["-pix_fmt", "yuv420p", "-crf", "10", "-movflags", "+faststart", f"file:{path}"]
    done = subprocess.run(command, input=even.tobytes(), stderr=subprocess.PIPE)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise OSError(f"ffmpeg ended with code {done.returncode} ({lines[0] if lines else ''})")
