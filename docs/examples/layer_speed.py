"""Times one Mamba layer, mambapy's, and mamba-ssm's reference formula, on the same weights.

Run ``python docs/examples/layer_speed.py`` with mambapy installed (``pip install '.[peers]'``). The
layers alternate, so that other work on the machine affects all of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from mambapy.mamba import MambaBlock, MambaConfig
from torch import Tensor

from gamba_warp.compat.mamba_ssm import Mamba


def reference(layer: Mamba, tokens: Tensor) -> Tensor:
    """Result of mamba-ssm without its extensions: a loop over the tokens in torch."""
    x, z = layer.in_proj(tokens).mT.chunk(2, dim=1)
    x = torch.nn.functional.silu(layer.conv1d(x)[..., : tokens.shape[1]])
    sizes = [layer.dt_rank, layer.d_state, layer.d_state]
    dt, B, C = layer.x_proj(x.mT).split(sizes, dim=-1)
    delta = torch.nn.functional.softplus(layer.dt_proj(dt))
    A, u = -torch.exp(layer.A_log), x.mT
    state, outputs = u.new_zeros(len(u), u.shape[-1], layer.d_state), []
    for t in range(tokens.shape[1]):
        decay = torch.exp(delta[:, t, :, None] * A)
        state = decay * state + (delta[:, t] * u[:, t])[..., None] * B[:, t, None]
        outputs.append((state * C[:, t, None]).sum(-1))
    y = torch.stack(outputs, 1) + layer.D * u
    return layer.out_proj(y * torch.nn.functional.silu(z.mT))


def twin(layer: Mamba, width: int) -> MambaBlock:
    """Make mambapy's block with the layer's weights."""
    block = MambaBlock(MambaConfig(d_model=width, n_layers=1))
    block.load_state_dict(layer.state_dict())
    return block


def compare(width: int, length: int, turns: int) -> None:
    """Print medians in milliseconds, and the differences of outputs and gradients."""
    torch.manual_seed(0)
    layer = Mamba(width)
    block = twin(layer, width)
    calls: dict[str, Callable[[Tensor], Tensor]] = {
        "ours": layer,
        "mambapy": block,
        "torch loop": lambda tokens: reference(layer, tokens),
    }
    tokens = torch.randn(1, length, width, requires_grad=True)
    cotangent = torch.randn(1, length, width)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    found = {}
    for turn in range(turns + 1):  # the first compiles
        for name, call in calls.items():
            with torch.no_grad():
                start = time.perf_counter()
                call(tokens)
                forward = time.perf_counter() - start
            tokens.grad = None
            start = time.perf_counter()
            output = call(tokens)
            output.backward(cotangent)
            both = time.perf_counter() - start
            found[name] = output.detach(), tokens.grad
            if turn:
                times[name].append((forward, both))
    print(f"width {width}, {length} tokens, {torch.get_num_threads()} threads")
    for name, pairs in times.items():
        forward, both = (1e3 * sorted(column)[len(column) // 2] for column in zip(*pairs))
        errors = [
            float((a - b).norm() / b.norm()) for a, b in zip(found[name], found["torch loop"])
        ]
        print(
            f"  {name:<10} forward {forward:8.1f} ms, with gradients {both:8.1f} ms, "
            f"to the loop {errors[0]:.0e} and {errors[1]:.0e}"
        )


def main() -> None:
    """Read the sizes from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--widths", type=int, nargs="+", default=[256, 768])
    parser.add_argument("--length", type=int, default=1024)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for width in options.widths:
        compare(width, options.length, options.turns)


if __name__ == "__main__":
    main()
