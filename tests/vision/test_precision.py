"""Precision of matrix products: the trial of "auto", float32 by oneDNN, and bfloat16."""

import sys
import threading

import numpy as np
import pytest
import torch
from helpers.model import micro

from gamba_warp import devices
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.predict import reconstruct

CPU = torch.device("cpu")


@pytest.fixture
def better(monkeypatch):
    """Act like a processor for which oneDNN is chosen."""
    monkeypatch.setattr(devices, "_onednn_is_better", lambda: True)


def test_the_setting_of_products_is_put_back_also_after_an_error_and_inside_one_another(better):
    before = torch.get_float32_matmul_precision()
    with pytest.raises(KeyError), devices.network_products(CPU):
        with devices.network_products(CPU), devices.float32_products():
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "medium"
        raise KeyError
    assert torch.get_float32_matmul_precision() == before
    with devices.float32_products(), devices.network_products(CPU):
        assert torch.get_float32_matmul_precision() == "highest"
    with devices.network_products(torch.device("meta")):
        assert torch.get_float32_matmul_precision() == before


def test_float32_products_end_the_rounding_that_a_user_has_allowed():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with devices.float32_products():
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision(before)


def test_a_network_keeps_the_callers_autocast_unless_it_is_given_a_precision():
    a = torch.ones(2, 2)
    with devices.network_products(CPU, torch.bfloat16):
        with devices.network_products(CPU):
            assert (a @ a).dtype == torch.bfloat16
        with devices.network_products(CPU, torch.float32):
            assert (a @ a).dtype == torch.float32
    assert (a @ a).dtype == torch.float32


def test_float32_products_keep_all_digits_while_another_thread_comes_and_goes(better):
    def other() -> None:
        with devices.network_products(CPU):
            pass

    with devices.float32_products():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert torch.get_float32_matmul_precision() == "highest"


def test_the_last_thread_puts_the_products_back(better):
    before = torch.get_float32_matmul_precision()
    inside, leave = threading.Event(), threading.Event()

    def other() -> None:
        with devices.network_products(CPU):
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with devices.network_products(CPU):
        thread.start()
        assert inside.wait(10)
    assert torch.get_float32_matmul_precision() == "medium"
    leave.set()
    thread.join()
    assert torch.get_float32_matmul_precision() == before


def test_the_first_use_under_an_autocast_chooses_the_same_library(monkeypatch):
    """The comparison with float64 once took the caller's autocast for the library's error."""
    known = {"cpu_name": "AMD EPYC", "avx512_f": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known, raising=False)
    chosen = devices._onednn_is_better.__wrapped__
    alone = chosen()
    with torch.autocast("cpu", torch.bfloat16):
        assert chosen() == alone


def test_products_of_a_network_keep_all_digits():
    """Whatever this processor is: if oneDNN is chosen here, its products are float32's."""
    g = torch.Generator().manual_seed(1)
    a, b = torch.randn(300, 200, generator=g), torch.randn(200, 250, generator=g)
    truth = a.double() @ b.double()
    with devices.network_products(CPU):
        error = (a @ b).double() - truth
    assert error.norm() < 1e-6 * truth.norm()  # bfloat16 has 2e-3


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
    assert not devices._onednn_is_better.__wrapped__()


def test_a_library_that_rounds_is_not_taken(monkeypatch):
    known = {"cpu_name": "AMD EPYC", "avx512_f": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known, raising=False)
    plain = torch.Tensor.__matmul__

    def rounding(a, b):
        return plain(a.bfloat16().float(), b) if a.dtype == torch.float32 else plain(a, b)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounding)
    assert not devices._onednn_is_better.__wrapped__()
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


def test_a_picture_in_bfloat16_is_near_that_in_float32_and_no_more():
    torch.manual_seed(0)
    model = Gamba(micro(encoder="none")).eval()
    size = model.config.image_size
    picture = np.random.default_rng(0).uniform(size=(size, size, 4)).astype(np.float32)
    full, again = reconstruct(model, picture), reconstruct(model, picture, "float32")
    lower = reconstruct(model, picture, "bfloat16")
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
    called = []

    class Library:
        def mallopt(self, *values) -> None:
            called.append(tuple(value.value for value in values))

    monkeypatch.setattr(devices.ctypes, "CDLL", lambda _: Library())
    devices.keep_memory()
    assert called == ([] if name else [devices._TRIM_THRESHOLD, devices._MMAP_THRESHOLD])
