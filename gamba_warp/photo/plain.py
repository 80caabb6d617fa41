"""Plain backgrounds: their removal, with enclosed areas of background and soft shadows.

The background's colour is a smooth function of the position, fitted to what is flooded from the
border. An enclosed area is background too if it has exactly that colour: the matter of an object is
lighter or darker by its shading. docs/reconstruct.md has the figures.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from skimage.measure import label

from ..data.preprocess import border_of, without_specks

ndimage: Any = scipy.ndimage  # its annotations do not say which results are arrays

_TOLERANCE = 0.07  # largest colour difference within a plain background
# Areas within the tolerance are light matter if
_TIGHT = 0.025  # they differ by more than this and four times the noise, and
_FRINGE = 3  # are wider than twice this, pixels: JPEG makes narrow ones
_FRACTION = 0.8  # least fraction of border pixels that are background; the object may touch an edge
_SAMPLES = 20_000  # pixels of a fit
_FITS = 3
_BOUNDARY = 2  # pixels along the border whose alpha is fractional
# An enclosed area is background if
_HOLE = 0.0003  # it has at least this fraction of the image, and
_LEAST_HOLE = 12  # pixels,
_BIAS = 0.006  # its median differs by at most this, or by a third of the noise, and
_ISLANDS = 0.03  # at most this fraction of it is text or images on it, and
_FAINT, _FAINT_FRACTION = 0.15, 0.2  # at most this fraction of its surroundings differs by less
# A pixel may be shadow if it has
_DARKEST = 0.45  # at least this fraction of the background's light,
_HUE = 0.025  # its hue within this, and
_SLOPE = 0.02  # at most this change from pixel to pixel. Areas of such pixels are shadow if
_STRIP = 0.001, 0.35  # they have at least this fraction of the image, at most this of the object,
_FOOT = 0.8  # lie this far down the object (nine of ten pixels), and
_CONTACT = 0.25  # border on background along this fraction of their border
# In an image of about this longer side an object may have the background's own colour if
_SMALL = 256  # pixels,
_STEP, _STEPLESS = 0.03, 0.15  # over this fraction of its outline changes by less a pixel, or
_EXACT, _KEPT = 0.02, 0.05  # enclosed areas with a median within this have more of it than this,
_LIGHT, _LIGHT_FRACTION = 0.3, 0.1  # and over this fraction of its outline differs by less


class Plain(NamedTuple):
    """An image without its plain background.

    Attributes:
        rgba: ``[H, W, 4]`` float32, straight alpha.
        areas: ``[H, W]`` int32, numbers of enclosed areas of about the background's colour, large
            enough for a hole; 0 elsewhere.
        holes: numbers of those that were removed.
        alike: True if the object may have the background's colour, so that parts of it are lost, or
            background that it encloses is kept.
    """

    rgba: np.ndarray
    areas: np.ndarray
    holes: list[int]
    alike: bool


def plain_matte(rgb: np.ndarray, keep_holes: bool = False) -> Plain | None:
    """Remove a plain background, which has the colour of most of the image's border.

    Along the edge alpha is fractional, and the background's fraction is removed from the colour, so
    no fringe is left on another background.

    Args:
        rgb: ``[H, W, 3]`` in [0, 1].
        keep_holes: keep enclosed areas of the background's colour.

    Returns:
        None if the background is not plain. An image of one colour is all background.
    """
    edge = border_of(rgb)
    color = np.median(edge, axis=0)
    if (np.abs(edge - color).max(-1) < _TOLERANCE).mean() < _FRACTION:
        return None
    ground, noise = _fitted(rgb, _outer(np.abs(rgb - color).max(-1) < _TOLERANCE)[1])
    residual = rgb - ground
    areas, background = _outer(np.abs(residual).max(-1) < _TOLERANCE)
    sizes = np.bincount(areas.ravel())
    small = np.flatnonzero(sizes < max(_LEAST_HOLE, _HOLE * areas.size))
    areas = np.where(background | np.isin(areas, small), 0, areas)
    holes, exact = ([], []) if keep_holes else _holes(areas, residual, noise)
    background = _exact(background, residual, noise)
    background |= _shadow(rgb, ground, noise, background) | np.isin(areas, holes)
    rgba = _without(rgb, background)
    return Plain(rgba, areas, holes, _alike(rgb, residual, rgba[..., 3], np.isin(areas, exact)))


def _outer(same: np.ndarray) -> tuple[np.ndarray, NDArray[np.bool_]]:
    """Return the numbered areas ``[H, W]`` of a mask, and those that touch the border."""
    areas = cast(np.ndarray, label(same, connectivity=1))
    at_edge = np.unique(border_of(areas))
    return areas, np.isin(areas, at_edge[at_edge > 0])


def _fitted(rgb: np.ndarray, background: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a quadratic of the position to the background's colours; return it and the noise."""
    height, width = background.shape
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    terms = np.broadcast_arrays(1.0, x, y, x * x, x * y, y * y)
    used, ground, noise = background, np.zeros_like(rgb), 0.0
    for _ in range(_FITS):
        rows, columns = np.nonzero(used)
        some = slice(None, None, max(1, len(rows) // _SAMPLES))
        rows, columns = rows[some], columns[some]
        sampled = np.stack([term[rows, columns] for term in terms], -1)
        factors = np.linalg.lstsq(sampled, rgb[rows, columns], rcond=None)[0]
        ground = sum(term[..., None] * row for term, row in zip(terms, factors, strict=True))
        ground = np.clip(ground, 0, 1)
        off = np.abs(rgb - ground).max(-1)
        noise = 1.48 * float(np.median(off[used]))
        used = background & (off <= max(3 * noise, 2 / 255))
    return ground.astype(np.float32), noise


def _exact(background: np.ndarray, residual: np.ndarray, noise: float) -> np.ndarray:
    """Return a background without wide areas of another colour, which are light matter."""
    exact = _outer(background & (np.abs(residual).max(-1) < _TIGHT + 4 * noise))[1]
    other = background & ~exact
    wide = ndimage.binary_opening(other, iterations=_FRINGE)
    return background & ~ndimage.binary_dilation(wide, iterations=_FRINGE, mask=other)


def _shadow(
    rgb: np.ndarray, ground: np.ndarray, noise: float, background: np.ndarray
) -> np.ndarray:
    """Return soft shadows on the floor: the background's hue, darker, at the object's foot."""
    light = (rgb * ground).sum(-1) / np.maximum((ground * ground).sum(-1), 1e-6)
    hue = np.abs(rgb - light[..., None] * ground).max(-1)
    slope = ndimage.gaussian_gradient_magnitude(light, 1.0)
    may = (light > _DARKEST) & (light < 1) & (hue < _HUE + 2 * noise) & (slope < _SLOPE)
    parts = cast(np.ndarray, label(may & ~background, connectivity=1))
    rows = np.nonzero(~background & (np.abs(rgb - ground).max(-1) > 2 * _TOLERANCE))[0]
    shadow = np.zeros_like(background)
    if not len(rows):
        return shadow
    top, foot = np.quantile(rows, (0.02, 0.98))
    least, most = _STRIP[0] * parts.size, _STRIP[1] * (~background).sum()
    sizes = np.bincount(parts.ravel())
    for number in np.flatnonzero((sizes >= least) & (sizes <= most)):
        part = parts == number
        outside = ndimage.binary_dilation(part) & ~part
        high = np.quantile(np.nonzero(part)[0], 0.1)
        if number and high >= top + _FOOT * (foot - top) and background[outside].mean() >= _CONTACT:
            shadow |= part
    return shadow


def _holes(areas: np.ndarray, residual: np.ndarray, noise: float) -> tuple[list[int], list[int]]:
    """Return the numbers of the enclosed areas that are background, and of others so coloured."""
    difference = np.abs(residual).max(-1)
    widest = ndimage.maximum_filter(difference, 3)
    holes, others = [], []
    for number, box in enumerate(ndimage.find_objects(areas), 1):
        if box is None:
            continue
        wide = tuple(slice(max(0, part.start - 4), part.stop + 4) for part in box)
        area = areas[wide] == number
        inner = ndimage.binary_erosion(area)
        inner = inner if inner.any() else area
        bias = np.abs(np.median(residual[wide][inner], axis=0)).max()
        ring = ndimage.binary_dilation(area, iterations=2) & ~ndimage.binary_dilation(area)
        text = ndimage.binary_fill_holes(area) & (difference[wide] > 2 * _TOLERANCE)
        islands = text.sum() / area.sum()
        faint = (widest[wide][ring] < _FAINT).mean()
        if bias <= max(_BIAS, noise / 3) and islands <= _ISLANDS and faint <= _FAINT_FRACTION:
            holes.append(number)
        elif bias <= _EXACT:
            others.append(number)
    return holes, others


def _alike(rgb: np.ndarray, residual: np.ndarray, alpha: np.ndarray, exact: np.ndarray) -> bool:
    """Return True if an object may have the background's colour (``Plain.alike``)."""
    times = min(max(1, round(max(alpha.shape) / _SMALL)), *alpha.shape)
    height, width = (side // times for side in alpha.shape)

    def small(values: np.ndarray) -> np.ndarray:
        cut = values[: height * times, : width * times].reshape(height, times, width, times, -1)
        return cut.mean((1, 3))

    inside = small(alpha)[..., 0] > 0.5
    outline = inside & ~ndimage.binary_erosion(inside, border_value=1)
    if not outline.any():
        return False
    slopes = [
        ndimage.gaussian_gradient_magnitude(plane, 1.0) for plane in small(rgb).transpose(2, 0, 1)
    ]
    steepest = ndimage.maximum_filter(np.max(slopes, 0), 5)[outline]
    if (steepest < _STEP).mean() > _STEPLESS:
        return True
    difference = np.where(inside, np.abs(small(residual)).max(-1), 0)
    light = ndimage.maximum_filter(difference, 5)[outline] < _LIGHT
    kept = small(exact)[inside[..., None]].sum() / inside.sum()
    return bool(kept > _KEPT and light.mean() > _LIGHT_FRACTION)


def _without(rgb: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Return ``[H, W, 4]`` without a background, which keeps its colour on the object's edge."""
    distance, (rows, columns) = ndimage.distance_transform_edt(~background, return_indices=True)
    boundary = ~background & (distance <= _BOUNDARY)
    near = rgb[rows, columns]  # the background's colour beside each pixel
    difference = np.abs(rgb - near).max(-1)
    # A boundary pixel mixes background and object; the largest difference nearby is the object's.
    full = ndimage.maximum_filter(np.where(background, 0.0, difference), 5)
    fraction = np.clip(difference / np.maximum(full, 1e-6), 0.0, 1.0)
    alpha = without_specks(np.where(background, 0.0, np.where(boundary, fraction, 1.0)))
    weight = np.maximum(alpha, 1e-3)[..., None]
    inside = np.clip((rgb - (1 - weight) * near) / weight, 0.0, 1.0)
    return np.dstack([inside, alpha]).astype(np.float32)
