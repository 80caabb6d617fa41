import os
import sys

import pytest

from gamba_warp import devices


@pytest.mark.parametrize(
    ("load", "chosen", "want"),
    [
        (1.5, {}, "1000"),
        (0.2, {}, None),
        (1.5, {"GOMP_SPINCOUNT": "77"}, "77"),
        (1.5, {"OMP_WAIT_POLICY": "active"}, None),
    ],
)
def test_threads_sleep_where_the_cores_are_busy(monkeypatch, load, chosen, want):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "x")  # so that it is as before in the end, whatever is set
        monkeypatch.delenv(name)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0), raising=False)
    monkeypatch.setattr(devices, "cores", lambda: 2)
    devices.share_cores()
    assert os.environ.get("GOMP_SPINCOUNT") == want


def test_what_torch_has_read_already_is_not_changed(monkeypatch):
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    monkeypatch.setattr(os, "getloadavg", lambda: (99.0, 0.0, 0.0), raising=False)
    assert "torch" in sys.modules or __import__("torch")
    devices.share_cores()
    assert "GOMP_SPINCOUNT" not in os.environ
