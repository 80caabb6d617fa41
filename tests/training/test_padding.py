"""Lists of a few lengths: the loss and gradients of padded batches."""

from dataclasses import replace

import pytest
import torch
from helpers.micro import views_around
from helpers.model import NOTHING, cut_outs, micro

from gamba_warp.cameras import Cameras
from gamba_warp.data.dataset import open_dataset
from gamba_warp.files import STARTER
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.patches import find_foreground
from gamba_warp.train.data.samples import Batch, with_foreground
from gamba_warp.train.step import Objective, forward

WEIGHTS = {"rgb": 1.0, "mask": 1.0, "mask_l1": 0.5, "translucency": 0.2, "depth": 0.5}
WHOLE = slice(None)


def batch_of(config, boxes):
    """A batch of noise in some boxes of the inputs, with three random views of 16 x 12 each."""
    rgba, cameras = cut_outs(boxes)
    views = views_around(3, 16, 12)
    many = (len(boxes), 3)
    seen = Cameras(views.viewmats.expand(*many, 4, 4), views.Ks.expand(*many, 3, 3), 16, 12)
    side = config.image_size
    targets, grounds = torch.rand(*many, 12, 16, 4), torch.rand(len(boxes), 1, 3)
    surfaces = 1.5 + torch.rand(len(boxes), 2, side, side)
    uids = [*"abcdefgh"[: len(boxes)]]
    return with_foreground(Batch(uids, rgba, cameras, targets, seen, grounds, surfaces), config)


@pytest.mark.parametrize(
    "boxes",
    [
        [(slice(3, 7), slice(2, 5)), NOTHING, (slice(1, 8), WHOLE)],
        [(slice(2, 3), slice(5, 6))],
        [(WHOLE, WHOLE), NOTHING],
        [NOTHING],
    ],
    ids=["some", "one", "full", "empty"],
)
def test_a_padded_batch_has_the_same_loss_and_gradients(boxes):
    torch.manual_seed(7)
    config = micro(decoder="rays", encoder="none", ray_cells=2, ray_layers=3, ray_features=5)
    model = Gamba(config)
    torch.nn.init.normal_(model.decoder.head.weight, std=0.5)
    padded = batch_of(config, boxes)
    batch = replace(padded, foreground=find_foreground(padded.inputs[..., 3], config))
    made = []
    for given in (batch, padded):
        model.zero_grad()
        result = forward(model, given, Objective(WEIGHTS))
        result.loss.backward()
        grads = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
        made.append((result, grads))
    (plain, wanted), (other, got) = made
    assert other.gaussians.num > plain.gaussians.num
    assert got.keys() == wanted.keys()
    # Sums of float32 in another order: padding changes where a scan is cut.
    torch.testing.assert_close(other.loss, plain.loss, rtol=1e-6, atol=0)
    torch.testing.assert_close(other.rgb, plain.rgb, rtol=0, atol=1e-6)
    for name, want in wanted.items():
        scale = want.abs().max().item()
        torch.testing.assert_close(got[name], want, rtol=1e-5, atol=1e-6 * scale, msg=name)


def test_padding_has_few_lengths_and_little_waste():
    """In the mean over batches of 64 objects at most 5 % more tokens and cells."""
    config, data = PRESETS["rays"], open_dataset(STARTER / "data", "train")
    found = [data.load(i, [0, 3], 128, 0).images[..., 3] for i in range(len(data))]
    alphas, lengths, more = torch.cat(found), set(), []
    for _ in range(20):
        plain = find_foreground(alphas[torch.randint(len(alphas), (64,))], config)
        padded = plain.padded(config.ray_cells**2)
        pairs = [(len(f.tokens), len(f.number)) for f in (plain, padded)]
        more.append([b / a - 1 for a, b in zip(*pairs)])
        lengths.add((*pairs[1], padded.most))
    assert len(lengths) <= 12
    assert max(torch.tensor(more).mean(0).tolist()) <= 0.05
