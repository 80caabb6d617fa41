"""Files in the form of the authors of Gamba, with random weights, for ``import-released``."""

import io
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import save_file

from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.released import released_names

SIZES = {"image_size": 64, "width": 64, "depth": 1, "dt_rank": 4}
# The smallest encoder supported by their files; 86 MB of random weights.
ENCODER = "vit_small_patch14_reg4_dinov2"


def theirs(model: Gamba) -> bytes:
    """File of a model's weights without its image encoder, with the authors' names."""
    config, ours = model.config, model.state_dict()
    state = {f"model.{theirs}": ours[name] for theirs, name in released_names(config.depth).items()}
    for name in [name for name in state if name.endswith("conv1d.weight")]:
        state[name] = state[name][:, None]
    limit = config.position_range
    points = torch.linspace(-limit, limit, config.position_bins)
    state["model.decoder.coords"] = points.expand(3, -1).clone()
    content = io.BytesIO()
    torch.save({"model": state}, content)
    return content.getvalue()


def make_released(folder: Path) -> None:
    """Writes ``theirs.pth``, and ``vit.safetensors`` with the encoder, into a new folder."""
    model = Gamba(replace(PRESETS["released"], encoder=ENCODER, **SIZES), "random")
    folder.mkdir()
    (folder / "theirs.pth").write_bytes(theirs(model))
    save_file(model.encoder.weights(), folder / "vit.safetensors")
