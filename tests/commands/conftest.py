"""A checkpoint of the smallest model."""

import pytest
import torch
from helpers.model import SMALLEST

from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, Gamba(SMALLEST))
    return path
