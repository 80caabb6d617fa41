"""The rasterizer at realistic size against the float64 oracle: row by row, and pixels at the cuts.

Picture and gradient are compared pixel by pixel and Gaussian by Gaussian, with both cuts on. Where
float32 decides a cut otherwise than float64 the picture jumps: such pixels are counted, bounded,
and each must lie within rounding of a cut.
"""

import pytest
import torch
from helpers import assert_rel_rms
from test_rasterize import GRADIENT, NAMES, PICTURE, leaves, make, mapped

from gamba_warp.kernels.constants import ALPHA_MIN, T_MIN
from gamba_warp.kernels.rasterize import rasterization, reference

ROW = 1e-3  # of one Gaussian's gradient: a sum over few pixels, some of which cancel
ROWS = 0.999  # the share of Gaussians that must keep to it
FLIPS = 2e-4  # the share of pixels that may fall on the other side of a cut
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

    The others have alpha 0 at each of its pixels, so leaving them out changes no bit. On the way
    it notes how near each pixel comes to a cut.
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
        return torch.stack(self.views).view(like.shape[:-1])


@pytest.fixture
def one_thread():
    """The oracles' operations are too small to share: on a busy machine threads only wait."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def cuts(monkeypatch, one_thread):
    recorder = Cuts()
    monkeypatch.setattr(reference, "_blend", recorder)
    monkeypatch.setattr(reference, "_CHUNK", 10**9)  # the recorder cuts the picture itself
    return recorder


def both(scene, cuts, mode="RGB", antialiased=False, **options):
    """Leaves, renders and alphas of the rasterizer and of the oracle; flipped pixels; meta."""
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    kind = "antialiased" if antialiased else "classic"
    renders, alphas, meta = rasterization(**got, render_mode=mode, rasterize_mode=kind, **options)
    color, depth, alpha = reference.rasterization_reference(
        **want, antialiased=antialiased, **options
    )
    if mode.endswith("ED"):
        depth = depth / alpha.clamp_min(1e-10)
    expected = torch.cat([color, depth] if "+" in mode else [color], -1)
    assert alpha.mean() > 0.1 and expected.std() > 0.01, "the picture is empty"
    assert torch.isfinite(renders).all() and torch.isfinite(alphas).all()
    scale = expected.abs().amax((0, 1, 2, 3)).clamp_min(1.0)
    error = torch.maximum(
        ((renders - expected).abs() / scale).amax(-1), (alphas - alpha).abs()[..., 0]
    )
    flipped = error > PICTURE
    distance = cuts.distances(alpha)
    assert (distance[flipped] <= BAND).all(), (
        f"{(flipped & (distance > BAND)).sum()} pixels differ without a cut in reach, by up to "
        f"{error[distance > BAND].max():.3g}"
    )
    return (got, renders, alphas), (want, expected, alpha), flipped, meta


def assert_rows(got, want, name, least):
    """Rows are Gaussians, ``[rows, anything]``: errors one by one, and the same rows are zero."""
    error, size = (got - want).norm(dim=-1), want.norm(dim=-1)
    assert torch.equal(size == 0, got.norm(dim=-1) == 0), f"{name}: other rows are zero"
    relative = (error / size)[size > 0]
    assert len(relative) > 100, f"{name}: hardly a row has a gradient"
    share = (relative <= ROW).double().mean().item()
    assert share >= least, f"{name}: {share:.5f} of the rows are within {ROW}, {least} must be"


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


def ordinary(num=2000, **changes):
    return make(1, 2, num, width=96, height=80, **{"size": 0.02, **changes})


def opaque():
    scene = ordinary(1500, size=0.06)
    scene["opacities"] = 0.9 + 0.0999 * torch.rand(1, 1500)
    return scene


def flat():
    """Discs and needles of any length, as training makes them."""
    scene = ordinary()
    scene["scales"] = 0.02 * torch.exp(1.5 * torch.randn(1, 2000, 3))
    return scene


def wide():
    """Most Gaussians beside the picture or behind the camera, the Jacobian clamped for many."""
    scene = ordinary(size=0.1)
    scene["means"] = scene["means"] * 4
    scene["Ks"][..., 0, 0] *= 0.3
    scene["Ks"][..., 1, 1] *= 0.5
    return scene


SCENES = {
    "ordinary": (ordinary, dict(mode="RGB+D")),
    "antialiased": (lambda: ordinary(size=0.01), dict(mode="RGB+ED", antialiased=True)),
    "opaque": (opaque, dict(mode="RGB+ED")),
    "flat": (flat, dict()),
    "wide": (wide, dict(mode="RGB+D")),
    "without rotation": (lambda: dict(ordinary(), quats=None), dict(antialiased=True)),
}


@pytest.mark.parametrize("name", SCENES)
def test_realistic_size(cuts, name):
    build, options = SCENES[name]
    got, want, flipped, meta = both(build(), cuts, **options)
    assert flipped.float().mean() <= FLIPS, f"{flipped.sum()} pixels flipped"
    assert (cuts.distances(flipped[..., None]) < BAND).float().mean() < 0.02, "the band is too wide"
    assert meta["pairs"] > 5000
    assert_gradients(got, want, flipped)


def test_flips_only_at_alpha_min(cuts):
    """Each Gaussian is made to have alpha_min at one pixel to the last bit: about half flip."""
    num = 600
    scene = ordinary(num)
    meta = rasterization(**scene)[2]
    center = meta["means2d"][0, 0].double()
    a, k, e = meta["conics"][0, 0].double().unbind(-1)

    def q(d):
        return a * (d[:, 0] + k * d[:, 1]) ** 2 + e * d[:, 1] ** 2

    direction = torch.randn(num, 2, dtype=torch.float64)
    reach = ((6 + 4 * torch.rand(num)) / q(direction)).sqrt()[:, None]
    pixel = (center + reach * direction).floor() + 0.5
    opacity = ALPHA_MIN * torch.exp(0.5 * q(pixel - center))
    chosen = (opacity < 0.95) & ((pixel > 0) & (pixel < torch.tensor([96, 80]))).all(1)
    assert chosen.sum() > num / 2
    scene["opacities"] = torch.where(chosen, opacity, 0.5).float()[None]
    _, _, flipped, _ = both(scene, cuts)
    assert 0.1 * chosen.sum() < flipped[0, 0].sum() < chosen.sum()
    assert flipped[0, 1].sum() <= 2, "the other view has nothing at its cuts"


def test_flips_only_at_the_stop(cuts):
    """Four layers of 0.9 leave 1e-4, to rounding, at every pixel: some stop before the last one."""
    scene = ordinary(4, size=1.0)
    scene["means"] = 0.01 * torch.randn(1, 4, 3)
    scene["scales"] = torch.full((1, 4, 3), 100.0)
    scene["opacities"] = torch.full((1, 4), 0.900005)
    scene["colors"] = torch.rand(1, 4, 3)
    (_, _, alphas), (_, _, alpha), flipped, _ = both(scene, cuts)
    assert flipped.any() and (alphas - alpha).abs().max() < 1e-3


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("focal", [1.3, 0.3])
def test_oracle_by_finite_differences(one_thread, antialiased, focal):
    """Every entry of the oracle's Jacobian in float64; no pixel sits at a cut for this seed."""
    scene = mapped(make(1, 1, num=4, width=7, height=5, size=0.3), torch.Tensor.double)
    scene["means"] = scene["means"] * (1.0 if focal > 1 else 3.0)
    tensors = [scene[k][0].clone().requires_grad_() for k in NAMES[:5]]
    tensors.append(scene["viewmats"][0, 0].clone().requires_grad_())
    K = scene["Ks"][0, 0].clone()
    K[0, 0] = focal * 7

    def picture(means, quats, scales, opacities, colors, viewmat):
        inputs = (means, quats, scales, opacities, colors, viewmat, K, 7, 5)
        parts = reference.render_view(*inputs, alpha_min=1e-12, antialiased=antialiased)
        return torch.cat(parts, -1)

    assert picture(*tensors)[..., -1].mean() > 0.2
    assert torch.autograd.gradcheck(picture, tensors, eps=1e-6, atol=1e-6, rtol=1e-5)
