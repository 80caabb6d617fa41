"""The whole network: shapes, gradients, ablations, sizes of the presets."""

import pytest
import torch
from helpers import assert_default_dtype_changes_nothing, assert_rel_rms
from helpers.model import FIELDS, inputs, micro
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba


def test_images_of_a_batch_do_not_mix():
    model = Gamba(micro(), "random")
    images, cameras = inputs(3)
    together = model(images, cameras)
    alone = model(images[1:2], cameras[1:2])
    # Matrix products of another size sum in another order.
    assert torch.allclose(together.means[1], alone.means[0], atol=1e-5)


def test_image_and_camera_reach_the_output_by_the_prefix_alone():
    model = Gamba(micro(additive_image_tokens=False), "random")
    images, cameras = inputs(1)
    base = model(images, cameras).means
    assert (model(1 - images, cameras).means - base).abs().max() > 1e-6
    other = Cameras(orbit(torch.tensor([90.0]), 40.0), cameras.Ks, 12, 12)
    assert (model(images, other).means - base).abs().max() > 1e-6


def test_without_prefix_and_image_tokens_the_image_is_ignored():
    model = Gamba(micro(additive_image_tokens=False, prepend=False))
    images, cameras = inputs(1)
    assert torch.equal(model(images, cameras).means, model(1 - images, cameras).means)


@pytest.mark.parametrize("changes", [{}, {"prepend": False}], ids=str)
def test_condition_can_be_kept(changes):
    model = Gamba(micro(**changes), None if changes else "random").eval()
    images, cameras = inputs(2)
    with torch.no_grad():
        condition = model.condition(images, cameras)
        assert len(condition) == 2 and (condition[0] is None) == bool(changes)
        want = model(images, cameras)
        for _ in range(2):  # reuse gives the same result
            assert torch.equal(model(images, cameras, condition).means, want.means)
        if not changes:
            with torch.autocast("cpu", torch.bfloat16):  # the condition is float32
                rounded = model(images, cameras, condition).means
            assert_rel_rms(rounded, want.means, 0.1, "bfloat16")  # 8 bits, through two blocks
            other = model.condition(1 - images, cameras)
            assert not torch.equal(model(images, cameras, other).means, want.means)


def test_segments_change_nothing(monkeypatch):
    model = Gamba(micro(encoder="none"))
    images, cameras = inputs(2)
    want = model(images, cameras)  # with a gradient: in one piece
    calls = []
    model.blocks[0].register_forward_hook(lambda _, args, out: calls.append(args[0].shape[1]))
    monkeypatch.setattr("gamba_warp.model.parts.block.SEGMENT", 16)
    with torch.no_grad():
        got = model(images, cameras)
    assert calls == [16, 16, 4]
    # Matrix products of another size sum in another order.
    assert_rel_rms(got.means, want.means, 1e-6, "means")


def test_recomputation_changes_memory_alone():
    model = Gamba(micro(image_size=32, width=32, depth=6), "random")
    images, cameras = inputs(2, 32)
    cotangent = torch.randn(2, 256, 3)

    def step(checkpointing: bool) -> tuple[int, dict[str, torch.Tensor]]:
        model.checkpointing, kept = checkpointing, {}

        def pack(tensor):
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        model.zero_grad()
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            loss = (model(images, cameras).means * cotangent).sum()
        saved = sum(kept.values())
        loss.backward()
        return saved, {n: p.grad for n, p in model.named_parameters() if p.grad is not None}

    plain, want = step(False)
    lean, got = step(True)
    assert lean < 0.35 * plain, (lean, plain)
    assert got.keys() == want.keys()
    for name, grad in want.items():
        assert torch.equal(got[name], grad), name


def test_flags_against_weight_decay():
    model = Gamba(micro(), "random")
    kept = {n for n, p in model.named_parameters() if not getattr(p, "_no_weight_decay", False)}
    kept = {name for name in kept if not name.startswith("encoder.")}
    matrices = ("_proj.weight", "conv_weight", "project_camera.weight", "project_image.weight")
    rest = ("patchify.weight", "mlp.0.weight", "mlp.2.weight")
    heads = tuple(f"decoder.{head}.weight" for head in ("position", "opacity", "scale", "color"))
    assert kept and all(name.endswith(matrices + rest + heads) for name in kept), kept


@pytest.mark.parametrize(
    "name, value",
    [
        ("images", torch.rand(2, 12, 11, 3)),
        ("images", torch.rand(2, 3, 12, 12)),
        ("images", torch.rand(3, 12, 12, 3)),
        ("viewmats", torch.rand(2, 3, 4)),
        ("Ks", torch.rand(1, 3, 3)),
        ("width", 24),
    ],
)
def test_wrong_shapes_are_named(name, value):
    images, cameras = inputs(2)
    if name == "images":
        images = value
    else:
        setattr(cameras, name, value)
    with pytest.raises(ValueError, match=r"(images|cameras).* is \(.*expected"):
        Gamba(micro(), "random")(images, cameras)


def test_positions_start_spread_inside_the_object():
    config = micro(image_size=32, width=96, depth=4, encoder="none")
    images, cameras = inputs(2, 32)
    for image in (images, torch.ones_like(images)):
        means = Gamba(config)(image, cameras).means
        spread = means.std(dim=1)
        assert (spread > 0.04).all() and (spread < 0.2).all(), spread
        assert means.abs().max() < 0.49


def test_config_json_round_trip():
    for config in (*PRESETS.values(), micro(predict_rotation=True, position_range=0.4)):
        assert GambaConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize(
    "change, words",
    [
        ('"width": 16, "surprise": 1', "file.x: .*unknown surprise"),
        ("", "file.x: .*missing width"),
        ('"width": "16"', "file.x: .*width is '16'"),
        ('"width": 0', "file.x: .*width is 0"),
        ('"width": true', "file.x: .*width is True"),
        ('"width": 16,', "file.x: .*not valid JSON"),
    ],
)
def test_config_json_errors(change, words):
    text = micro().to_json().replace('"width": 16', change or '"depth": 2')
    refused(words, GambaConfig.from_json, text, "file.x")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"image_size": 13}, "image_size 13 is not a multiple of patch_size 4"),
        ({"norm": "batch"}, "norm is 'batch', not one of layer, rms"),
        ({"state_size": 257}, "state_size is 257"),
        ({"conv_size": 5}, "conv_size is 5"),
        ({"opacity_init": 1.0}, "opacity_init is 1.0"),
        ({"encoder": "none", "camera_token": False}, "prepend needs"),
        ({"encoder": "vgg16", "encoder_frozen": False}, "vgg16"),
        ({"scale_init": float("nan")}, "scale_init is nan"),
    ],
)
def test_config_refuses(changes, words):
    refused(words, micro, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"decoder": "rays", "ray_cells": 2, "encoder": "none"},
        {"decoder": "triplane", "triplane_size": 3, "mixer": "attention"},
        {"image_tokens": "mixed", "predict_rotation": True},
    ],
    ids=str,
)
def test_a_default_of_float64_changes_nothing(changes):
    """Weights are drawn, and Gaussians predicted, as with the default dtype float32."""

    def run():
        torch.manual_seed(0)
        model = Gamba(micro(**changes), "random")
        shape = 2, 12, 12, model.config.input_channels
        out = model(torch.rand(shape, dtype=torch.float32), inputs(2)[1])
        made = [getattr(out, name) for name in FIELDS]
        sum(values.sum() for values in made).backward()
        parameters = [p for p in model.parameters() if p.grad is not None]
        return [*made, *model.state_dict().values(), *(p.grad for p in parameters)]

    assert_default_dtype_changes_nothing(run)


@pytest.fixture(scope="module")
def shallow():
    torch.manual_seed(0)
    return Gamba(micro(image_size=32, encoder="none")).eval()


def dotted(*squares):
    """White images with a grey pixel each, at row and column."""
    made = torch.ones(len(squares), 32, 32, 3)
    for image, (y, x) in zip(made, squares):
        image[y, x] = 0.9
    viewmats = reference_viewmat(1.9).repeat(len(squares), 1, 1)
    K = intrinsics(32, 32).repeat(len(squares), 1, 1)
    return made, Cameras(viewmats, K, 32, 32)


@torch.no_grad()
def test_background_tokens_are_dropped(shallow):
    full = shallow(*dotted((5, 9)))
    assert full.means.shape == (1, 4 * 64, 3)
    for margin, patches in ((0, 1), (1, 9), (2, 4 * 5), (100, 64)):  # row 1, column 2 of 8 x 8
        made = shallow(*dotted((5, 9)), background_margin=margin)
        assert made.means.shape == (1, 4 * patches, 3)
    assert torch.equal(made.means, full.means) and torch.equal(made.scales, full.scales)
    kept = shallow.tokens.foreground(dotted((5, 9))[0], 1.0, 0)
    first = 1 * 8 + 2, 64 + 2 * 8 + 1  # by rows, then by columns; then each backward
    assert kept.tolist() == [first[0], first[1], 191 - first[0], 255 - (first[1] - 64)]


@torch.no_grad()
def test_a_token_is_kept_if_any_image_of_the_batch_needs_it(shallow):
    both, cameras = dotted((5, 9), (30, 30))
    assert shallow(both, cameras, background_margin=0).means.shape == (2, 8, 3)
    assert shallow(torch.ones_like(both), cameras, background_margin=3).means.shape == (2, 0, 3)
    with pytest.raises(ValueError, match="background_margin is -1"):
        shallow(both, cameras, background_margin=-1)
