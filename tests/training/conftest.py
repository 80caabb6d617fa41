"""Fixtures of the training tests."""

import pytest
from helpers import micro


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """Two clouds to train on and a held-out one; read-only."""
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds")
