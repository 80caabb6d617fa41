"""The console script ``gamba``: finds the command, parses its options with tyro, runs it."""

from __future__ import annotations

import errno
import importlib
import inspect
import io
import os
import re
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from difflib import get_close_matches
from functools import partial, wraps
from typing import Any, Literal, NamedTuple, TextIO, cast

import tyro
from tyro import _errors as errors  # bounded in setup.cfg

from .batch import STAGES
from .devices import keep_memory, quiet_warp, share_cores, use_fastest_products
from .errors import FileWarning, PrintableStream, UserError
from .files import DISK_ERRORS
from .versions import PROCEDURAL, SHAPES, __version__, advice, require


class Command(NamedTuple):
    """Command of the console script.

    Attributes:
        about: its purpose, a line.
        extra: the extra that brings its libraries; empty for the core.
        needs: libraries that it always needs; options check their own on use.
        uses: it launches "kernels" (``quiet_warp``), runs the "network" (``keep_memory``,
            ``use_fastest_products``), or leaves "cores" to others while it waits (``share_cores``),
            unlike training and measurements, which keep torch's busy-waiting.
        module: has its function, and is imported when called; "a b-c" is ``a_b_c_command``, by
            default of ``gamba_warp.commands.a_b_c``.
    """

    about: str
    extra: str = ""
    needs: tuple[str, ...] = ()
    uses: tuple[Literal["kernels", "network", "cores"], ...] = ()
    module: str = ""


_DATA, _TRAIN = "gamba_warp.train.sources.commands", "gamba_warp.train.command"
_VIEWS, _SHAPES = "gamba_warp.eval.views.command", "gamba_warp.eval.shapes.command"
_COMPARE, _ABLATION = "gamba_warp.eval.compare_command", "gamba_warp.ablation.command"
_MACHINE, _WEIGHTS = "gamba_warp.commands.machine", "gamba_warp.commands.weights"
_APP, _GRADIO = "gamba_warp.app.server", ("gradio",)
_RENDERS, _METRICS = ("trimesh", "open3d", "manifold3d"), ("kornia",)
_MODEL: Any = ("kernels", "network")
_DRAWING: Any = ("kernels", "cores")
_IMAGES: Any = (*_MODEL, "cores")
# A command has one or two words.
COMMANDS = {
    "demo": Command("Reconstruct and evaluate the starter set.", "all", SHAPES, _MODEL),
    "reconstruct": Command("Images to 3D Gaussians.", "photo", (), _IMAGES),
    "train": Command("Train a model on posed views.", "train", _METRICS, _MODEL, _TRAIN),
    "data furniture": Command("Get 820 models.", "", (), (), _DATA),
    "data procedural": Command("Make models of random parts.", "mesh", PROCEDURAL, (), _DATA),
    "data render": Command("Meshes to posed views.", "mesh", _RENDERS, (), _DATA),
    "data pack": Command("Posed views to shards.", "shards", ("webdataset",), (), _DATA),
    "data index": Command("Check a dataset once, for all later starts.", "", (), (), _DATA),
    "data gso": Command("Google Scanned Objects, for evaluation.", "mesh", _RENDERS, (), _DATA),
    "eval-views": Command("PSNR, SSIM, LPIPS of views.", "eval", _METRICS, _MODEL, _VIEWS),
    "eval-geometry": Command("Chamfer, IoU, F-score.", "eval", SHAPES, (), _SHAPES),
    "compare": Command("Reports of several methods in one table.", "", (), (), _COMPARE),
    "ablate": Command("Train and compare variants of a model.", "all", _METRICS, _MODEL, _ABLATION),
    "export": Command("Gaussians to meshes, splats and pages.", "mesh", (), _DRAWING),
    "view": Command("Gaussians or a mesh in the browser."),
    "render": Command("Gaussians to images and movies along a path.", "", (), _DRAWING),
    "app": Command("Images to 3D on a page of this machine.", "app", _GRADIO, _IMAGES, _APP),
    "bench": Command("Run time against error, on this machine.", "", (), _MODEL, _MACHINE),
    "stress": Command(
        "Random hostile cases against float64.", "stress", ("hypothesis",), ("kernels",), _MACHINE
    ),
    "import-released": Command(
        "The authors' public weights to ours.", "train", ("timm",), (), _WEIGHTS
    ),
    "weights lpips": Command("Fetch the LPIPS-VGG weights.", "", (), (), _WEIGHTS),
    "doctor": Command(
        "Check this machine's libraries and devices.", "", (), ("kernels",), _MACHINE
    ),
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
    close = get_close_matches(
        arguments[0], [*COMMANDS, *(n.split()[0] for n in COMMANDS), "help"], 1
    )
    meant = f"did you mean {close[0]!r}?" if close else "gamba --help lists them"
    raise UserError(f"unknown command '{arguments[0]}'; {meant}")


def load_command(name: str) -> Callable[..., int | None]:
    """Import the function of one of ``COMMANDS``."""
    plain = name.replace(" ", "_").replace("-", "_")
    module = importlib.import_module(COMMANDS[name].module or f"gamba_warp.commands.{plain}")
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
    verbose = False
    try:
        row, command = COMMANDS[name], load_command(name)
        if {"-h", "--help"} & {*arguments}:
            print(help_text(name, command, _expanded(command, arguments)), end="")
            return 0
        require(*row.needs)
        arguments, quiet, verbose = _common(arguments)
        call = _parsed(command, _expanded(command, arguments), f"gamba {name}")
        if check := vars(command).get("check"):
            check(*call.args, **call.keywords)
        if name == "app" and not quiet:  # which takes long to start
            print("loading torch", flush=True)
        elif "network" in row.uses and sys.stderr.isatty() and not quiet:
            print("loading torch", file=sys.stderr, flush=True)
        if "cores" in row.uses:
            share_cores()
        if "network" in row.uses:
            keep_memory()
            use_fastest_products()
        if "kernels" in row.uses and not verbose:
            quiet_warp()
        STAGES.verbose = verbose
        with _quiet() if quiet else nullcontext():
            code = call() or 0
        if verbose:
            table = [STAGES.table()] if STAGES.seconds else []
            print("\n".join([*table, f"{time.process_time():.1f} s of CPU time"]), file=sys.stderr)
        return code
    except BrokenPipeError:
        raise  # the reader of the output closed it; see ``main``
    except KeyboardInterrupt:
        _print_error("interrupted")
        return 130
    except Exception as error:
        reason = _user_message(error, name)
        if reason is None:
            raise
        if verbose:
            traceback.print_exc()
        _print_error(reason)
        return 2


def _common(arguments: list[str]) -> tuple[list[str], bool, bool]:
    """Take the options that every command has out of the arguments; write ``-o`` as ``--out``.

    Returns:
        The other arguments, and whether ``--quiet`` and ``--verbose`` were given.

    Raises:
        UserError: an option is repeated; tyro would silently keep the last one.
    """
    flags: dict[str, list[str]] = {"-q": [], "-v": []}
    left, seen = [], set()
    for at, word in enumerate(arguments):
        if word == "--":  # no options follow
            left += arguments[at:]
            break
        word = re.sub("^-o(?==|$)", "--out", word)
        if (short := word.replace("--quiet", "-q").replace("--verbose", "-v")) in flags:
            flags[short].append(word)
            continue
        if word.startswith("--"):
            name = word.partition("=")[0].replace("_", "-")
            if (key := name.replace("--no-", "--", 1)) in seen:
                raise UserError(f"{name} may be given only once")
            seen.add(key)
        left.append(word)
    return left, bool(flags["-q"]), bool(flags["-v"])


# A missing option has the default None, which users cannot give.
_CONFIG = (tyro.conf.DisallowNone, tyro.conf.HelptextFromCommentsOff)
_NO_DEFAULT = re.compile(r"\s*\(default:\s*(None)?\)")
_KINDS = {"INT": "a whole number", "FLOAT": "a number"}
# Earlier names of options.
RENAMED = {
    "--frame": "--axes",
    "--mesh-frame": "--mesh-axes",
    "--no-lpips": "--lpips off",
    "--made": "--procedural",
    "--front-share": "--front-fraction",
    "--decay-share": "--decay-fraction",
    "--mirror": "--flip",
    "--recolor": "--color-jitter",
    "--recompute": "--activation-checkpointing",
    "--save-pictures": "--save-images",
    "--resize-pictures": "--resize-images",
}


def help_text(name: str, command: Callable, arguments: list[str]) -> str:
    """Return the help of a command, by tyro, and the options that every command has."""
    # tyro would keep the line breaks of an argument's text; a text begins with a capital.
    inner = inspect.unwrap(command)
    doc = re.sub(r"(?<=\S)\n {8,}(?=\S)", " ", inspect.cleandoc(inner.__doc__ or ""))
    inner.__doc__ = re.sub(
        r"(?m)^ {4}\w+: \w", lambda start: start[0][:-1] + start[0][-1].upper(), doc
    )
    shown = io.StringIO()
    with redirect_stdout(shown), suppress(SystemExit):
        tyro.cli(command, args=[*arguments, "--help"], prog=f"gamba {name}", config=_CONFIG)
    text = _NO_DEFAULT.sub("", shown.getvalue())
    lines = [line.rstrip() for line in text.splitlines()]
    common = "-q, --quiet: errors and warnings only; -v, --verbose: times, and errors in full"
    return "\n".join([*lines, f"every command: {common}", ""])


def _parsed(command: Callable, arguments: list[str], program: str) -> partial[int | None]:
    """Return the command with its arguments.

    Raises:
        UserError: they are invalid.
    """
    calls: list[partial[int | None]] = []

    @wraps(command)
    def keep(*values: Any, **options: Any) -> None:
        calls.append(partial(command, *values, **options))

    def refuse(event: errors.ParseErrorEvent) -> None:
        raise UserError(f"{_reason(event)}; {program} --help")

    with errors.on_parse_error(refuse):
        tyro.cli(keep, args=arguments, prog=program, config=_CONFIG)
    return calls[0]


def _reason(event: errors.ParseErrorEvent) -> str:
    """Return what is wrong with the arguments."""
    if isinstance(event, errors.MissingArgs) and not event.unrecognized_tokens:
        names = [_name(missing.arg) for missing in event.missing_arguments]
        return f"missing argument{'s' * (len(names) > 1)}: {', '.join(names)}"
    if isinstance(event, (errors.UnrecognizedArgs, errors.MissingArgs)):
        unknown = isinstance(event, errors.UnrecognizedArgs)
        tokens = event.tokens if unknown else event.unrecognized_tokens
        name = next((token for token in tokens if token.startswith("--")), None)
        if name is None:
            return f"unexpected argument{'s' * (len(tokens) > 1)}: {' '.join(tokens)}"
        name = name.partition("=")[0]
        return f"{name} is now {RENAMED[name]}" if name in RENAMED else f"unknown option {name}"
    if isinstance(event, errors.InvalidChoice):
        choices = ", ".join(sorted({*event.choices} - {"None"}))
        return f"invalid choice '{event.value}' for {_name(event.argument)}: not one of {choices}"
    if isinstance(event, errors.BadValue):
        name = _name(event.argument)
        return f"{name} needs a value" if name.startswith("-") else f"missing argument: {name}"
    if isinstance(event, errors.InstantiationFailure):
        kind = "" if event.argument is None else event.argument.lowered.metavar
        values = re.findall("'(.*?)'", event.message) if kind in _KINDS else []
        where = "" if event.argument is None else f"{_name(event.argument)}: "
        if values:
            return f"{where}expected {_KINDS[str(kind)]}, got '{values[-1]}'"
        return where + event.message.partition("\n")[0]
    return "invalid arguments"


def _name(argument: Any) -> str:
    """Return an option, or a positional argument in capitals."""
    name = argument.display_name()
    return name if name.startswith("-") else name.rpartition(".")[2].upper()


def _expanded(command: Callable, arguments: list[str]) -> list[str]:
    """Return the arguments as the command's own module expands them, if it does."""
    expand = getattr(sys.modules.get(command.__module__), "expand", None)
    return expand(arguments) if expand else arguments


@contextmanager
def _quiet() -> Iterator[None]:
    """Print nothing on stdout but JSON, and draw no progress bars."""
    STAGES.quiet, STAGES.stdout = True, sys.stdout
    try:
        with open(os.devnull, "w", encoding="utf-8") as nothing, redirect_stdout(nothing):
            yield
    finally:
        STAGES.quiet, STAGES.stdout = False, None


def _user_message(error: Exception, command: str) -> str | None:
    """Return the user-facing message of an error, in one line; None for a bug."""
    text = " ".join(str(error).split())
    if isinstance(error, UserError):
        return text or "bad input"
    if isinstance(error, ModuleNotFoundError):
        return advice(error.name or "", command, COMMANDS[command].extra)
    # torch raises plain RuntimeErrors when it runs out of memory on the CPU.
    exhausted = type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in text
    if isinstance(error, MemoryError) or exhausted:
        return f"not enough memory ({text[:200]})" if text else "not enough memory"
    known = {*DISK_ERRORS, errno.EMFILE, errno.ENFILE}
    if isinstance(error, OSError) and (error.filename is not None or error.errno in known):
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
    """Format a warning; a ``FileWarning`` is one line without a source location."""
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
    out, notes = PrintableStream(sys.stdout), PrintableStream(sys.stderr)
    try:
        with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, notes)):
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
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"gamba {__version__}: one image to 3D Gaussians\n\nCommands:")
        for name, row in COMMANDS.items():
            print(f"  gamba {name:<15} {row.about}")
        print("\ngamba help COMMAND shows the options of one.")
        return 0
    if arguments[0] in ("-V", "--version"):
        print(__version__)
        return 0
    try:
        name, remaining = _find_command(arguments)
    except UserError as error:
        _print_error(str(error))
        return 2
    return run(name, remaining)
