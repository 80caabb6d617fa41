"""The console script ``gamba``: finds the command, parses its options with tyro, runs it."""

from __future__ import annotations

import importlib
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

from .devices import keep_memory, quiet_warp, share_cores, use_fastest_products
from .errors import FileWarning, UserError
from .files import DISK_ERRORS
from .versions import __version__, advice, missing

# A command has one or two words. The command "a b-c" is the function ``a_b_c_command`` of
# ``gamba_warp.commands.a_b_c``, unless MODULES names another module; it is imported when called.
COMMANDS = {
    "demo": "Train, reconstruct and evaluate on the starter set.",
    "reconstruct": "Pictures to 3D Gaussians.",
    "train": "Train a model on posed views.",
    "fit": "Posed views of an object to 3D Gaussians.",
    "data furniture": "Get 820 models.",
    "data made": "Make models: toys, shoes, tools, boxes.",
    "data render": "Meshes to posed views.",
    "data pack": "Posed views to a few large files.",
    "data index": "Check a dataset once, for all later starts.",
    "data objaverse": "Objaverse, and its G-Objaverse views.",
    "data gso": "Google Scanned Objects, for evaluation.",
    "eval-views": "PSNR, SSIM, LPIPS of views.",
    "eval-geometry": "Chamfer, IoU, F-score.",
    "compare": "Reports of several methods in one table.",
    "ablate": "Train and compare variants of a model.",
    "export": "Gaussians to meshes, splats and pages.",
    "view": "Gaussians in the browser.",
    "render": "Gaussians to pictures and movies along a path.",
    "app": "Pictures to 3D on a page of this machine.",
    "bench": "Run time against error, on this machine.",
    "stress": "Random hostile cases against float64.",
    "gpu-check": "Test and measure on a CUDA machine.",
    "import-released": "The authors' public weights to ours.",
    "weights lpips": "Fetch the LPIPS-VGG weights.",
    "doctor": "Say what this machine can run.",
}
# Interactive commands (``share_cores``); training and measurements keep torch's busy-waiting.
SHARING = {"reconstruct", "export", "render", "app"}
# Commands that run the network (``keep_memory``, ``use_fastest_products``).
KEEPING = {"reconstruct", "app", "train", "ablate", "bench", "demo", "fit", "eval-views"}
# Commands that launch kernels (``quiet_warp``).
LAUNCHING = KEEPING | {"export", "render", "stress", "gpu-check", "doctor"}
MODULES = {
    "app": "gamba_warp.app.server",
    "train": "gamba_warp.train.command",
    **{name: "gamba_warp.train.sources.commands" for name in COMMANDS if name[:5] == "data "},
    "ablate": "gamba_warp.ablation.command",
    **dict.fromkeys(("bench", "stress", "gpu-check", "doctor"), "gamba_warp.commands.machine"),
    **dict.fromkeys(("import-released", "weights lpips"), "gamba_warp.commands.weights"),
    "eval-views": "gamba_warp.eval.views.command",
    "eval-geometry": "gamba_warp.eval.shapes.command",
    "compare": "gamba_warp.eval.compare_command",
}


def _find_command(arguments: list[str]) -> tuple[str, list[str]]:
    """Split the arguments into the command's name and its options."""
    for words in (2, 1):
        name = " ".join(arguments[:words])
        if name in COMMANDS:
            return name, arguments[words:]
    group = [name for name in COMMANDS if name.startswith(arguments[0] + " ")]
    if group:
        raise UserError(f"'{arguments[0]}' needs one of: {', '.join(group)}")
    raise UserError(f"unknown command '{arguments[0]}'; gamba --help lists them")


def load_command(name: str) -> Callable[..., int | None]:
    """Import the function of one of ``COMMANDS``."""
    plain = name.replace(" ", "_").replace("-", "_")
    module = importlib.import_module(MODULES.get(name, f"gamba_warp.commands.{plain}"))
    return getattr(module, f"{plain}_command")


def run(name: str, arguments: list[str]) -> int:
    """Run one command.

    Args:
        name: one of ``COMMANDS``.
        arguments: its options.

    Returns:
        The exit code: 0 success, 1 some inputs failed, 2 bad input or a missing resource (memory,
        a file, the disk), 130 Ctrl-C. Any other error is a bug, and keeps its traceback.
    """
    try:
        import tyro

        helps = bool({"-h", "--help"} & {*arguments})
        reason = None if helps else missing(name)
        if reason is not None:
            raise UserError(reason)
        if name in SHARING:
            share_cores()
        if name in KEEPING:
            keep_memory()
            use_fastest_products()
        if name in LAUNCHING and not helps:
            quiet_warp()
        command = load_command(name)
        if name != "train":  # which has the option itself, and records it
            arguments = _load_plugins(arguments)
        arguments = _merge_repeated(arguments, command)
        expand = getattr(sys.modules.get(command.__module__), "expand", None)
        arguments = expand(arguments) if expand else arguments
        # None marks an option that is left out; the word "None" is not a valid value.
        plain = (tyro.conf.DisallowNone,)
        return tyro.cli(command, args=arguments, prog=f"gamba {name}", config=plain) or 0
    except BrokenPipeError:
        raise  # the reader of the output closed it; see ``main``
    except KeyboardInterrupt:
        _print_error("interrupted")
        return 130
    except Exception as error:
        reason = _user_message(error, name)
        if reason is None:
            raise
        _print_error(reason)
        return 2


def _load_plugins(arguments: list[str]) -> list[str]:
    """Load the plugins of ``--plugin``; return the other arguments. Raises UserError."""
    if "--plugin" not in arguments:
        return arguments
    at = arguments.index("--plugin")
    end = at + 2
    while end < len(arguments) and re.match(r"[A-Za-z_]\w*=|.*\.py$", arguments[end]):
        end += 1
    if end > len(arguments):
        raise UserError("--plugin: expected a .py file or an installed plugin")
    from .plugins import load

    load(arguments[at + 1 : end])
    return arguments[:at] + arguments[end:]


def _merge_repeated(arguments: list[str], command: Callable) -> list[str]:
    """Merge the values of a repeated option, of which tyro silently keeps the last only.

    Raises UserError if the option takes one value.
    """
    options = dict(_options(command))
    first: dict[str, list[str]] = {}
    groups = [values := []]
    for at, word in enumerate(arguments):
        if word == "--":  # no options follow
            groups.append(arguments[at:])
            break
        if not re.match("--?[A-Za-z]", word):
            values.append(word)
            continue
        written, _, value = word.partition("=")
        key = written.lstrip("-").replace("_", "-").removeprefix("no-")
        name, several = options.get(key, (key, False))
        if name not in first:
            values = [written, *([value] if value else [])] if several else [word]
            groups.append(values)
            first[name] = values
        elif several:
            values = first[name]
            values += [value] if value else []
        else:
            earlier = first[name][0].partition("=")[0]
            which = f"{earlier} once" if written == earlier else f"{earlier} or {written}"
            raise UserError(f"give {which}: this option takes one value")
    return [word for group in groups for word in group]


def _options(kind: Any) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield each option of a command or options class, its full name, and if it takes a list."""
    noted = get_type_hints(kind, include_extras=True)
    for name, hint in get_type_hints(kind).items():
        parts = hint, *get_args(hint)  # with the members of a union
        several = any(... in get_args(part) for part in parts)  # tuple[str, ...]
        aliases = [
            x for note in get_args(noted[name]) for x in getattr(note, "aliases", None) or ()
        ]
        for written in (name, *aliases):
            yield written.lstrip("-").replace("_", "-"), (name, several)
        for part in filter(is_dataclass, parts):
            yield from _options(part)


def _user_message(error: Exception, command: str) -> str | None:
    """Return the user-facing message of an error, in one line; None for a bug."""
    text = " ".join(str(error).split())
    if isinstance(error, UserError):
        return text or "bad input"
    if isinstance(error, ModuleNotFoundError):
        return advice(error.name or "", command)
    # torch raises plain RuntimeErrors when it runs out of memory on the CPU.
    exhausted = type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in text
    if isinstance(error, MemoryError) or exhausted:
        return f"not enough memory ({text[:200]})" if text else "not enough memory"
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK_ERRORS):
        where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return f"{where}{error.strerror or text}"
    if isinstance(error, UnicodeEncodeError) and error.reason == "surrogates not allowed":
        return f"the name of a file is not UTF-8: {error.object[:200]!r}"
    return None


def _print_error(text: str) -> None:
    """Print one line to standard error, unless that is closed or its disk is full."""
    with suppress(OSError, ValueError):
        print(f"gamba: {text}", file=sys.stderr, flush=True)


_default_format = warnings.formatwarning


def _format_warning(message: Any, category: type[Warning], *where: Any, **others: Any) -> str:
    """Format a warning; that of a file is one line without a place in the code."""
    if issubclass(category, FileWarning):
        return f"gamba: warning: {message}\n"
    return _default_format(message, category, *where, **others)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # file names need not be UTF-8
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _format_warning
    try:
        code = _main(arguments)
        sys.stdout.flush()
    except OSError as error:  # Python would fail again when it flushes at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):  # the reader closed the pipe, as `head` does
            code = 141
        elif error.errno in DISK_ERRORS:
            _print_error(f"cannot write the standard output: {error.strerror}")
            code = 2
        else:
            raise
    sys.exit(code)


def _main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"gamba {__version__}: one image to 3D Gaussians\n\nCommands:")
        for name, text in COMMANDS.items():
            print(f"  gamba {name:<14} {text}")
        print("\ngamba COMMAND --help shows the options of one.")
        print("gamba COMMAND ... --plugin my.py [NAME=VALUE ...] loads a plugin first.")
        return 0
    if arguments[0] in ("-V", "--version"):
        print(__version__)
        return 0
    try:
        name, rest = _find_command(arguments)
    except UserError as error:
        _print_error(str(error))
        return 2
    return run(name, rest)
