"""Augmented views stay consistent: those of another object, seen by its own cameras."""

import numpy as np
import torch
from helpers.gaussians import some

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.data.dataset import ObjectViews
from gamba_warp.render import render
from gamba_warp.train.data.samples import MAX_GAMMA, Change, draw_change, mirrored


def views(seed: int = 0) -> ObjectViews:
    """Three odd-sized views of a few Gaussians, with a principal point off the middle."""
    K = intrinsics(37, 29)
    K[0, 2] += 3.3
    cameras = Cameras(orbit(torch.tensor([0.0, 70, 200]), 20.0), K.expand(3, 3, 3), 37, 29)
    shown = render(gaussians(seed), cameras, depth=True)
    rgba = torch.cat([shown.rgb, shown.alpha], -1).clamp(0, 1)
    return ObjectViews("some", "some", rgba, cameras, shown.depth[..., 0], {})


def gaussians(seed: int):
    torch.manual_seed(seed)
    return some(9)


def test_a_mirrored_object_seen_by_mirrored_cameras_is_the_mirrored_image():
    made, object_ = mirrored(views()), gaussians(0)
    object_.means = object_.means * torch.tensor([-1.0, 1.0, 1.0])
    # M R(q) M: a rotation about an axis with the same x and negated y and z.
    object_.quats = object_.quats * torch.tensor([1.0, 1.0, -1.0, -1.0])
    shown = render(object_, made.cameras, depth=True)
    # The same sums in another order of pixels and depths.
    torch.testing.assert_close(made.images[..., :3], shown.rgb, atol=2e-5, rtol=0)
    torch.testing.assert_close(made.depths, shown.depth[..., 0], atol=2e-4, rtol=1e-4)
    assert torch.linalg.det(made.cameras.viewmats[:, :3, :3]).gt(0.999).all()
    again = mirrored(made)
    torch.testing.assert_close(again.images, views().images)
    torch.testing.assert_close(again.cameras.Ks, views().cameras.Ks)


def test_colours_change_places_and_gamma_and_alpha_stays():
    before = views()
    after = Change(channels=(2, 0, 1), gamma=1.3)(before)
    torch.testing.assert_close(after.images[..., 0], before.images[..., 2] ** 1.3)
    torch.testing.assert_close(after.images[..., 3], before.images[..., 3])
    assert Change()(before).images.equal(before.images)


def test_chances_are_kept_and_do_not_touch_each_other():
    drawn = [draw_change(np.random.default_rng([7, n]), 0.5, 0.25) for n in range(400)]
    assert 160 < sum(change.flip for change in drawn) < 240
    changed = [change for change in drawn if change.gamma != 1]
    assert 70 < len(changed) < 130
    assert all(1 / MAX_GAMMA <= change.gamma <= MAX_GAMMA for change in changed)
    darker = sum(change.gamma > 1 for change in changed)
    assert 0.35 < darker / len(changed) < 0.65, "as many become darker as brighter"
    assert min(c.gamma for c in changed) < 0.7 and max(c.gamma for c in changed) > 1.43
    assert {change.channels for change in changed} >= {(0, 2, 1), (2, 1, 0)}
    plain = [draw_change(np.random.default_rng([7, n]), 0.5, 0.0) for n in range(400)]
    assert [change.flip for change in plain] == [change.flip for change in drawn]
    assert all(change.gamma == 1 for change in plain)
