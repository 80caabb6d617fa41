"""The console script ``gamba``: finds the command, parses its options with tyro, runs it."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable

from .errors import UserError
from .versions import __version__

# A command has one or two words. That of the words "a b-c" is the function ``a_b_c_command`` of
# the module ``gamba_warp.commands.a_b_c``, if MODULES names no other; it is imported when called.
COMMANDS = {
    "demo": "Train, reconstruct and evaluate on the starter set.",
    "reconstruct": "Pictures to 3D Gaussians.",
    "train": "Train a model on posed views.",
    "fit": "Posed views of an object to 3D Gaussians.",
    "data furniture": "Get 820 models.",
    "data render": "Meshes to posed views.",
    "eval-views": "PSNR, SSIM, LPIPS of views.",
    "eval-geometry": "Chamfer, IoU, F-score.",
    "export": "Gaussians to meshes, splats and pages.",
    "view": "Gaussians in the browser.",
    "bench": "Run time against error, on this machine.",
    "stress": "Random hostile cases against float64.",
    "gpu-check": "Test and measure on a CUDA machine.",
    "weights lpips": "Fetch the LPIPS-VGG weights.",
    "doctor": "Say what this machine can run.",
}
MODULES = {
    "train": "gamba_warp.train.command",
    "data furniture": "gamba_warp.train.data.furniture_command",
    "data render": "gamba_warp.train.data.render_command",
    "eval-views": "gamba_warp.eval.views.command",
    "eval-geometry": "gamba_warp.eval.shapes.command",
}


def _usage() -> str:
    lines = [f"gamba {__version__}: one image to 3D Gaussians", "", "Commands:"]
    lines += [f"  gamba {name:<14} {text}" for name, text in COMMANDS.items()]
    return "\n".join([*lines, "", "gamba COMMAND --help shows the options of one."])


def _find(arguments: list[str]) -> tuple[str, list[str]]:
    """The command's name, and its own arguments."""
    for words in (2, 1):
        name = " ".join(arguments[:words])
        if name in COMMANDS:
            return name, arguments[words:]
    group = [name for name in COMMANDS if name.startswith(arguments[0] + " ")]
    if group:
        raise UserError(f"'{arguments[0]}' needs one of: {', '.join(group)}")
    raise UserError(f"unknown command '{arguments[0]}'; gamba --help lists them")


def load_command(name: str) -> Callable[..., int | None]:
    """Imports the function of one of ``COMMANDS``."""
    plain = name.replace(" ", "_").replace("-", "_")
    module = importlib.import_module(MODULES.get(name, f"gamba_warp.commands.{plain}"))
    return getattr(module, f"{plain}_command")


def run(name: str, arguments: list[str]) -> int:
    """Runs one command.

    Args:
        name: one of ``COMMANDS``.
        arguments: its options.

    Returns:
        The exit code: 0 all was done, 1 some inputs failed, 2 the input is bad, 130 Ctrl-C.
    """
    try:
        import tyro

        return tyro.cli(load_command(name), args=arguments, prog=f"gamba {name}") or 0
    except UserError as error:
        print(f"gamba: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("gamba: interrupted", file=sys.stderr)
        return 130


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = _main(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader left, as `head` does; Python would complain at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    sys.exit(code)


def _main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0
    if arguments[0] in ("-V", "--version"):
        print(__version__)
        return 0
    try:
        name, rest = _find(arguments)
    except UserError as error:
        print(f"gamba: {error}", file=sys.stderr)
        return 2
    return run(name, rest)
