"""GrabCut: minimum cut, objects by colour, and refusals."""

import numpy as np
import pytest
from helpers.cutouts import iou
from helpers.images import disc_on_noise

from gamba_warp.photo import grabcut as cuts
from gamba_warp.photo.cutout import fault_of
from gamba_warp.photo.grabcut import grabcut


def test_the_border_is_the_minimum_cut(monkeypatch):
    """Against SciPy's maximum flow on the same graph, in whole numbers."""
    sparse = pytest.importorskip("scipy.sparse")
    from scipy.sparse.csgraph import maximum_flow

    monkeypatch.setattr(cuts, "_STEPS", 6000)
    rng = np.random.default_rng(3)
    height, width = 9, 13
    borders = cuts._Borders(rng.random((height, width, 3)).astype(np.float32))
    price = rng.normal(0, 200, (height, width)).astype(np.float32)
    fraction = borders.cheapest(price, np.zeros((height, width), np.float32))
    # Nodes: pixels, then a source (object) and a sink.
    number, scale = np.arange(height * width).reshape(height, width), 1000
    source, sink = height * width, height * width + 1
    rows, columns, values = [], [], []
    for weight, offset in zip(borders._weights, cuts._OFFSETS, strict=True):
        here, there = (end.ravel() for end in cuts._ends(number, offset))
        for a, b in ((here, there), (there, here)):
            rows += list(a)
            columns += list(b)
            values += list(np.rint(scale * weight.ravel()))
    for pixel, cost in zip(number.ravel(), np.rint(scale * price.ravel()), strict=True):
        rows.append(source if cost < 0 else pixel)
        columns.append(pixel if cost < 0 else sink)
        values.append(abs(cost))
    size = height * width + 2
    graph = sparse.csr_matrix((np.int32(values), (rows, columns)), (size, size))
    flow = maximum_flow(graph, source, sink).flow_value / scale
    inside = (fraction > 0.5).astype(np.float32)
    cost = (price * inside).sum() - price[price < 0].sum()
    for weight, offset in zip(borders._weights, cuts._OFFSETS, strict=True):
        here, there = cuts._ends(inside, offset)
        cost += (weight * np.abs(here - there)).sum()
    # Each of the 400 capacities is rounded by up to 0.0005; the flow of all is over 500.
    assert flow > 500 and abs(cost - flow) < 0.2
    assert 0 < inside.sum() < inside.size


@pytest.mark.parametrize("size", [(90, 131), (300, 271), (64, 64)])
def test_a_disc_on_a_busy_background_is_found(size):
    rgb, alpha = disc_on_noise(size)
    found = grabcut(rgb)
    assert found.shape == size and found.dtype == np.float32
    assert 0 <= found.min() and found.max() <= 1
    assert iou(found, alpha) > 0.92
    assert fault_of(found) is None
    np.testing.assert_array_equal(grabcut(rgb), found)  # nothing in it is drawn by chance


@pytest.mark.parametrize(
    "rgb",
    [
        np.full((40, 60, 3), 0.4),
        np.random.default_rng(0).random((50, 50, 3)),
        np.dstack([np.tile(np.linspace(0, 1, 40), (40, 1))] * 3),
        np.ones((1, 1, 3)),
        np.zeros((2, 500, 3)),
    ],
    ids=["plain", "noise", "ramp", "pixel", "thin"],
)
def test_what_has_no_object_is_refused(rgb):
    found = grabcut(rgb.astype(np.float32))
    assert np.isfinite(found).all() and fault_of(found) is not None
