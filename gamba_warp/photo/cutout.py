"""Cut out the object of a photograph; tries mask, alpha, networks, plain background, GrabCut.

Masks and transparency from the user are not doubted. Results of the other methods are checked: the
next method is tried if they cannot be an object, and reasons to doubt them are said. Of all, the
object's edge loses its background (``edges.py``).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch

from ..batch import counted
from ..conventions import GREY, Cutout, over_background
from ..data.preprocess import (
    BORDER_RATIO,
    PRESENT,
    WORKING_SIZE,
    SamSegmenter,
    border_of,
    has_alpha,
    planes_of,
    read_mask,
    recenter,
    resize,
    shrink,
    without_specks,
)
from ..errors import UserError
from ..images import load_rgba
from . import models
from .edges import local_colors, without_background, without_matte
from .grabcut import grabcut
from .matte import Matte, NoMatte, to_stderr

Method = Literal["alpha", "mask", "plain", "matte", "sam", "grabcut", "none"]

MEND = (
    "If it is wrong: gamba reconstruct --save-inputs writes the cut-out as NAME-input.png; erase "
    "or restore parts of it in an image editor and give that file, or give --mask FILE."
)
_HOW: dict[str, str] = {
    "alpha": "The image's own transparency is the cut-out{fringe}.",
    "mask": "The mask {mask} cut the object out{fringe}.",
    "plain": "The plain background was removed{holes}{why}.",
    "matte": "The matting model {model} cut the object out.",
    "sam": "Segment Anything cut the object out, expected in the middle.",
    "grabcut": "GrabCut cut the object out by colours alone, expected in the middle{why}.",
    "none": "The whole image is the object.",
}
_NAMES = {"sam": "Segment Anything", "matte": "matting model", "grabcut": "GrabCut"}
_LEAST_FRACTION, _MOST_FRACTION = 0.003, 0.95  # of the image covered by an object
_MOST_EDGE = 0.7  # fraction of the image's border that an object may cover
_UNSURE = 0.4  # largest fraction of alpha's sum in pixels that are neither object nor background

# A result is doubted if the object
_BORDER = 0.02  # covers more than this fraction of the image's border,
_PART = 0.15  # has further parts of at least this fraction of its largest,
_MIN_EDGE_CONTRAST = 0.06  # differs by less than this from the background beside it
_MAX_WEAK_FRACTION = 0.3  # along more than this fraction of its outline,
_MAX_SOFT_FRACTION = 0.03  # has more of its alpha than this in wide areas that are neither 0 nor 1

_LIKE_GROUND = "it is coloured like the background: parts may be lost, or enclosed background kept"

_PREVIEW_SIDE = 360  # longer side of each image of ``CutOut.beside``
_FLOATER = 0.1  # lower alpha is set to 0
_OPAQUE = 0.5  # a warning is given if alpha is lower everywhere
# An object of a smaller longer side in the reduced image is cut from the whole one.
_CLOSE = WORKING_SIZE // 2  # pixels
_SAME = 0.8  # least IoU of both cut-outs; else the first one's mask is enlarged
_FEW_PIXELS = 128  # longer side of an object, below which a result is blurred


@dataclass
class CutoutOptions:
    """Options and loaded models of the cut-out, shared by all images of a command.

    Attributes:
        mask: image of the same size, brighter (or opaque) on the object.
        matte_model: an ISNet or U2-Net in ONNX, or the URL of a copy of one of rembg's; None: one
            of rembg's, from its cache or fetched.
        sam: a checkpoint of Segment Anything, used instead of the matting model.
        recenter: centre the object, its longer side ``0.8`` of the square; else the image keeps
            its frame, padded to a square.
        device: device of Segment Anything; the matting model runs on the CPU.
        fetch: allow fetching a matting model.
        notify: called with a line before anything is fetched, and if the matting model is missing.
        cutout: the only method to use; auto: the first that finds an object.
        keep_holes: keep enclosed areas of a plain background's colour.
        without_network: True once the matting model was found to be unavailable, as ``notify``
            reported.
    """

    mask: str | Path | None = None
    matte_model: str | Path | None = None
    sam: str | Path | None = None
    recenter: bool = True
    device: str | torch.device = "cpu"
    fetch: bool = True
    notify: Callable[[str], None] = to_stderr
    cutout: Cutout = "auto"
    keep_holes: bool = False
    _segmenter: SamSegmenter | None = field(default=None, init=False, repr=False)
    _matte: Matte | None = field(default=None, init=False, repr=False)
    without_network: bool = field(default=False, init=False, repr=False)

    def checked(self) -> CutoutOptions:
        """Open the given files, so that errors come before any image; return ``self``.

        Raises:
            UserError: a file is missing, of another kind, or not used by the chosen method.
            ModuleNotFoundError: a required library is not installed.
        """
        networks = {"--sam": self.sam, "--matte-model": self.matte_model}
        files = {"--mask": self.mask} | (networks if self.cutout != "matte" else {})
        for option, file in files.items() if self.cutout != "auto" else ():
            if file is not None:
                raise UserError(f"{option} is not used by --cutout {self.cutout}")
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
        """Return the matting model, opened once; None if unavailable, reported by ``notify``."""
        if self._matte is None and not self.without_network:
            try:
                self._matte = Matte(self.matte_model, self.fetch, self.notify)
            except NoMatte as error:
                self.without_network = True
                self.notify(str(error))
        return self._matte


@dataclass(frozen=True)
class CutOut:
    """An object that was cut out of an image.

    Attributes:
        rgba: ``[S, S, 4]`` float32 in [0, 1]: the object in the middle, its longer side
            ``0.8 · S``; without ``CutoutOptions.recenter`` at its place.
        method: of the cut-out.
        how: the method in a sentence.
        source_rgb: the image, ``[H, W, 3]`` float32 in [0, 1], at most 1024 pixels per side.
        mask: alpha of the object in it, ``[H, W]`` float32 in [0, 1].
        editable: ``[h, w, 4]`` float32: the whole image, or a small object with what is around
            it at its own pixels, with colours in transparent parts too, so that an editor can
            restore them in a PNG, which may be used as input again.
        warning: reasons to doubt the cut-out, and a remedy; empty without a doubt.
        areas: ``[H, W]`` bool, enclosed areas of a plain background's colour, kept or removed.
        doubt: the warning without the remedy, which is one of the command line.
    """

    rgba: np.ndarray
    method: Method
    how: str
    source_rgb: np.ndarray
    mask: np.ndarray
    editable: np.ndarray
    warning: str
    areas: np.ndarray
    doubt: str

    @property
    def note(self) -> str:
        """The method, doubts, and how to correct the result."""
        return " ".join(filter(None, (self.how, self.warning, MEND)))

    def beside(self) -> np.ndarray:
        """Return the image beside its cut-out on grey, ``[H, 2 W, 3]``."""
        both = (np.dstack([self.source_rgb, x]) for x in (np.ones_like(self.mask), self.mask))
        small = np.hstack([shrink(half, _PREVIEW_SIDE) for half in both])
        return over_background(small, GREY)


class _Result(NamedTuple):
    """Result of a method: ``[H, W, 4]``, enclosed areas ``[H, W]``, words for ``_HOW``, a doubt."""

    method: Method
    rgba: np.ndarray
    areas: np.ndarray | None = None
    holes: str = ""
    why: str = ""
    doubt: str = ""


def cut_out(path: str | Path, options: CutoutOptions | None = None) -> CutOut:
    """Read an image and cut its object out.

    A given mask comes first; then the image's own transparency, Segment Anything or a matting
    model if given or in the cache, a plain background, a matting model that is fetched, and
    GrabCut.

    Args:
        path: any image that ``load_rgba`` reads.
        options: options.

    Raises:
        UserError: the image or a file of ``options`` cannot be read, or no object is found.
        ModuleNotFoundError: a library for a file of ``options`` is not installed.
    """
    options = CutoutOptions() if options is None else options
    rgba = load_rgba(path, WORKING_SIZE, options.notify)
    method: Method | None = None
    if options.mask is not None:
        rgba[..., 3] = read_mask(options.mask, path)
        method = "mask"
    elif options.cutout == "none":
        rgba[..., 3] = 1
        method = "none"
    elif options.cutout in ("auto", "alpha") and has_alpha(rgba, options.cutout == "alpha"):
        method = "alpha"
    elif options.cutout == "alpha":
        raise UserError(f"{path}: has no transparency, which --cutout alpha uses")
    few = method is None and options.cutout == "auto" and has_alpha(rgba, any_fraction=True)
    if few:
        options.notify(
            f"{path}: its few transparent pixels are no cut-out (--cutout alpha takes them)"
        )
    whole, rgba = rgba, shrink(rgba, WORKING_SIZE)
    source, fringe = rgba[..., :3].copy(), None
    if method == "alpha":
        rgba, fringe = without_matte(rgba)
    elif method == "mask":
        before, rgba = rgba, without_background(source, rgba[..., 3])
        fringe = "background" if (rgba[..., 3] < before[..., 3]).any() else None
    result = None if method is None else _Result(method, rgba)
    if result is None:
        try:
            result = _cut_by_methods(path, source, options)
        except UserError:
            if not few:
                raise
    if result is None or few and not result.rgba[..., 3].any():
        result = _Result("alpha", rgba)  # the object may well fill the image
    method, rgba = result.method, result.rgba
    close, around = rgba, source
    if options.recenter:
        close, around = _at_own_pixels(path, whole, source, result, options)
    try:
        centred = recenter(close, BORDER_RATIO if options.recenter else None)
    except ValueError as error:
        raise UserError(f"{options.mask or path}: {error}") from error
    model = options.matte() if method == "matte" else None
    how = _HOW[method].format(
        mask=Path(options.mask or "").name,
        model=model and model.path.name,
        holes=result.holes,
        why=result.why,
        fringe=f", without the {fringe} mixed into its edge" if fringe else "",
    )
    if options.recenter and (pixels := round((1 - BORDER_RATIO) * len(centred))) < _FEW_PIXELS:
        how += f" Its longer side has {pixels} pixels, so the result is blurred."
    if (most := rgba[..., 3].max()) < _OPAQUE:
        how += f" It is at most {most:.0%} opaque, so the result is faint, too."
    doubt, advice, trusted = "", "", method in ("mask", "alpha", "none")
    doubts = [] if trusted else doubts_of(source, rgba[..., 3])
    if method == "mask" and (edge := _on_border(rgba[..., 3] > 0.5)) > _BORDER:
        inverted = " (is the mask inverted?)" if edge > _MOST_EDGE else ""
        doubts.append(f"it touches the image's border{inverted}")
    doubts += [result.doubt] if result.doubt else []
    if method == "grabcut":  # docs/reconstruct.md has the figure
        doubts.append("colours alone fail for more than half of photographs")
    if doubts:
        doubt = f"The cut-out may be wrong: {'; '.join(doubts)}."
        if method in ("plain", "grabcut") and not options.without_network:
            best = models.PUBLISHED[0]
            about = f"{best.name}, {best.megabytes} MB, {best.licence}, fetched once"
            advice = f" Try a network: gamba reconstruct --cutout matte ({about})."
    editable = np.dstack([np.where(close[..., 3:] > 0, close[..., :3], around), close[..., 3]])
    areas = np.zeros(rgba.shape[:2], bool) if result.areas is None else result.areas > 0
    return CutOut(
        centred, method, how, source, rgba[..., 3], editable, doubt + advice, areas, doubt
    )


def _at_own_pixels(
    path: str | Path,
    whole: np.ndarray,
    source: np.ndarray,
    result: _Result,
    options: CutoutOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Return an object that is small in the reduced image as it is in the whole one.

    Args:
        path: named in errors.
        whole: ``[H, W, 4]``, the image with its alpha or the mask's.
        source: ``[h, w, 3]``, the reduced image.
        result: its cut-out in the reduced image.
        options: options.

    Returns:
        ``[h, w, 4]``, the object and what is around it, and ``[h, w, 3]``, the image there; or
        the reduced image's.
    """
    rgba, scale = result.rgba, len(whole) / len(result.rgba)
    rows, columns = (np.flatnonzero((rgba[..., 3] > PRESENT).any(axis)) for axis in (1, 0))
    if scale < 1.1 or not len(rows):
        return rgba, source
    sides = [int(each[-1] - each[0]) + 1 for each in (rows, columns)]
    if max(sides) > _CLOSE:
        return rgba, source
    spare = max(8, max(sides) // 4)
    box = [
        (max(0, each[0] - spare), min(n, each[-1] + 1 + spare))
        for each, n in zip((rows, columns), rgba.shape)
    ]
    small = rgba[tuple(slice(*ends) for ends in box)][..., 3:]
    part = whole[tuple(slice(round(a * scale), round(b * scale)) for a, b in box)]
    part = shrink(part, WORKING_SIZE)
    around = part[..., :3]
    if result.method == "alpha":
        return without_matte(part)[0], around
    if result.method == "mask":
        return without_background(around, part[..., 3]), around
    alpha = resize(small, *part.shape[:2])[..., 0].clip(0, 1)
    same = copy.copy(options)  # with its opened networks
    same.cutout = "matte" if result.method == "sam" else result.method
    try:
        again = _cut_by_methods(path, around, same).rgba
    except UserError:  # it is all of the part
        again = rgba[:0]
    if again.shape == part.shape:
        one, other = again[..., 3] > 0.5, alpha > 0.5
        if (one & other).sum() >= _SAME * (one | other).sum():
            return again, around
    return _blended(around, alpha), around


def _methods(options: CutoutOptions) -> list[Method]:
    """Return the methods to try, in order: networks that are here come before colours."""
    networks: list[Method] = ["matte"] if options.sam is None else ["sam", "matte"]
    if options.cutout == "matte":
        return networks if options.sam is None or options.matte_model is not None else ["sam"]
    if options.cutout == "plain" or options.cutout == "grabcut":
        return [options.cutout]
    here = find_spec("onnxruntime") is not None and models.cached() is not None
    if options.sam is not None or options.matte_model is not None or here:
        return [*networks, "plain", "grabcut"]
    return ["plain", "matte", "grabcut"]


def _cut_by_methods(path: str | Path, rgb: np.ndarray, options: CutoutOptions) -> _Result:
    """Return the result of the first successful method, with the failures of earlier ones."""
    reasons: list[str] = []
    for method in _methods(options):
        why = f" ({'; '.join(reasons)})" if reasons else ""
        if method == "plain":
            if find_spec("skimage") is not None:
                from .plain import plain_matte

                if (plain := plain_matte(rgb, options.keep_holes)) is not None:
                    holes = counted(len(plain.holes), "enclosed area")
                    said = f", with {holes} of it (--keep-holes keeps them)" if plain.holes else ""
                    doubt = _LIKE_GROUND if plain.alike else ""
                    return _Result("plain", plain.rgba, plain.areas, said, why, doubt)
            if options.cutout == "plain":
                reasons.append("its border is not plain")
            continue
        try:
            cut = {"sam": options.segmenter, "matte": options.matte}.get(method, lambda: grabcut)()
            alpha = None if cut is None else cut(rgb)
        except NoMatte as error:
            reasons.append(str(error))
            continue
        if alpha is None:
            reasons.append("no matting model")
            continue
        fault = fault_of(alpha)
        if fault is None:
            return _Result(method, _blended(rgb, alpha), why=why)
        reasons.append(f"{_NAMES[method]}: {fault}")
    raise UserError(
        f"{path}: cannot tell object from background ({'; '.join(reasons)}); give an image with a "
        "transparent or plain background, --mask FILE, --matte-model FILE or --sam FILE"
    )


def doubts_of(rgb: np.ndarray, alpha: np.ndarray) -> list[str]:
    """Return reasons to doubt a cut-out that may be right.

    Args:
        rgb: the image, ``[H, W, 3]`` in [0, 1].
        alpha: ``[H, W]`` in [0, 1].
    """
    inside, doubts = alpha > 0.5, []
    if _on_border(inside) > _BORDER:
        doubts.append("it touches the image's border")
    if find_spec("skimage") is not None:
        from skimage.measure import label

        sizes = np.bincount(np.asarray(label(inside)).ravel())[1:]
        if (parts := int((sizes >= _PART * sizes.max(initial=1)).sum())) > 1:
            doubts.append(f"it has {parts} separate parts")
    planes = planes_of(alpha[..., None])
    grown = torch.nn.functional.max_pool2d(planes, 3, 1, 1)[0, 0].numpy() > 0.5
    outline = grown & ~inside
    ours, theirs = (x[0].permute(1, 2, 0).numpy() for x in local_colors(rgb, alpha, 3))
    weak = np.abs(ours - theirs).max(-1)[outline] < _MIN_EDGE_CONTRAST
    alike = weak.mean() if outline.any() else 0.0
    if alike > _MAX_WEAK_FRACTION:
        doubts.append(f"along {alike:.0%} of its outline it looks like the background")
    unsure = ((planes > 0.1) & (planes < 0.9)).float()
    wide = -torch.nn.functional.max_pool2d(-unsure, 5, 1, 2)
    if float((wide * planes).sum()) > _MAX_SOFT_FRACTION * float(planes.sum()):
        doubts.append("parts of it are half transparent")
    return doubts


def _on_border(inside: np.ndarray) -> float:
    """Return the fraction of an image's border that an object ``[H, W]`` bool covers."""
    return float(border_of(inside).mean())


def fault_of(alpha: np.ndarray) -> str | None:
    """Return why a mask cannot be a single object completely in the image; None if it can.

    Args:
        alpha: ``[H, W]`` in [0, 1].
    """
    inside = alpha > 0.5
    fraction = inside.mean()
    if fraction < _LEAST_FRACTION:
        return "nothing stands out"
    if fraction > _MOST_FRACTION:
        return "all of the image would be the object"
    if (edge := _on_border(inside)) > _MOST_EDGE:
        return f"it would touch {edge:.0%} of the image's border"
    if alpha[(alpha > 0.1) & (alpha < 0.9)].sum() > _UNSURE * alpha.sum():
        return "it has no clear border"
    return None


def _blended(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return ``[H, W, 4]`` without specks, and without the background along the border."""
    alpha = np.where(alpha < _FLOATER, 0, alpha)  # floaters would enlarge the object's bounds
    alpha = without_specks(alpha) if find_spec("skimage") is not None else alpha
    return without_background(rgb, alpha.astype(np.float32))
