import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.views import around

from gamba_warp.conventions import over_another, over_background
from gamba_warp.eval.averages import intervals_of, mean_of
from gamba_warp.eval.shapes.metrics import surface_metrics
from gamba_warp.eval.shapes.protocol import PRESETS
from gamba_warp.eval.shapes.shape import Points
from gamba_warp.eval.views.compare import GroundTruth, Shown, compare, render_views
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import mask_iou, on_grounds, psnr, ssim
from gamba_warp.render import render

pytestmark = pytest.mark.usefixtures("one_thread")

DEFAULT = PRESETS["default"]


@pytest.mark.parametrize("size", [(11, 11), (33, 21), (64, 40)])
def test_ssim_and_psnr_equal_scikit_images(size):
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    a = torch.rand(2, *size, 3)
    b = (a + 0.2 * torch.randn_like(a)).clamp(0, 1)
    b[:, : size[0] // 2] = 1.0  # flat regions, as a white background is
    a[:, : size[0] // 3] = 1.0
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    options |= {"channel_axis": 2, "data_range": 1.0}
    pairs = [*zip(a.double().numpy(), b.double().numpy())]
    want = [structural_similarity(x, y, **options) for x, y in pairs]
    assert np.allclose(ssim(a, b).numpy(), want, rtol=0, atol=1e-9)
    want = [peak_signal_noise_ratio(x, y, data_range=1.0) for x, y in pairs]
    assert np.allclose(psnr(a, b).numpy(), want, rtol=0, atol=1e-9)


def test_mask_iou():
    a, b = torch.zeros(2, 4, 5, dtype=torch.bool), torch.zeros(2, 4, 5, dtype=torch.bool)
    a[0, :2], b[0, 1:3] = True, True
    assert mask_iou(a, b).tolist() == [1 / 3, 1]


@pytest.mark.parametrize("metric", [psnr, ssim, mask_iou])
def test_shapes_must_agree(metric):
    with pytest.raises(ValueError, match="shapes differ"):
        metric(torch.rand(12, 12, 3), torch.rand(12, 13, 3))


def test_small_images_have_no_ssim():
    with pytest.raises(ValueError, match="10x12"):
        ssim(torch.rand(12, 10, 3), torch.rand(12, 10, 3))


def test_surface_metrics_by_hand():
    one = Points(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 1], [0, 0, 1]]))
    two = Points(np.array([[0.0, 0, 0.03]]), np.array([[0.0, 0.6, -0.8]]))
    got = surface_metrics(one, two, replace(DEFAULT, thresholds=(0.02, 0.05)))
    far = math.sqrt(1 + 0.03**2)
    want = {"accuracy": (0.03 + far) / 2, "completeness": 0.03}
    want["chamfer"] = (want["accuracy"] + want["completeness"]) / 2
    want["chamfer_squared"] = ((0.03**2 + far**2) / 2 + 0.03**2) / 2
    for name, value in want.items():
        assert abs(got[name] - value) < 1e-6, name  # float32 search
    assert got["fscore"] == {"0.02": 0.0, "0.05": pytest.approx(2 / 3)}  # precision 1/2, recall 1
    assert got["normal_consistency"] == pytest.approx(0.8)


def test_means_pass_over_what_is_not_there():
    records = [
        {"name": "a", "x": 1, "nest": {"y": 2.0, "z": None}, "views": [1, 2], "closed": True},
        {"name": "b", "x": 3, "nest": {"y": None, "z": None}, "views": [1], "closed": False},
    ]
    assert mean_of(records) == {"x": 2.0, "nest": {"y": 2.0, "z": None}}


def test_interval_is_that_of_the_normal_law():
    """Of many objects: the mean, 1.96 standard errors to each side."""
    values = np.random.default_rng(3).normal(5, 2, 400)
    low, high = intervals_of([{"x": float(v)} for v in values])["x"]
    error = values.std() / 20
    # quantiles of 10,000 resamples have a standard error of 0.02 standard errors here
    assert abs((values.mean() - low) / error - 1.96) < 0.15
    assert abs((high - values.mean()) / error - 1.96) < 0.15


def test_interval_of_few_objects():
    records = [{"x": 1.0, "nest": {"y": None, "on": True}}, {"x": 1.0, "nest": {"y": 2.0}}]
    got = intervals_of(records)
    assert got == {"x": [1.0, 1.0], "nest": {"y": None}}
    assert intervals_of(records[:1])["x"] is None and intervals_of([]) == {}
    two = [{"x": 0.0}, {"x": 1.0}]
    assert intervals_of(two) == {"x": [0.0, 1.0]}  # a quarter of the draws each
    many = [{"x": float(i)} for i in range(1500)]  # several batches
    assert intervals_of(many) == intervals_of(many)


# On black and on grey beside white: floaters that white hides are seen.

SIZE, VIEWS = 32, 3


def cameras():
    return around(torch.arange(VIEWS) * 70.0)


def test_one_rendering_serves_all_grounds():
    """Compositing by alpha equals rendering on that background."""
    colors = torch.tensor([[0.9, 0.1, 0.1], [0.2, 0.9, 0.4]])
    scales = torch.tensor([0.08, 0.16])[:, None].expand(-1, 3)
    scene = Gaussians(torch.zeros(2, 3), None, scales, torch.tensor([0.95, 0.2]), colors)
    shown = render_views(scene, cameras())
    for grey in (1.0, 0.5, 0.0):
        with torch.no_grad():
            drawn = render(scene, cameras(), torch.full((3,), grey)).rgb
        assert (shown.on(grey) - drawn).abs().max() < 1e-6
    rgba = torch.rand(2, 5, 6, 4)
    turned = over_another(over_background(rgba, 1.0), rgba[..., 3:], 1.0, 0.5)
    assert (turned - over_background(rgba, 0.5)).abs().max() < 1e-6


def test_known_values_on_each_ground():
    """A flat half-covered image, off by known amounts: by colour on white, by alpha elsewhere."""
    images = torch.tensor([1.0, 1.0, 1.0, 0.5]).expand(2, SIZE, SIZE, 4).clone()
    gt = GroundTruth("a", images, cameras(), [0, 1])
    # White at a lesser alpha: nothing is wrong on white, (1 - grey) * 0.25 elsewhere.
    hazy = Shown(torch.ones(2, SIZE, SIZE, 3), torch.full((2, SIZE, SIZE), 0.25))
    values = compare({"hazy": hazy, "opaque": hazy._replace(alpha=None)}, gt)
    for view in values["hazy"]:
        assert view["psnr"] == 100
        assert view["psnr_black"] == pytest.approx(-20 * math.log10(0.25), abs=1e-5)
        assert view["psnr_grey"] == pytest.approx(-20 * math.log10(0.125), abs=1e-5)
    assert values["opaque"][0]["psnr"] == 100
    assert {values["opaque"][0][key] for key in on_grounds()} == {None}
