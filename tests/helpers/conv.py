"""Shared by the tests of the convolution: its inputs."""

import torch


def make(batch, length, channels, width, dtype=torch.float32):
    """All four tensors, standard normal; the weight and the bias are float32."""
    return {
        "x": torch.randn(batch, length, channels).to(dtype),
        "weight": torch.randn(channels, width),
        "bias": torch.randn(channels),
        "initial_state": torch.randn(batch, width - 1, channels).to(dtype),
    }
