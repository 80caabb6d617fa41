"""What the tests of training share."""

import pytest
from helpers import micro


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """Two clouds to train on and one that is held out; no test changes them."""
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds")
