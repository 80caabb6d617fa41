"""Cost of one object in a training step: operations, kept memory, and memory of the weights.

    python docs/examples/step_cost.py paper

Products and convolutions are counted by torch while the network runs once with one block and once
with two; the rest follows, since blocks are alike. The image encoder is a stand-in of the same
shape. No GPU is needed, and time is not measured.
"""

import argparse
from dataclasses import replace

import torch
from torch.utils.flop_counter import FlopCounterMode

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba

_BYTES = {"weights": 4, "gradients": 4, "AdamW's moments": 8, "running average": 4, "exchange": 4}


class StandIn(torch.nn.Module):
    """Tokens of an image encoder's shape; frozen, as in the presets."""

    frozen = True

    def __init__(self, channels: int, count: int) -> None:
        super().__init__()
        self.channels, self.count = channels, count

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """``[B, count, channels]`` of zeros."""
        return images.new_zeros(len(images), self.count, self.channels)


def measure(config: GambaConfig, depth: int, checkpointing: bool) -> list[float]:
    """Operations forward and backward, and bytes kept for the gradient, of one object."""
    encoder = None
    if config.prepend and config.encoder != "none":
        wide = 768 if config.encoder.startswith("vit_base") else 512
        patch = 14 if config.encoder.startswith("vit") else 16
        encoder = StandIn(wide, (config.encoder_size // patch) ** 2)
    model = Gamba(replace(config, depth=depth), encoder=encoder)
    model.checkpointing = checkpointing
    own = {parameter.data_ptr() for parameter in model.parameters()}
    kept: dict[int, int] = {}

    def keep(value: torch.Tensor) -> torch.Tensor:
        storage = value.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage.nbytes()
        return value

    side = config.image_size
    cameras = Cameras(orbit(torch.zeros(1), 0.0, 2.0), intrinsics(side, side)[None], side, side)
    images = torch.rand(1, side, side, config.input_channels)
    with FlopCounterMode(display=False) as forward:
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
            found = model(images, cameras)
    with FlopCounterMode(display=False) as backward:
        parts = (found.means, found.scales, found.opacities, found.colors)
        torch.stack([part.sum() for part in parts]).sum().backward()
    return [forward.get_total_flops(), backward.get_total_flops(), sum(kept.values())]


def main() -> None:
    """Print the table of one preset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("preset", choices=sorted(PRESETS))
    config = PRESETS[parser.parse_args().preset]
    print("one object, GFLOP forward, GFLOP backward, GB kept for the gradient:")
    for name, checkpointing in (("all is kept", False), ("--activation-checkpointing", True)):
        one, two = (measure(config, depth, checkpointing) for depth in (1, 2))
        whole = [a + (config.depth - 1) * (b - a) for a, b in zip(one, two)]
        print(f"  {name:22}{whole[0] / 1e9:>9.1f}{whole[1] / 1e9:>9.1f}{whole[2] / 1e9:>9.2f}")
        if not checkpointing:
            print(f"  {'of it a block':22}{'':18}{(two[2] - one[2]) / 1e9:>9.2f}")
    encoder = None if config.encoder == "none" else StandIn(768, 1)
    parameters = sum(p.numel() for p in Gamba(config, encoder=encoder).parameters())
    print(f"{parameters / 1e6:.1f} M parameters, the encoder's not counted; bytes on each GPU:")
    for name, size in _BYTES.items():
        print(f"  {name:22}{size * parameters / 1e9:>9.2f} GB")


if __name__ == "__main__":
    main()
