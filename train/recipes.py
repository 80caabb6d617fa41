"""Recipes of ``gamba train --recipe``: sets of options, each with its source.

A recipe's options precede all others on the command line, so that a given option overrides them.
This module avoids slow imports.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import option

from .config import RecipeName


class Recipe(NamedTuple):
    """Recipe of training options.

    Attributes:
        about: its purpose, one line.
        settings: its options, in the order of the command line, with their sources: a line of the
            paper, or the reason of a choice.
        batch: objects of a step, over all processes and accumulated batches; None if the settings
            give the batch of each process.
    """

    about: str
    settings: dict[str, str]
    batch: int | None = None


RECIPES: dict[RecipeName, Recipe] = {
    "paper": Recipe(
        about="Gamba as the paper trains it; 16 GPUs of 80 GB had 40 hours for it",
        batch=256,
        settings={
            "--preset paper": '§4.1: "512 × 512", p = 8, N = 14, D = 512, DINOv2, 16,384',
            "--size 512": "not stated; that of G-Objaverse and the authors' public code",
            "--epochs 400": '§4.1: "for totally 400 epochs"',
            "--lr 1e-3": '§4.1: "an initial learning rate of 1e-3"',
            "--schedule cosine": 'not stated beyond "initial"; chosen',
            "--lpips on --lpips-weight 0.5": '§4.1: "λ_LPIPS = 0.5"; VGG, §3.3',
            "--radial-mask": '§4.1: "λ_rdist ... initially set at 0.1"; decayed over 10 epochs',
            "--background white": "not stated; that of the authors' public code",
            "--precision auto": "not stated; bfloat16 in the authors' public code",
        },
    ),
    "rays": Recipe(
        about="the shipped model's network in one run of about 5 hours of one CPU core (by the "
        "speed of run 24, docs/lab/rays.md); its result is not measured, what ships had 41 hours",
        settings={
            "--preset rays": "starter/rays.json: 128² input, Gaussians on the pixels' rays",
            "--size 128": "all runs",
            "--steps 5500": "run 24: 1,940 steps in 105 minutes",
            "--batch-size 16 --lr 3e-4": "run 24",
            "--views-per-object 3": "run 30",
            "--schedule trapezoid --decay-fraction 0.7": "run 24: decay from .3 of the run on",
            "--ema 0.998": "losses against translucency",
            "--front-fraction 0.5 --flip 0.5 --color-jitter 0.3": "all runs",
            "--procedural 0.2": "run 30; real objects alone are too few",
            "--no-radial-mask": "all runs: Gaussians begin on the object",
            "--depth-weight 0.5 --ssim-weight 0.3 --novel-weight 3": "run 30",
            "--mask-l1-weight 0.3 --translucency-weight 0.12": "run 30",
            "--lpips on --lpips-weight 0.35 --lpips-crop 48": "run 30",
            "--lpips-after 1500": "run 2, which began from nothing: 24,000 samples",
            "--background random": "run 6 and later: on white floaters cost nothing",
            "--precision auto": "docs/lab/step.md: bfloat16 where it is faster",
        },
    ),
    "tiny": Recipe(
        about="the paper's decoder at a small size, to compare with: starter/tiny.safetensors, 723 "
        "steps on data/furniture128 in 25 minutes of two CPU cores",
        settings={
            "--preset tiny": "starter/tiny.json: 128² input, 4,096 Gaussians",
            "--batch-size 4 --minutes 25 --lpips off --lr 2e-3 --cache": "starter/tiny.json",
        },
    ),
}
BATCH_SOURCE = '§4.1: "a batch size of 256"'


def recipe_words(name: str, arguments: Sequence[str], environment: Mapping[str, str]) -> list[str]:
    """Options of a recipe.

    Args:
        name: one of ``RECIPES``.
        arguments: of the same command, without the recipe's name; ``--accumulate`` and
            ``--batch-size`` among them determine the batch of a process.
        environment: of this process; torchrun sets ``WORLD_SIZE`` to the number of processes.

    Returns:
        Words of the command line, including ``--recipe`` itself.

    Raises:
        UserError: the recipe is unknown, or its batch does not divide by the processes and
            accumulated batches.
    """
    recipe, options = _recipe_of(name), {}
    for word, following in zip(arguments, [*arguments[1:], ""]):  # the last of each name counts
        key, equals, value = word.partition("=")
        options[key.replace("_", "-")] = value if equals else following
    words = ["--recipe", name, *(word for text in recipe.settings for word in shlex.split(text))]
    if recipe.batch is None or option("batch_size") in options:
        return words
    processes, accumulate = environment.get("WORLD_SIZE", "1"), options.get("--accumulate", "1")
    for text, what in ((processes, "WORLD_SIZE"), (accumulate, "--accumulate")):
        if not re.fullmatch("0*[1-9][0-9]{0,5}", text):
            raise UserError(f"{what} {text[:40]}: expected a number from 1 to 999,999")
    fraction, remainder = divmod(recipe.batch, int(processes) * int(accumulate))
    if remainder:
        raise UserError(
            f"--recipe {name}: its batch of {recipe.batch} does not divide by {processes} "
            f"processes times --accumulate {accumulate}; change one of them, or give --batch-size"
        )
    return [*words, option("batch_size"), str(fraction)]


def _recipe_of(name: str) -> Recipe:
    by_name = {str(known): recipe for known, recipe in RECIPES.items()}
    if name not in by_name:
        raise UserError(f"--recipe {name[:40]}: expected one of {', '.join(by_name)}")
    return by_name[name]


def table_of(name: str) -> str:
    """Readable table of a recipe's options, one per line with its source.

    Raises:
        UserError: the recipe is unknown.
    """
    recipe = _recipe_of(name)
    rows = dict(recipe.settings)
    if recipe.batch is not None:
        rows[f"--batch-size {recipe.batch} / (processes x accumulate)"] = BATCH_SOURCE
    width = max(map(len, rows))
    lines = [f"--recipe {name}: {recipe.about}. An option that is given wins."]
    return "\n".join([*lines, *(f"  {words:<{width}}  {source}" for words, source in rows.items())])


def announce(words: Sequence[str], environment: Mapping[str, str] = os.environ) -> None:
    """Print the options of a recipe, once for all processes of torchrun."""
    if environment.get("RANK", "0") == "0":
        print(f"recipe {words[1]}: {shlex.join(words[2:])}")
