"""Colours from spherical harmonics: the kernels of both devices against the formula in float64."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_rel_rms, assert_same_on_threads

from gamba_warp.kernels.rasterize import harmonics
from gamba_warp.kernels.rasterize.harmonics import autograd, colors_seen_from, cpu, cuda, formula
from gamba_warp.kernels.rasterize.harmonics.formula import colors_by_formula

NAMES = ("coefficients", "means", "centers")
# float32 sums of up to 25 terms; the gradient by a centre adds up 300 Gaussians
FORWARD, GRADIENT = 3e-7, 1e-6


@pytest.fixture(params=["cpu", "cuda"])
def device(request, monkeypatch):
    """The kernels of both devices; those of CUDA have no blocks, so a CPU runs them as they are."""
    kernels = {"cpu": cpu, "cuda": cuda}[request.param]
    monkeypatch.setattr(autograd, "_kernels", lambda device: kernels)


def make(batch=2, views=3, num=37, extra=0, channels=3, degree=3, per_view=False):
    """Coefficients, means and centers; some colours are clamped."""
    lead = (batch, views) if per_view else (batch,)
    shape = *lead, num, (degree + 1) ** 2 + extra, channels
    return {
        "coefficients": 1.6 / (degree + 1) * torch.randn(shape),
        "means": torch.randn(batch, num, 3),
        "centers": 2 * torch.randn(batch, views, 3),
    }


def run(function, degree, inputs, v=None, dtype=torch.float32):
    """The colours, and gradients by name under v, or one that repeats; None where there is none."""
    inputs = {k: x.detach().to(dtype, copy=True).requires_grad_() for k, x in inputs.items()}
    colors = function(degree, *inputs.values())
    if v is None:
        v = torch.randn(colors.shape, generator=torch.Generator().manual_seed(1))
    v = v.to(colors)
    grads = torch.autograd.grad(colors, list(inputs.values()), v, allow_unused=True)
    return colors.detach(), dict(zip(inputs, grads))


def both(degree, inputs, v=None):
    """Results of ``run`` for the kernels and for the formula."""
    return (run(f, degree, inputs, v) for f in (colors_seen_from, colors_by_formula))


def check(degree, inputs, ours=colors_seen_from, oracle=colors_by_formula):
    """Colours, or bare sums, and all gradients against the formula in float64."""
    shape = *inputs["centers"].shape[:2], inputs["means"].shape[1], inputs["coefficients"].shape[-1]
    v = torch.randn(shape)
    # where rounding decides whether a colour is clamped, the gradient is either
    v[(terms(degree, inputs).sum(-2) + 0.5).abs() < 1e-6] = 0
    got, grads = run(ours, degree, inputs, v)
    want, expected = run(oracle, degree, inputs, v, torch.float64)
    # a colour is ½ more than its sum, whose terms are larger than itself
    size = want if ours is colors_seen_from else terms(degree, inputs).abs().sum(-2)
    assert (got - want).abs().max() <= FORWARD * size.abs().max()
    for name in NAMES:
        if expected[name] is None:  # degree 0 does not see the direction
            assert degree == 0 and not grads[name].any(), name
        else:
            assert_rel_rms(grads[name], expected[name], GRADIENT, name)
    return want


def terms(degree, inputs):
    """Y_k c_k in float64, ``[B, V, N, K, D]``."""
    x = {k: v.double() for k, v in inputs.items()}
    used = x["coefficients"][..., : (degree + 1) ** 2, :]
    used = used if used.dim() == 5 else used[:, None]
    directions = F.normalize(x["means"][:, None] - x["centers"][:, :, None], dim=-1)
    return formula.harmonics_basis(degree, directions)[..., None] * used


@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_colours_and_gradients(device, degree, per_view):
    """37 Gaussians are two groups of lanes and five, and rows are longer than what is used."""
    want = check(degree, make(degree=degree, extra=2, per_view=per_view))
    assert 0.05 < (want == 0).double().mean() < 0.5, "some are clamped, most are not"


@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_bare_sums_and_gradients(device, degree, per_view):
    """Nothing is added and nothing clamped: sums below 0 stay, and pass their gradient on."""
    inputs = make(degree=degree, extra=1, per_view=per_view)
    want = check(degree, inputs, harmonics.sums_seen_from, formula.sums_by_formula)
    assert 0.2 < (want < -0.1).double().mean() < 0.7
    inputs["means"][1, 5, 0] = math.nan
    got, grads = run(harmonics.sums_seen_from, degree, inputs)
    assert got[1, :, 5].isnan().all() and got.isnan().sum() == 3 * 3
    assert all(g.isfinite().all() for g in grads.values())


@pytest.mark.parametrize("num", [1, 16, 257, 300])
def test_sizes(device, num):
    """One Gaussian, a full group, one Gaussian in the second chunk; rows end with the memory."""
    check(3, make(num=num))
    check(3, make(1, 1, num=num))


@pytest.mark.parametrize("channels", [1, 2, 5, 17, 64])
def test_channels(device, channels):
    check(2, make(1, 2, num=33, channels=channels))
    check(2, make(1, 2, num=33, channels=channels, per_view=True))


def test_many_channels_take_the_formula(device, monkeypatch):
    monkeypatch.delattr(cpu, "forward_kernel")
    monkeypatch.delattr(cuda, "forward_kernel")
    check(1, make(1, 1, num=5, channels=65))


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_gradients_are_differences(degree):
    """The formula's own gradients, the oracle of the above, by central differences in float64."""
    inputs = make(1, 2, num=3, degree=degree)
    inputs["coefficients"] *= 0.1  # nothing near the clamp
    inputs = [x.double().requires_grad_() for x in inputs.values()]
    assert torch.autograd.gradcheck(lambda *x: colors_by_formula(degree, *x), inputs)


@pytest.mark.parametrize("name", NAMES)
def test_a_gradient_alone_has_the_same_bits(device, name):
    inputs, v = make(), torch.randn(2, 3, 37, 3)
    _, every = run(colors_seen_from, 3, inputs, v)
    x = inputs[name].requires_grad_()
    (alone,) = torch.autograd.grad(colors_seen_from(3, *inputs.values()), x, v)
    assert torch.equal(alone, every[name])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "coefficients"])
@pytest.mark.parametrize("degree", [0, 2])
def test_what_is_not_finite(device, degree, name, value):
    """Its colours are NaN and have no gradient; the others are as if it were not there."""
    inputs = make(degree=degree, extra=1, per_view=name == "coefficients")
    want, expected = run(colors_seen_from, degree, inputs)
    if name == "coefficients":
        inputs[name][1, 2, 5, (degree + 1) ** 2 - 1, 1] = value
        inputs[name][0, 0, 7, -1, 0] = value  # beyond the degree: not used
    else:
        inputs[name][1, 5, 2] = value
    (got, grads), (_, theirs) = both(degree, inputs)
    bad = torch.zeros(2, 3, 37, dtype=torch.bool)
    bad[1, 2 if name == "coefficients" else slice(None), 5] = True
    assert got[bad].isnan().all() and torch.equal(got[~bad], want[~bad])
    assert all(g.isfinite().all() for g in grads.values())
    none = grads["coefficients"][1, 2, 5] if name == "coefficients" else grads["means"][1, 5]
    assert not none.any()
    for each in NAMES:
        if theirs[each] is not None:
            assert_rel_rms(grads[each], theirs[each], GRADIENT, each)
    assert torch.equal(grads["means"][0], expected["means"][0])


def test_sums_beyond_float32(device):
    """Finite coefficients whose sum is not: the sum is shown, as the formula does."""
    inputs = make(1, 1, num=4, degree=1)
    inputs["coefficients"][0, 1] = 3.3e38
    inputs["means"][0, 1] = torch.tensor([-1.0, -1, 1]) + inputs["centers"][0, 0]
    (got, grads), (want, expected) = both(1, inputs)
    assert torch.isinf(want).any() and torch.equal(got.isinf(), want.isinf())
    assert_rel_rms(grads["coefficients"], expected["coefficients"], GRADIENT, "coefficients")


def test_a_centre_that_is_not_finite(device):
    """Its view is NaN and passes no gradient on; the other views keep theirs."""
    inputs, v = make(1, 2), torch.randn(1, 2, 37, 3)
    inputs["centers"][0, 1, 0] = math.nan
    got, grads = run(colors_seen_from, 3, inputs, v)
    assert got[0, 1].isnan().all() and got[0, 0].isfinite().all()
    alone = {**inputs, "centers": inputs["centers"][:, :1]}
    want, expected = run(colors_seen_from, 3, alone, v[:, :1])
    assert torch.equal(got[:, :1], want) and torch.equal(grads["means"], expected["means"])
    assert not grads["centers"][0, 1].any()


@pytest.mark.parametrize("name", ["means", "centers"])
def test_bare_sums_of_the_last_that_is_not_finite(device, name):
    """Nor do lanes without a Gaussian pass a gradient on."""
    inputs = make(1, 2)
    inputs[name][0, -1, 0] = math.nan
    got, grads = run(harmonics.sums_seen_from, 3, inputs)
    assert got.isnan().any() and all(g.isfinite().all() for g in grads.values())


@pytest.mark.parametrize("distance", [0.0, 1e-13, 1e-25])
def test_no_direction(device, distance):
    """A mean in the centre, or nearer than 1e-12, which then divides in place of the length."""
    inputs = make(1, 1, num=5, degree=4)
    inputs["centers"][:] = 0
    inputs["means"][0, 3] = distance
    (got, grads), (want, expected) = both(4, inputs)
    assert (got - want).abs().max() < 1e-6
    for name in NAMES:
        assert_rel_rms(grads[name], expected[name], GRADIENT, name)
    assert expected["means"][0, 3].abs().max() > 1e10


def test_the_clamp_at_zero(device):
    """Neither a colour of exactly 0 nor one below passes its gradient on: as torch's clamp_min."""
    inputs = make(1, 1, num=2, degree=1)
    inputs["coefficients"].zero_()
    near = -0.5 / 0.28209479177387814 + 1.2e-7 * torch.arange(-4, 5)
    black = near[near * 0.28209479177387814 == -0.5][0].item()
    inputs["coefficients"][0, 0, 0] = torch.tensor([black, 1.001 * black, 0.0])
    (got, grads), (want, expected) = both(1, inputs, torch.ones(1, 1, 2, 3))
    assert torch.equal(got, want) and got[0, 0, 0, 0] == 0 == got[0, 0, 0, 1]
    assert torch.equal(grads["coefficients"], expected["coefficients"])
    assert (grads["coefficients"][0, 0, 0] != 0).tolist() == [False, False, True]


def test_a_gradient_of_nan(device):
    """NaN stays with its Gaussian, and a clamped channel does not see it."""
    inputs = make(1, 2, num=20)
    colors = colors_seen_from(3, *inputs.values())
    shown = (colors[0, 0] > 0).all(-1).nonzero()[0].item()
    clamped = (colors[0, 0] == 0).nonzero()[0].tolist()
    v = torch.randn(1, 2, 20, 3)
    v[0, 0, clamped[0], clamped[1]] = math.nan
    _, grads = run(colors_seen_from, 3, inputs, v)
    assert all(g.isfinite().all() for g in grads.values())
    v[0, 0, shown, 1] = math.nan
    _, grads = run(colors_seen_from, 3, inputs, v)
    rows = grads["means"].isnan().any(-1)[0].nonzero().flatten().tolist()
    assert rows == [shown] and grads["coefficients"][0, shown, :, 1].isnan().all()
    assert grads["coefficients"].isnan().sum() == 16


def test_nothing_to_see():
    for batch, views, num in ((2, 0, 5), (2, 3, 0), (0, 1, 5)):
        inputs = make(batch, views, num=num)
        got, grads = run(colors_seen_from, 3, inputs)
        assert got.shape == (batch, views, num, 3)
        for name, g in grads.items():
            assert g.shape == inputs[name].shape and not g.any()


@pytest.mark.parametrize("per_view", [False, True])
def test_any_number_of_threads(per_view):
    """The same bits, twice and from one thread to four: 9 chunks of Gaussians."""
    inputs = make(1, 3, num=2100, per_view=per_view)

    def made():
        colors, grads = run(colors_seen_from, 3, inputs)
        return colors, *grads.values()

    assert_same_on_threads(made, 1, 2, 2, 4)


def test_strides_and_dtypes():
    """Strided inputs become dense; float64 and half precision take the formula, in their dtype."""
    inputs = make(1, 2)
    want = colors_seen_from(3, *inputs.values())
    turned = {k: x.transpose(-1, -2).contiguous().transpose(-1, -2) for k, x in inputs.items()}
    assert torch.equal(colors_seen_from(3, *turned.values()), want)
    for dtype, limit in ((torch.float64, 1e-6), (torch.bfloat16, 0.1)):
        got = colors_seen_from(3, *(x.to(dtype) for x in inputs.values()))
        assert got.dtype == dtype and (got - want).abs().max() < limit


def test_once_differentiable():
    """As the other operators: a second derivative is refused in words. In float64 there is one."""
    inputs = make(1, 1, num=3)
    for dtype in (torch.float32, torch.float64):
        means = inputs["means"].detach().to(dtype).requires_grad_()
        rest = inputs["coefficients"].to(dtype).requires_grad_(), inputs["centers"].to(dtype)
        colors = colors_seen_from(3, rest[0], means, rest[1])
        (g,) = torch.autograd.grad(colors.sum(), means, create_graph=True)
        if dtype == torch.float64:
            g.square().sum().backward()
            assert means.grad.any()
        else:
            with pytest.raises(RuntimeError, match="autograd"):
                g.square().sum().backward()


def test_the_compiler_and_meta_tensors():
    inputs = make(1, 2)
    given = 3, True, *(x.requires_grad_() for x in inputs.values())
    checks = ("test_schema", "test_faketensor", "test_autograd_registration")
    operator = torch.ops.gamba_warp.rasterize_harmonics.default
    torch.library.opcheck(operator, given, test_utils=checks)
    meta = colors_seen_from(3, *(x.to("meta") for x in inputs.values()))
    assert meta.shape == (1, 2, 37, 3) and meta.device.type == "meta"


def test_cameras_and_their_centres():
    """``colors_from_harmonics`` sees from where the camera stands, with its gradient."""
    inputs = make(1, 2)
    rotation = torch.linalg.qr(torch.randn(1, 2, 3, 3))[0]
    viewmats = torch.eye(4).repeat(1, 2, 1, 1)
    viewmats[..., :3, :3] = rotation
    viewmats[..., :3, 3] = -(rotation @ inputs["centers"][..., None])[..., 0]
    viewmats.requires_grad_()
    got = harmonics.colors_from_harmonics(3, inputs["coefficients"], inputs["means"], viewmats)
    want = colors_seen_from(3, *inputs.values())
    assert (got - want).abs().max() < 1e-6
    v = torch.randn_like(got)
    got.backward(v)
    exact = viewmats.detach().double().requires_grad_()
    doubles = [inputs[k].double() for k in ("coefficients", "means")]
    harmonics.colors_from_harmonics(3, *doubles, exact).backward(v.double())
    assert_rel_rms(viewmats.grad, exact.grad, GRADIENT, "viewmats")


@pytest.mark.gpu
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_on_a_gpu(degree):
    inputs = make(2, 3, num=300, degree=degree, extra=1)
    want, expected = run(colors_seen_from, degree, inputs)
    there = {k: x.cuda() for k, x in inputs.items()}
    (got, grads), (again, twice) = (run(colors_seen_from, degree, there) for _ in range(2))
    assert torch.equal(got, again) and (got.cpu() - want).abs().max() < 1e-6 * want.max()
    for name in NAMES:
        assert torch.equal(grads[name], twice[name]), name
        assert_rel_rms(grads[name].cpu(), expected[name], 10 * GRADIENT, name)
