"""Cut out the object of a photograph; tries mask, alpha, plain background, SAM, matting, GrabCut.

Masks and transparency from the user are used unchanged. Results of the other methods are checked,
and the next method is tried if they cannot be an object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ..data.preprocess import (
    BORDER_RATIO,
    WORKING_SIZE,
    SamSegmenter,
    has_alpha,
    plain_matte,
    read_mask,
    recenter,
    shrink,
    without_specks,
)
from ..errors import UserError
from ..images import load_rgba
from .grabcut import grabcut
from .matte import Matte, NoMatte, to_stderr

Method = Literal["alpha", "mask", "plain", "matte", "sam", "grabcut"]

MEND = (
    "If it is wrong: gamba reconstruct --save-inputs writes the cut-out as NAME-input.png; erase "
    "or restore parts of it in a picture editor and give that file, or give --mask FILE."
)
_HOW: dict[str, str] = {
    "alpha": "The picture's own transparency is the cut-out.",
    "mask": "The mask {mask} cut the object out.",
    "plain": "The plain background was removed.",
    "matte": "The matting model {model} cut the object out.",
    "sam": "Segment Anything cut the object out, expected in the middle.",
    "grabcut": "GrabCut cut the object out by colours alone, expected in the middle{why}.",
}
_LEAST_SHARE, _MOST_SHARE = 0.003, 0.95  # of the picture covered by an object
_MOST_EDGE = 0.7  # share of the picture's border that an object may cover
_UNSURE = 0.4  # largest share of alpha's sum in pixels that are neither object nor background

_HAZE = 0.1  # lower alpha is set to 0
_OPAQUE = 0.5  # a warning is given if alpha is lower everywhere


@dataclass
class Ways:
    """Options and loaded models of the cut-out, shared by all pictures of a command.

    Attributes:
        mask: picture of the same size, white (or opaque) on the object.
        matte_model: an ISNet or U2-Net in ONNX, or the URL of a copy of one of rembg's; None: one
            of rembg's, from its cache or fetched.
        sam: a checkpoint of Segment Anything, used instead of the matting model.
        recenter: centre the object, its longer side ``0.8`` of the square; else the picture keeps
            its frame, padded to a square.
        device: device of Segment Anything; the matting model runs on the CPU.
        fetch: allow fetching a matting model.
        say: called with a line before anything is fetched, and if the matting model is missing.
    """

    mask: str | Path | None = None
    matte_model: str | Path | None = None
    sam: str | Path | None = None
    recenter: bool = True
    device: str | torch.device = "cpu"
    fetch: bool = True
    say: Callable[[str], None] = to_stderr
    _segmenter: SamSegmenter | None = field(default=None, init=False, repr=False)
    _matte: Matte | None = field(default=None, init=False, repr=False)
    _no_matte: bool = field(default=False, init=False, repr=False)

    def checked(self) -> Ways:
        """Open the given files, so that errors come before any picture; return ``self``.

        Raises:
            UserError: a file is missing, or of another kind.
            ModuleNotFoundError: a required library is not installed.
        """
        if self.sam is not None:
            self.segmenter()
        if self.matte_model is not None:
            self.matte()
        return self

    def segmenter(self) -> SamSegmenter | None:
        """Return Segment Anything, opened once; None if not requested."""
        if self._segmenter is None and self.sam is not None:
            self._segmenter = SamSegmenter(self.sam, self.device)
        return self._segmenter

    def matte(self) -> Matte | None:
        """Return the matting model, opened once; None if unavailable, reported by ``say``."""
        if self._matte is None and not self._no_matte:
            try:
                self._matte = Matte(self.matte_model, self.fetch, self.say)
            except NoMatte as error:
                self._no_matte = True
                self.say(str(error))
        return self._matte


@dataclass(frozen=True)
class CutOut:
    """An object that was cut out of a picture.

    Attributes:
        rgba: ``[S, S, 4]`` float32 in [0, 1]: the object in the middle, its longer side
            ``0.8 · S``; without ``Ways.recenter`` at its place.
        method: of the cut-out.
        how: the method in a sentence.
        source_rgb: the picture, ``[H, W, 3]`` float32 in [0, 1], at most 1024 pixels per side.
        mask: alpha of the object in it, ``[H, W]`` float32 in [0, 1].
        editable: ``[H, W, 4]`` float32: the whole picture, with colours in transparent parts too,
            so that an editor can restore them in a PNG, which may be used as input again.
    """

    rgba: np.ndarray
    method: Method
    how: str
    source_rgb: np.ndarray
    mask: np.ndarray
    editable: np.ndarray

    @property
    def note(self) -> str:
        """The method, and how to correct the result."""
        return f"{self.how} {MEND}"


def cut_out(path: str | Path, ways: Ways | None = None) -> CutOut:
    """Read a picture and cut its object out.

    A given mask comes first; then the picture's own transparency, a plain background, Segment
    Anything if given, the matting model, and GrabCut.

    Args:
        path: any picture that ``load_rgba`` reads.
        ways: options.

    Raises:
        UserError: the picture or a file of ``ways`` cannot be read, or no method finds an object.
        ModuleNotFoundError: a library for a file of ``ways`` is not installed.
    """
    ways = Ways() if ways is None else ways
    rgba, why = load_rgba(path, WORKING_SIZE, ways.say), ""
    method: Method | None = None
    if ways.mask is not None:
        rgba[..., 3] = read_mask(ways.mask, path)
        method = "mask"
    elif has_alpha(rgba):
        method = "alpha"
    rgba = shrink(rgba, WORKING_SIZE)
    source = rgba[..., :3].copy()
    if method is None:
        method, rgba, why = _cut_by_methods(path, source, ways)
    try:
        centred = recenter(rgba, BORDER_RATIO if ways.recenter else None)
    except ValueError as error:
        raise UserError(f"{ways.mask or path}: {error}") from error
    model = ways.matte() if method == "matte" else None
    how = _HOW[method].format(
        mask=Path(ways.mask or "").name, model=model and model.path.name, why=why
    )
    if (most := rgba[..., 3].max()) < _OPAQUE:
        how += f" It is at most {most:.0%} opaque, so the result is faint, too."
    colors = np.where(rgba[..., 3:] > 0, rgba[..., :3], source)
    editable = np.dstack([colors, rgba[..., 3]])
    return CutOut(centred, method, how, source, rgba[..., 3], editable)


def _cut_by_methods(
    path: str | Path, rgb: np.ndarray, ways: Ways
) -> tuple[Method, np.ndarray, str]:
    """Return the first successful method, its ``[H, W, 4]``, and the failures of earlier ones."""
    if find_spec("skimage") is not None:
        rgba = plain_matte(rgb)
        if rgba is not None:
            return "plain", rgba, ""
    reasons = []
    those: list[tuple[Method, str, Callable[[], Callable | None]]] = [
        ("sam", "Segment Anything", ways.segmenter),
        ("matte", "matting model", ways.matte),
        ("grabcut", "GrabCut", lambda: grabcut),
    ]
    for method, name, opened in those:
        try:
            cut = opened()
            alpha = None if cut is None else cut(rgb)
        except NoMatte as error:
            reasons.append(str(error))
            continue
        if alpha is None:
            reasons += ["no matting model"] if method == "matte" else []
            continue
        fault = fault_of(alpha)
        if fault is None:
            return method, _blended(rgb, alpha), f" ({'; '.join(reasons)})"
        reasons.append(f"{name}: {fault}")
    raise UserError(
        f"{path}: cannot tell object from background ({'; '.join(reasons)}); give a picture with a "
        "transparent or plain background, --mask FILE, --matte-model FILE or --sam FILE"
    )


def fault_of(alpha: np.ndarray) -> str | None:
    """Return why a mask cannot be a single object completely in the picture; None if it can.

    Args:
        alpha: ``[H, W]`` in [0, 1].
    """
    inside = alpha > 0.5
    share = inside.mean()
    edge = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    if share < _LEAST_SHARE:
        return "nothing stands out"
    if share > _MOST_SHARE:
        return "all of the picture would be the object"
    if edge.mean() > _MOST_EDGE:
        return f"it would touch {edge.mean():.0%} of the picture's border"
    if alpha[(alpha > 0.1) & (alpha < 0.9)].sum() > _UNSURE * alpha.sum():
        return "it has no clear border"
    return None


def _blended(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return ``[H, W, 4]`` with the background removed from the colours along the border.

    Colours of object and background are local means weighted by alpha (the fusion of blurs of Forte
    2021), so that no fringe is left on another background.
    """
    alpha = np.where(alpha < _HAZE, 0, alpha)  # haze would enlarge the object's bounds
    alpha = without_specks(alpha) if find_spec("skimage") is not None else alpha
    picture = torch.from_numpy(np.ascontiguousarray(rgb, np.float32)).permute(2, 0, 1)[None]
    share = torch.from_numpy(np.ascontiguousarray(alpha, np.float32))[None, None]
    size = 2 * max(2, max(rgb.shape[:2]) // 64) + 1

    def around(weight: torch.Tensor) -> torch.Tensor:
        planes = torch.cat([picture * weight, weight], 1)
        mean = torch.nn.functional.avg_pool2d(planes, size, 1, size // 2)
        return mean[:, :3] / mean[:, 3:].clamp(min=1e-5)

    ours, theirs = around(share), around(1 - share)
    colors = ours + share * (picture - share * ours - (1 - share) * theirs)
    colors = torch.where(share > 0.99, picture, colors).clamp(0, 1)
    return np.dstack([colors[0].permute(1, 2, 0).numpy(), alpha]).astype(np.float32)
