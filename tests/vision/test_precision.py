"""Precision of matrix products: the trial of "auto", float32 by oneDNN, and bfloat16."""

import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from helpers.model import micro

from gamba_warp import devices
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.predict import reconstruct

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def setting():
    """The process-wide setting: torch's default, put back after each test."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("better", [True, False])
@pytest.mark.parametrize("gpu", [True, False])
def test_the_fastest_products_are_chosen_only_without_a_gpu(monkeypatch, better, gpu):
    monkeypatch.setattr(devices, "_onednn_is_better", lambda: better)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    devices.use_fastest_products()
    chosen = torch.get_float32_matmul_precision()
    assert chosen == ("medium" if better and not gpu else "highest")


def test_float32_products_end_the_rounding_that_a_user_has_allowed():
    torch.set_float32_matmul_precision("high")
    with devices.float32_products():
        assert torch.get_float32_matmul_precision() == "highest"
    assert torch.get_float32_matmul_precision() == "high"


def test_a_precision_replaces_the_callers_autocast():
    a = torch.ones(2, 2)
    with devices.network_precision(CPU, torch.bfloat16):
        assert (a @ a).dtype == torch.bfloat16
        with devices.network_precision(CPU, torch.float32):
            assert (a @ a).dtype == torch.float32
    assert (a @ a).dtype == torch.float32


def test_products_of_a_network_keep_all_digits():
    """Whatever this processor is: if oneDNN is chosen here, its products are float32's."""
    g = torch.Generator().manual_seed(1)
    a, b = torch.randn(300, 200, generator=g), torch.randn(200, 250, generator=g)
    gt = a.double() @ b.double()
    devices.use_fastest_products()
    error = (a @ b).double() - gt
    assert error.norm() < 1e-6 * gt.norm()  # bfloat16 has 2e-3


@pytest.mark.parametrize(
    "known",
    [
        {},
        {"cpu_name": "Intel Xeon", "avx512_f": True},
        {"cpu_name": "AMD EPYC", "avx512_f": True, "amx_bf16": True},
        {"cpu_name": "AMD EPYC", "avx512_f": False},
    ],
)
def test_other_processors_keep_their_library(monkeypatch, known):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known, raising=False)
    assert not devices._onednn_is_better()


def test_a_library_that_rounds_is_not_taken(monkeypatch):
    known = {"cpu_name": "AMD EPYC", "avx512_f": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known, raising=False)
    plain = torch.Tensor.__matmul__

    def rounding(a, b):
        return plain(a.bfloat16().float(), b) if a.dtype == torch.float32 else plain(a, b)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounding)
    assert not devices._onednn_is_better()
    assert torch.get_float32_matmul_precision() != "medium"


@pytest.mark.parametrize(("gain", "want"), [(1.0, torch.float32), (2.0, torch.bfloat16)])
def test_auto_takes_what_is_faster(monkeypatch, gain, want):
    monkeypatch.setattr(devices, "_bfloat16_speedup", lambda *_: gain)
    assert devices.pick_precision("auto", CPU, 64) == want
    assert devices.pick_precision("float32", CPU, 64) == torch.float32
    assert devices.pick_precision("bfloat16", CPU, 64) == torch.bfloat16


def test_the_trial_is_made_once_and_leaves_chance_alone():
    devices._bfloat16_speedup.cache_clear()
    torch.manual_seed(5)
    state = torch.get_rng_state()
    chosen = [devices.pick_precision("auto", CPU, 24) for _ in range(2)]
    assert chosen[0] == chosen[1] and torch.equal(torch.get_rng_state(), state)
    info = devices._bfloat16_speedup.cache_info()
    assert (info.misses, info.hits) == (1, 1)


def test_a_image_in_bfloat16_is_near_that_in_float32_and_no_more():
    torch.manual_seed(0)
    model = Gamba(micro(encoder="none")).eval()
    size = model.config.image_size
    image = np.random.default_rng(0).uniform(size=(size, size, 4)).astype(np.float32)
    full, again = reconstruct(model, image), reconstruct(model, image, "float32")
    lower = reconstruct(model, image, "bfloat16")
    assert torch.equal(full.means, again.means)
    gap = (lower.means - full.means).norm() / full.means.norm()
    assert lower.means.dtype == torch.float32 and 0 < gap < 0.02  # 8 digits, a few products


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's mallopt")
@pytest.mark.parametrize("name", ["", "MALLOC_ARENA_MAX", "GLIBC_TUNABLES"])
def test_memory_is_kept_unless_the_user_has_a_say(monkeypatch, name):
    for other in ("MALLOC_ARENA_MAX", "GLIBC_TUNABLES"):
        monkeypatch.delenv(other, raising=False)
    if name:
        monkeypatch.setenv(name, "1")
    library = Mock()
    monkeypatch.setattr(devices.ctypes, "CDLL", lambda _: library)
    devices.keep_memory()
    called = [tuple(x.value for x in call.args) for call in library.mallopt.call_args_list]
    assert called == ([] if name else [devices._TRIM_THRESHOLD, devices._MMAP_THRESHOLD])
