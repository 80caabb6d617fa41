"""Versions of what is installed."""

import importlib.metadata

import torch

from gamba_warp.versions import installed


def test_only_installed_packages_have_a_version():
    found = installed("torch", "no-such-package", "numpy")
    assert list(found) == ["torch", "numpy"]
    # the local part of a version, such as +cu132, need not be in what pip notes
    assert torch.__version__.startswith(found["torch"])
    assert found["numpy"] == importlib.metadata.version("numpy")
    assert installed() == {}
