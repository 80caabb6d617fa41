"""The rasterizer against its oracle pixel by pixel and Gaussian by Gaussian, at realistic sizes.

``Cuts`` makes the dense oracle fast enough and records the distance of each pixel from a cut (alpha
from alpha_min, T from its limit), where rounding decides; ``both`` and ``assert_gradients``
compare.
"""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import GRADIENT, IMAGE, NAMES, rendered

from gamba_warp.kernels.rasterize import reference
from gamba_warp.kernels.rasterize.constants import T_MIN

ROW = 1e-3  # of one Gaussian's gradient: a sum over few pixels, some of which cancel
ROWS = 0.999  # the fraction of Gaussians that must keep to it
BAND = 5e-5  # relative: rounding of q <= 11.1, of 1e-6 pixels of mean2d over half a pixel of sigma
COTANGENTS = 2  # one number per Gaussian may cancel under one of them, hardly under both


def to_the_cuts(raw, alpha_min, alpha_max):
    """Relative distance of each pixel from its nearest cut: alpha to alpha_min or T to T_MIN."""
    alpha = torch.where(raw >= alpha_min, raw.clamp_max(alpha_max), 0.0)
    after = torch.cumprod(1 - alpha, 1)
    going = torch.nn.functional.pad(after, (1, 0), value=1.0)[:, :-1] > T_MIN
    from_alpha = torch.where(going, (raw / alpha_min - 1).abs(), torch.inf)
    from_stop = torch.where(going & (alpha > 0), (after / T_MIN - 1).abs(), torch.inf)
    none = raw.new_full((len(raw), 1), torch.inf)
    return torch.cat([from_alpha, from_stop, none], 1).amin(1)


def alphas_in_reach(mean2d, conic, opacity, pixels, alpha_min):
    """Alpha before any cut, ``[pixels, n]``, of the n Gaussians that come near alpha_min here."""
    # q >= d² / (trace of the covariance), and the inverse of a 2 x 2 matrix has trace / det
    size = conic.diagonal(dim1=1, dim2=2).sum(1) / torch.linalg.det(conic)
    low, high = pixels.amin(0), pixels.amax(0)
    far = (mean2d - mean2d.clamp(low, high)).square().sum(1)
    near = (far <= 2 * torch.log(opacity / (0.9 * alpha_min)) * size).nonzero()[:, 0]
    (x, y), c = (pixels[:, None] - mean2d[near]).unbind(-1), conic[near]
    q = c[:, 0, 0] * x * x + 2 * c[:, 0, 1] * x * y + c[:, 1, 1] * y * y
    raw = opacity[near] * torch.exp(-0.5 * q)
    reach = (raw >= 0.9 * alpha_min).any(0)
    return near[reach], raw[:, reach]


class Cuts:
    """The oracle's blending in blocks of 8 x 8 pixels, each with the Gaussians that reach a pixel.

    The others have alpha 0 at each of its pixels, so leaving them out changes no bit. The distance
    of each pixel from its nearest cut is recorded.
    """

    def __init__(self):
        self.blend = reference._blend
        self.views = []

    def __call__(self, mean2d, conic, opacity, channels, pixels, alpha_min, alpha_max, t_min):
        key = (pixels // 8).long() @ torch.tensor([1, 100_000])
        order = torch.argsort(key, stable=True)
        out = []
        for index in order.split(torch.unique(key, return_counts=True)[1].tolist()):
            with torch.no_grad():
                reach, raw = alphas_in_reach(mean2d, conic, opacity, pixels[index], alpha_min)
                distance = to_the_cuts(raw, alpha_min, alpha_max)
            chosen = (x[reach] for x in (mean2d, conic, opacity, channels))
            blended = self.blend(*chosen, pixels[index], alpha_min, alpha_max, t_min)
            out.append((*blended, distance))
        back = torch.argsort(order)
        blended, alpha, distance = (torch.cat(parts)[back] for parts in zip(*out))
        self.views.append(distance)
        return blended, alpha

    def distances(self, like):
        """Distance of each pixel from its nearest cut, shaped as an image without channels."""
        return torch.stack(self.views).view(like.shape[:-1])


@pytest.fixture
def cuts(monkeypatch, one_thread):
    """Make the oracle blend by blocks and record the cuts."""
    recorder = Cuts()
    monkeypatch.setattr(reference, "_blend", recorder)
    monkeypatch.setattr(reference, "_CHUNK", 10**9)  # the recorder cuts the image itself
    return recorder


def both(scene, cuts, mode="RGB", antialiased=False, **options):
    """Leaves, renders and alphas of the rasterizer and of the oracle; flipped pixels; meta."""
    ours, theirs, meta = rendered(scene, mode, antialiased, **options)
    (_, renders, alphas), (_, expected, alpha) = ours, theirs
    assert torch.isfinite(renders).all() and torch.isfinite(alphas).all()
    scale = expected.abs().amax((0, 1, 2, 3)).clamp_min(1.0)
    error = torch.maximum(
        ((renders - expected).abs() / scale).amax(-1), (alphas - alpha).abs()[..., 0]
    )
    flipped = error > IMAGE
    distance = cuts.distances(alpha)
    assert (distance[flipped] <= BAND).all(), (
        f"{(flipped & (distance > BAND)).sum()} pixels differ without a cut in reach, by up to "
        f"{error[distance > BAND].max():.3g}"
    )
    return ours, theirs, flipped, meta


def assert_rows(got, want, name, least):
    """Rows are Gaussians, ``[rows, anything]``: errors one by one, and the same rows are zero."""
    error, size = (got - want).norm(dim=-1), want.norm(dim=-1)
    assert torch.equal(size == 0, got.norm(dim=-1) == 0), f"{name}: other rows are zero"
    relative = (error / size)[size > 0]
    assert len(relative) > 100, f"{name}: hardly a row has a gradient"
    fraction = (relative <= ROW).double().mean().item()
    assert fraction >= least, (
        f"{name}: {fraction:.5f} of the rows are within {ROW}, {least} must be"
    )


def assert_gradients(got, want, flipped, least=ROWS):
    """All gradients under random cotangents, zero at flipped pixels."""
    (got, *outputs), (want, *expected) = got, want
    gathered = {name: ([], []) for name in NAMES}
    for _ in range(COTANGENTS):
        v = [torch.randn_like(x) * ~flipped[..., None] for x in outputs]
        for tensors, results, side in ((got, outputs, 0), (want, expected, 1)):
            asked = {k: tensors[k] for k in NAMES if tensors[k] is not None}
            v_side = [c.to(results[0].dtype) for c in v]
            grads = torch.autograd.grad(results, list(asked.values()), v_side, retain_graph=True)
            for name, grad in zip(asked, grads):
                gathered[name][side].append(grad.double())
    for name, (a, b) in gathered.items():
        if not a:
            continue
        a, b = torch.stack(a, -1), torch.stack(b, -1)
        assert_rel_rms(a, b, GRADIENT, name)
        if name in NAMES[:5]:
            rows = got["opacities"].numel()
            assert_rows(a.reshape(rows, -1), b.reshape(rows, -1), name, least)
