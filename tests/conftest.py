"""What holds for all tests: rewritten asserts in helpers, the marker ``gpu``, a fixed seed."""

import pytest
import torch

# This must come before the first import of helpers, so that a failing assert in them shows values.
pytest.register_assert_rewrite("helpers")


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)
