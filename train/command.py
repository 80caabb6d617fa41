"""``gamba train``, also ``python -m gamba_warp.train`` and ``torchrun -m gamba_warp.train``."""

from __future__ import annotations

import os
import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

import tyro

from gamba_warp.errors import UserError

from .config import GROUPS, TrainConfig, command_line
from .recipes import announce, recipe_words, table_of

_MAX_CONFIG = 1 << 20  # bytes of a config.json; ours have 4,000


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


def expand(arguments: list[str]) -> list[str]:
    """Puts the options of the run or recipe that is named in its place, before all others.

    With ``--help`` it prints what the recipe sets.

    Args:
        arguments: of ``gamba train``, each option once.

    Returns:
        The same without ``--config``; of an option that is then there twice the last one counts.

    Raises:
        UserError: nothing is named, or both, the file is no run's config.json, or there is no
            such recipe.
    """
    words = [w for word in arguments for w in (word.split("=", 1) if _names(word) else [word])]
    helped = bool({"-h", "--help"} & {*words})
    if "--recipe" in words:
        return _with_recipe(words, helped)
    if "--config" not in words or helped:
        return arguments
    at = words.index("--config")
    if at + 1 == len(words):
        raise UserError("--config: expected a run's folder or its config.json")
    before, after = words[:at], words[at + 2 :]
    data = [before.pop(0)] if before and not before[0].startswith("-") else []
    taken, *options = _options_of(Path(words[at + 1]))
    return [*(data or [taken]), *options, *before, *after]


def _with_recipe(words: list[str], helped: bool) -> list[str]:
    """The words with the recipe's before all others; DATA may stand at either end."""
    if "--config" in words:
        raise UserError("--recipe and --config: give one of them")
    at = words.index("--recipe")
    if at + 1 == len(words):
        raise UserError("--recipe: expected the name of a recipe")
    rest = [*words[:at], *words[at + 2 :]]
    if helped:
        print(table_of(words[at + 1]) + "\n")
        return rest
    taken = recipe_words(words[at + 1], rest, os.environ)
    announce(taken)
    data = [rest.pop(0)] if rest and not rest[0].startswith("-") else []
    return [*data, *taken, *rest]


def _names(word: str) -> bool:
    return word.startswith(("--config=", "--recipe="))


def _options_of(path: Path) -> list[str]:
    """DATA and the options that a config.json means."""
    from gamba_warp.untrusted.documents import parse_document

    path = path / "config.json" if path.is_dir() else path
    try:
        if path.stat().st_size > _MAX_CONFIG:
            raise UserError(f"{path}: has more than {_MAX_CONFIG:,} bytes")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: no run's config.json can be read there ({error})") from error
    values = parse_document(text, dict[str, Any], f"{path}: a run's options")
    known = {"data", "preset", "set", *GROUPS}
    names = {name for name in values if name not in known}
    for group, kind in GROUPS.items():
        part = values.setdefault(group, {})
        if not isinstance(part, dict):
            raise UserError(f"{path}: {group} is no group of options")
        if group != "model":  # it follows from the preset and the changes of --set
            names |= {f"{group}.{name}" for name in part.keys() - {f.name for f in fields(kind)}}
    if names or "data" not in values or "preset" not in values:
        what = f"unknown {', '.join(sorted(names)[:5])}" if names else "it names no data or preset"
        raise UserError(f"{path}: not the options of a run ({what[:200]})")
    words = shlex.split(command_line(values))[2:]
    if recipe := values["run"].get("recipe"):  # the record of it; its options are there already
        words += ["--recipe", str(recipe)]
    given = [values["data"], values["preset"], *(values.get("set") or [])]
    given += [v for group in GROUPS if group != "model" for v in values[group].values()]
    for value in given:
        if isinstance(value, dict) or str(value).startswith("-"):
            raise UserError(f"{path}: {str(value)[:100]!r} is no value of an option")
    return words
