"""``gamba train``, also ``python -m gamba_warp.train`` and ``torchrun -m gamba_warp.train``."""

from __future__ import annotations

import tyro

from .config import TrainConfig


def train_command(config: tyro.conf.OmitArgPrefixes[TrainConfig]) -> int:
    """Trains a model on posed views.

    Loss, optimizer and schedules are the paper's. Writes checkpoints, log.jsonl, sample pictures
    and at the end model.safetensors into the run folder. Ctrl-C saves and stops; the same command
    goes on. Several GPUs: torchrun --nproc-per-node N -m gamba_warp.train DATA ...
    """
    import torch

    from .ddp import world
    from .run import train

    if config.run.threads is not None:
        torch.set_num_threads(config.run.threads)
    with world(config.run.device) as joined:
        return train(config, joined)
