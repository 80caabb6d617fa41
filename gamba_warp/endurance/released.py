"""A file as the authors of Gamba publish theirs, with random weights, for ``import-released``."""

from __future__ import annotations

from pathlib import Path

SIZES = {"image_size": 64, "width": 64, "depth": 1, "dt_rank": 4}
# The smallest of the encoders that a file of theirs can be over; 86 MB of random weights.
ENCODER = "vit_small_patch14_reg4_dinov2"


def make_released(folder: Path) -> None:
    """Writes ``theirs.pth``, a network without its image encoder, and ``vit.safetensors``, that.

    Args:
        folder: is made.
    """
    from dataclasses import replace

    import torch
    from safetensors.torch import save_file

    from ..model.config import PRESETS
    from ..model.gamba import Gamba
    from ..model.released import released_names

    config = replace(PRESETS["released"], encoder=ENCODER, **SIZES)
    model = Gamba(config, "random")
    ours = model.state_dict()
    state = {f"model.{theirs}": ours[name] for theirs, name in released_names(config.depth).items()}
    for name in [name for name in state if name.endswith("conv1d.weight")]:
        state[name] = state[name][:, None]
    limit = config.position_range
    points = torch.linspace(-limit, limit, config.position_bins)
    state["model.decoder.coords"] = points.expand(3, -1).clone()
    folder.mkdir()
    torch.save({"model": state}, folder / "theirs.pth")
    assert model.encoder is not None
    save_file(model.encoder.weights(), folder / "vit.safetensors")
