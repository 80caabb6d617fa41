"""A kernel of no operator, and the inputs of the convolution."""

import torch
import warp as wp


@wp.kernel(enable_backward=False, module="unique")
def plain_kernel(x_in: wp.array[float], x_out: wp.array[float]):
    i = wp.tid()
    x_out[i] = 2.0 * x_in[i]


def conv_inputs(batch, length, channels, width, dtype=torch.float32):
    """All four tensors, standard normal; the weight and the bias are float32."""
    return {
        "x": torch.randn(batch, length, channels).to(dtype),
        "weight": torch.randn(channels, width),
        "bias": torch.randn(channels),
        "initial_state": torch.randn(batch, width - 1, channels).to(dtype),
    }
