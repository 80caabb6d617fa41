"""The console script ``gamba``: finds the command, parses its options with tyro, runs it."""

from __future__ import annotations

import importlib
import os
import sys

from .errors import UserError
from .versions import __version__

# command (one or two words) -> ("module:function", one line of help). Modules load when called.
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "gamba_warp.commands.demo:demo_command",
        "Train, reconstruct and evaluate on the starter set.",
    ),
    "reconstruct": (
        "gamba_warp.commands.reconstruct:reconstruct_command",
        "Pictures to 3D Gaussians.",
    ),
    "train": ("gamba_warp.train.command:train_command", "Train a model on posed views."),
    "fit": ("gamba_warp.commands.fit:fit_command", "Posed views of an object to 3D Gaussians."),
    "data furniture": ("gamba_warp.train.data.furniture:furniture_command", "Get 820 models."),
    "data render": ("gamba_warp.train.data.render:render_command", "Meshes to posed views."),
    "eval-views": (
        "gamba_warp.eval.views.command:eval_views_command",
        "PSNR, SSIM, LPIPS of views.",
    ),
    "eval-geometry": (
        "gamba_warp.eval.shapes.command:eval_geometry_command",
        "Chamfer, IoU, F-score.",
    ),
    "export": (
        "gamba_warp.commands.export:export_command",
        "Gaussians to meshes, splats and pages.",
    ),
    "view": ("gamba_warp.commands.view:view_command", "Gaussians in the browser."),
    "bench": (
        "gamba_warp.commands.bench:bench_command",
        "Run time against error, on this machine.",
    ),
    "stress": (
        "gamba_warp.commands.stress:stress_command",
        "Random hostile cases against float64.",
    ),
    "gpu-check": (
        "gamba_warp.gpu_check.check:gpu_check_command",
        "Test and measure on a CUDA machine.",
    ),
    "weights lpips": (
        "gamba_warp.commands.weights:weights_command",
        "Fetch the LPIPS-VGG weights.",
    ),
    "doctor": ("gamba_warp.commands.doctor:doctor_command", "Say what this machine can run."),
}


def _usage() -> str:
    lines = [f"gamba {__version__}: one image to 3D Gaussians", "", "Commands:"]
    lines += [f"  gamba {name:<14} {text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join([*lines, "", "gamba COMMAND --help shows the options of one."])


def _find(arguments: list[str]) -> tuple[str, list[str]]:
    for words in (2, 1):
        name = " ".join(arguments[:words])
        if name in COMMANDS:
            return name, arguments[words:]
    group = [name for name in COMMANDS if name.startswith(arguments[0] + " ")]
    if group:
        raise UserError(f"'{arguments[0]}' needs one of: {', '.join(group)}")
    raise UserError(f"unknown command '{arguments[0]}'; gamba --help lists them")


def run(name: str, arguments: list[str]) -> int:
    """Runs one command and returns its exit code: 0 done, 1 some inputs failed, 2 bad input."""
    import tyro

    module, function = COMMANDS[name][0].split(":")
    try:
        command = getattr(importlib.import_module(module), function)
        return tyro.cli(command, args=arguments, prog=f"gamba {name}") or 0
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
