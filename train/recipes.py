"""Recipes of ``gamba train --recipe``: options that belong together, each with where it is from.

A recipe's options stand before all others on the command line, so that a given option wins. This
module imports nothing that is slow.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import option

from .config import RecipeName

_MOST = 100_000  # processes, or batches of a step, that anyone has


@dataclass(frozen=True)
class Setting:
    """One or more options of a recipe.

    Attributes:
        words: as they stand on the command line.
        source: what states them: a line of the paper, or the reason of a choice.
    """

    words: str
    source: str


@dataclass(frozen=True)
class Recipe:
    """A recipe.

    Attributes:
        about: what it is for, one line.
        settings: its options, in the order of the command line.
        batch: objects of a step, of all processes and accumulated batches together; None: the
            settings have a batch of each process.
    """

    about: str
    settings: tuple[Setting, ...]
    batch: int | None = None


_RAYS = Recipe(
    about="the shipped model at its size, in one run: 19,250 steps, 5 hours of one CPU core",
    settings=(
        Setting("--preset rays", "starter/rays.json: 128² input, Gaussians on the pixels' rays"),
        Setting("--size 128", "docs/rays.md, all runs"),
        Setting("--steps 19250", "starter/rays.json: the steps of its four runs together"),
        Setting("--batch-size 4 --views-per-object 3", "docs/rays.md, all runs"),
        Setting("--front-share 0.5 --mirror 0.5 --recolor 0.3", "docs/rays.md, all runs"),
        Setting("--no-radial-mask", "docs/rays.md, all runs: Gaussians begin on the object"),
        Setting("--depth-weight 0.3 --novel-weight 1.5", "docs/rays.md, the last run"),
        Setting("--ssim-weight 0.3", "docs/rays.md, the last run"),
        Setting("--lpips on --lpips-weight 0.25 --lpips-crop 48", "docs/rays.md, the last run"),
        Setting("--lpips-after 6000", "docs/rays.md, the second run, which began from nothing"),
        Setting("--lr 1.2e-3 --schedule trapezoid --decay-share 0.3", "docs/rays.md, the last run"),
        Setting("--precision bfloat16", "docs/rays.md, the second and the last run"),
    ),
)

RECIPES: dict[RecipeName, Recipe] = {
    "paper": Recipe(
        about="Gamba as the paper trains it; 16 GPUs of 80 GB had 40 hours for it",
        batch=256,
        settings=(
            Setting("--preset paper", '§4.1: "512 × 512", p = 8, N = 14, D = 512, DINOv2, 16,384'),
            Setting("--size 512", "not stated; that of G-Objaverse and the authors' public code"),
            Setting("--epochs 400", '§4.1: "for totally 400 epochs"'),
            Setting("--lr 1e-3", '§4.1: "an initial learning rate of 1e-3"'),
            Setting("--weight-decay 0.05", '§4.1: "a weight decay of 0.05"'),
            Setting("--clip 1", '§4.1: "Gradient clipping of value 1.0 ... L2 norm of gradients"'),
            Setting("--schedule cosine", 'not stated beyond "initial"; chosen'),
            Setting("--views-first 2 --views-last 6", '§3.3: "the number of views from 2 to 6"'),
            Setting("--mask-weight 1", '§4.1: "λ_mask = 1 for the mask loss"'),
            Setting("--lpips on --lpips-weight 0.5", '§4.1: "λ_LPIPS = 0.5"; VGG, §3.3'),
            Setting("--radial-mask --rdist-weight 0.1", '§4.1: "λ_rdist ... initially set at 0.1"'),
            Setting("--rdist-epochs 10", '§4.1: "gradually decayed to 0 over the first 10 epochs"'),
            Setting("--background white", "not stated; that of the authors' public code"),
            Setting("--precision bfloat16", "not stated; that of the authors' public code"),
        ),
    ),
    "tiny": _RAYS,
    "rays": _RAYS,
}
BATCH_SOURCE = '§4.1: "a batch size of 256"'


def recipe_words(name: str, arguments: Sequence[str], environment: Mapping[str, str]) -> list[str]:
    """The options of a recipe.

    Args:
        name: one of ``RECIPES``.
        arguments: of the same command, the recipe's name left out: they may have ``--accumulate``
            and ``--batch-size``, which the size of a process's batch follows from.
        environment: of this process; torchrun says in ``WORLD_SIZE`` how many processes there are.

    Returns:
        Words of the command line, that of ``--recipe`` itself included.

    Raises:
        UserError: there is no such recipe, or its batch does not divide by the processes and
            accumulated batches.
    """
    recipe = _named(name)
    words = ["--recipe", name]
    for setting in recipe.settings:
        words += shlex.split(setting.words)
    if recipe.batch is not None and _given(arguments, "batch_size") is None:
        words += ["--batch-size", str(_share(name, recipe.batch, arguments, environment))]
    return words


def _named(name: str) -> Recipe:
    found = {str(known): recipe for known, recipe in RECIPES.items()}
    if name not in found:
        raise UserError(f"--recipe {name[:40]}: expected one of {', '.join(found)}")
    return found[name]


def _share(name: str, batch: int, arguments: Sequence[str], environment: Mapping[str, str]) -> int:
    """The objects of a process's batch."""
    processes = _count(environment.get("WORLD_SIZE", "1"), "WORLD_SIZE")
    accumulate = _count(_given(arguments, "accumulate") or "1", "--accumulate")
    share, rest = divmod(batch, processes * accumulate)
    if rest or not share:
        raise UserError(
            f"--recipe {name}: its batch of {batch} does not divide by {processes} processes times "
            f"--accumulate {accumulate}; change one of them, or give --batch-size"
        )
    return share


def _count(text: str, what: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= _MOST:
        raise UserError(f"{what} {text[:40]}: expected a number from 1 to {_MOST:,}")
    return int(text)


def _given(arguments: Sequence[str], name: str) -> str | None:
    """The value of the last option of this name, or None."""
    found = None
    for word, following in zip(arguments, [*arguments[1:], ""]):
        key, equals, value = word.partition("=")
        if key.replace("_", "-") == option(name):
            found = value if equals else following
    return found


def table_of(name: str) -> str:
    """What a recipe sets, a line an option, each with its source; for people.

    Raises:
        UserError: there is no such recipe.
    """
    recipe = _named(name)
    rows = [(setting.words, setting.source) for setting in recipe.settings]
    if recipe.batch is not None:
        rows.append((f"--batch-size {recipe.batch} / (processes x accumulate)", BATCH_SOURCE))
    width = max(len(words) for words, _ in rows)
    lines = [f"--recipe {name}: {recipe.about}. An option that is given wins."]
    return "\n".join([*lines, *(f"  {words:<{width}}  {source}" for words, source in rows)])


def announce(words: Sequence[str], environment: Mapping[str, str] = os.environ) -> None:
    """Prints what a recipe comes to, once for all processes of torchrun."""
    if environment.get("RANK", "0") == "0":
        print(f"recipe {words[1]}: {shlex.join(words[2:])}")
