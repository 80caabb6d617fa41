"""``gamba train``, also ``python -m gamba_warp.train`` and ``torchrun -m gamba_warp.train``."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import tyro

from gamba_warp.errors import UserError

from .config import FOLLOWING, TrainConfig, command_line, config_of
from .recipes import announce, recipe_words, table_of

_MAX_CONFIG = 1 << 20  # bytes of a config.json; ours have 4,000


def train_command(config: tyro.conf.OmitArgPrefixes[TrainConfig]) -> int:
    """Train a model on posed views.

    Loss, optimizer and schedules are the paper's. Writes checkpoints, log.jsonl, sample images
    and at the end model.safetensors into the run folder. Ctrl-C saves and stops; the same command
    resumes. Several GPUs: torchrun --nproc-per-node N -m gamba_warp.train DATA ...
    """
    import torch

    from .ddp import world
    from .loop import train

    if config.run.threads is not None:
        torch.set_num_threads(config.run.threads)
    with world(config.run.device) as joined:
        return train(config, joined)


def expand(arguments: list[str]) -> list[str]:
    """Replace ``--config`` or ``--recipe`` by the options it stands for, before all others.

    With ``--help``, print the recipe's options.

    Args:
        arguments: of ``gamba train``, each option once.

    Returns:
        The arguments without ``--config``; if an option occurs twice, the last one counts.

    Raises:
        UserError: the name is missing, both are given, the file is not the config.json of a run, or
            the recipe is unknown.
    """
    words = [
        part
        for word in arguments
        for part in (word.split("=", 1) if word.startswith(("--config=", "--recipe=")) else [word])
    ]
    helped = bool({"-h", "--help"} & {*words})
    chosen = "--recipe" if "--recipe" in words else "--config"
    if chosen not in words or (helped and chosen == "--config"):
        return arguments
    if {"--recipe", "--config"} <= {*words}:
        raise UserError("--recipe and --config: give one of them")
    at = words.index(chosen)
    if at + 1 == len(words):
        raise UserError(f"{chosen}: expected a recipe's name, or a run's folder or config.json")
    name, remaining = words[at + 1], [*words[:at], *words[at + 2 :]]
    if helped:
        print(table_of(name) + "\n")
        return remaining
    # DATA may come first, last with a recipe, and after the one value of --config.
    first = remaining[:1] if remaining and not remaining[0].startswith("-") else []
    if chosen == "--recipe":
        taken = recipe_words(name, remaining, os.environ)
        announce(taken)
        return [*first, *taken, *remaining[len(first) :]]
    data, *taken = _options_of(Path(name))
    if not first and remaining[at : at + 1] and not remaining[at].startswith("-"):
        first = [remaining.pop(at)]
        return [*first, *taken, *remaining]
    return [*(first or [data]), *taken, *remaining[len(first) :]]


def _options_of(path: Path) -> list[str]:
    """DATA and the options of a config.json, as command line arguments."""
    from gamba_warp.untrusted.documents import read_document

    path = path / "config.json" if path.is_dir() else path
    try:
        values = read_document(path, dict[str, Any], _MAX_CONFIG)
    except UserError as error:
        raise UserError(f"{error}; this is not the config.json of a run") from error
    for name in FOLLOWING:
        values.pop(name, None)
    parts = [part for part in values.values() if not isinstance(part, dict)]
    parts += [v for part in values.values() if isinstance(part, dict) for v in part.values()]
    for value in (v for part in parts for v in (part if isinstance(part, list) else [part])):
        if str(value).startswith("-"):
            raise UserError(f"{path}: {str(value)[:100]!r} is not a valid value of an option")
    config = config_of(values, str(path))
    words = shlex.split(command_line(config.to_dict()))[2:]
    if config.run.recipe:  # kept as a record; its options are already there
        words += ["--recipe", config.run.recipe]
    return words
