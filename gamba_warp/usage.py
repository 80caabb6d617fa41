"""Options of a command, read from its signature: for its help, completion and config files."""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, NamedTuple

from .errors import UserError
from .untrusted.documents import read_config

# Options of every command, which the console script handles itself.
COMMON = {
    "-q, --quiet": "Print errors and warnings only.",
    "-v, --verbose": "Also print the time taken, the compiler's messages, and errors in full.",
    "--config FILE": "Take options from a file (.yaml, .toml, .json) or from the folder of an "
    "earlier run; those that are given override it.",
    "-h, --help": "Print this text.",
}
CONFIG_SUFFIXES = (".yaml", ".yml", ".toml")  # train reads its run's config.json itself
_KINDS = {int: "INT", float: "FLOAT", Path: "PATH"}
_UNIONS = (typing.Union, types.UnionType)
_NO_DEFAULT = (MISSING, inspect.Parameter.empty)
_WHOLE: dict[str, Any] = {"break_on_hyphens": False, "break_long_words": False}
_COLUMN = 26  # where the texts begin
_MANY = 40  # options above which help shows the later groups by name only


class Option(NamedTuple):
    """Option or positional argument of a command.

    Attributes:
        names: as written: ``--out`` and aliases; without dashes for a positional argument.
        group: title of its group; empty for the command's own.
        values: description of its values, such as ``PATH``; empty for a switch.
        choices: allowed values; empty for any.
        several: it takes any number of values.
        path: its values are paths of files or folders.
        default: as text; empty if there is none to state.
        required: it has no default.
        help: its purpose.
    """

    names: tuple[str, ...]
    group: str
    values: str
    choices: tuple[str, ...]
    several: bool
    path: bool
    default: str
    required: bool
    help: str

    @property
    def key(self) -> str:
        """Name without dashes, as in a config file: ``batch-size``."""
        return self.names[0].lstrip("-")

    @property
    def positional(self) -> bool:
        return not self.names[0].startswith("-")


def options_of(kind: Any, group: str = "", instance: Any = None) -> Iterator[Option]:
    """Yield the options of a command, and then those of its dataclasses, a group each.

    Args:
        kind: function of a command, or a dataclass of options.
        group: title of the dataclass.
        instance: an object of it that has the defaults.
    """
    import tyro

    positional = typing.get_args(tyro.conf.Positional[int])[1]
    hidden = typing.get_args(tyro.conf.Suppress[int])[1]
    hints, texts = typing.get_type_hints(kind, include_extras=True), _texts(kind)
    if is_dataclass(kind):
        defaults = {
            f.name: f.default_factory() if f.default_factory is not MISSING else f.default
            for f in fields(kind)
        }
        defaults |= {} if instance is None else vars(instance)
    else:
        parameters = inspect.signature(kind).parameters
        defaults = {name: p.default for name, p in parameters.items()}
    for name, hint in hints.items():
        if name not in defaults:  # the result
            continue
        notes, parts = _parts(hint)
        default = defaults[name]
        inner = next((part for part in parts if is_dataclass(part)), None)
        if inner is not None:
            given = None if default in _NO_DEFAULT else default
            # The only argument of a command has the command's own options.
            yield from options_of(inner, group if len(defaults) == 1 else name, given)
            continue
        if hidden in notes:
            continue
        written = [x for note in notes for x in getattr(note, "aliases", None) or ()]
        metavar = next((note.metavar for note in notes if getattr(note, "metavar", None)), None)
        choices = tuple(str(v) for p in parts if _is_literal(p) for v in typing.get_args(p))
        several = any(... in typing.get_args(part) for part in _members(hint))
        flat = parts == [bool]
        plain = name.replace("_", "-")
        names = (plain,) if positional in notes else (f"--{plain}", *written)
        if metavar is None and not flat:
            metavar = f"{{{','.join(choices)}}}" if choices else _KINDS.get(parts[0], "TEXT")
            metavar = plain.upper() if positional in notes and not choices else metavar
            metavar += " ..." if several else ""
        yield Option(
            names=names,
            group=group,
            values=metavar or "",
            choices=choices,
            several=several,
            path=Path in parts,
            default="" if flat and default is False else _text_of(default),
            required=default in _NO_DEFAULT,
            help=texts.get(name, ""),
        )


def _members(hint: Any) -> list[Any]:
    """Return the members of a union, or the type itself; without ``Annotated`` and ``None``."""
    while hasattr(hint, "__metadata__"):
        hint = hint.__origin__
    if typing.get_origin(hint) in _UNIONS:
        return [m for part in typing.get_args(hint) for m in _members(part)]
    return [] if hint is type(None) else [hint]


def _parts(hint: Any) -> tuple[list[Any], list[Any]]:
    """Return the notes of a type, and its innermost types: those of a tuple or union."""
    notes: list[Any] = []
    while hasattr(hint, "__metadata__"):
        notes, hint = [*hint.__metadata__, *notes], hint.__origin__
    inner: list[Any] = []
    for part in _members(hint):
        if typing.get_origin(part) is tuple:
            for item in typing.get_args(part):
                inner += [] if item is ... else _parts(item)[1]
        else:
            inner.append(part)
    return notes, inner


def _is_literal(kind: Any) -> bool:
    return typing.get_origin(kind) is Literal


def _text_of(default: Any) -> str:
    """Return a default as it is typed; empty if there is none to state."""
    if isinstance(default, (tuple, list)):
        return " ".join(map(str, default))
    known = default is not None and default not in _NO_DEFAULT
    return ("on" if default is True else str(default)) if known else ""


def _texts(kind: Any) -> dict[str, str]:
    """Return the texts of arguments or fields, by name."""
    import docstring_parser

    found = {}
    for source in kind.__mro__[::-1] if isinstance(kind, type) else [kind]:
        if source is object or not source.__doc__:
            continue
        for param in docstring_parser.parse(source.__doc__).params:
            found[param.arg_name] = " ".join((param.description or "").split())
    return found


def help_text(name: str, command: Callable, everything: bool) -> str:
    """Return the help of a command.

    Args:
        name: of the command.
        command: its function.
        everything: show every option; else a command of many options lists those of its later
            groups by name.
    """
    import docstring_parser

    width = min(100, shutil.get_terminal_size((80, 24)).columns)
    options = list(options_of(command))
    usage = [_spelled(option)[-1] for option in options if option.positional or option.required]
    about = docstring_parser.parse(inspect.getdoc(command) or "")
    lines = [f"usage: gamba {name} {' '.join(usage)}".rstrip() + " [OPTIONS]", ""]
    for text in filter(None, (about.short_description, about.long_description)):
        lines += [*_wrapped(text, width), ""]
    groups: dict[str, list[Option]] = {}
    for option in sorted(options, key=lambda option: not option.positional):
        groups.setdefault("" if option.positional else option.group or "options", []).append(option)
    short = len(options) > _MANY and not everything
    for group, members in groups.items():
        lines += [f"{group}:"] if group else []
        if short and group not in ("", "options"):
            names = ", ".join(option.names[0] for option in members)
            lines += _wrapped(names, width, "  ")
        else:
            for option in members:
                lines += _entry(", ".join(_spelled(option)), _with_default(option), width)
        lines.append("")
    lines.append("every command:")
    common = dict(COMMON)
    if short:
        common |= {"--help-all": "Print every option with its explanation."}
    for names, text in common.items():
        if not any(names.partition(" ")[0] in option.names for option in options):
            lines += _entry(names, text, width)
    return "\n".join(lines)


def _spelled(option: Option) -> list[str]:
    """Return the ways to write an option, the last with its values."""
    if option.positional:
        return [option.values]
    *first, last = sorted(option.names, key=len)
    if option.names[0] == "--out":
        first = ["-o", *(name for name in first if name != "-o")]
    return [*first, f"{last} {option.values}".rstrip(), *_offs([option])]


def _offs(options: Sequence[Option]) -> list[str]:
    """Return the names that turn off the switches that are on by default."""
    return [f"--no-{o.key}" for o in options if not o.values and o.default]


def _with_default(option: Option) -> str:
    shown = f" (default: {option.default})" if option.default else ""
    return option.help.rstrip() + shown


def _entry(left: str, text: str, width: int) -> list[str]:
    """Return the lines of an option: its name, then its text in a column."""
    rows = _wrapped(text, width, " " * _COLUMN) or [""]
    if len(left) + 4 > _COLUMN:
        return [f"  {left}", *rows]
    return [f"  {left:<{_COLUMN - 2}}{rows[0][_COLUMN:]}", *rows[1:]]


def _wrapped(text: str, width: int, indent: str = "") -> list[str]:
    words = " ".join(text.split())
    return textwrap.wrap(words, width, initial_indent=indent, subsequent_indent=indent, **_WHOLE)


class Words(NamedTuple):
    """Arguments of a command, without the options that every command has.

    Attributes:
        arguments: for the command.
        quiet, verbose: these options were given.
    """

    arguments: list[str]
    quiet: bool
    verbose: bool


def read_words(arguments: Sequence[str], command: Callable) -> Words:
    """Check the names of options, and merge the values of a repeated option.

    tyro silently keeps the last values only. Options of ``--config`` come first, so that tyro keeps
    those of the command line.

    Args:
        arguments: of the command line.
        command: function of the command.

    Raises:
        UserError: an option is unknown, or repeated although it takes one value; a file is a URL;
            or the file of ``--config`` is invalid.
    """
    options = list(options_of(command))
    known = {name.lstrip("-"): option for option in options for name in option.names}
    common = {"q": "quiet", "v": "verbose", "quiet": "quiet", "verbose": "verbose"}
    aliases = {"o": "out"}
    switches: set[str] = set()
    first: dict[str, list[str]] = {}
    groups = [values := []]
    owner = None  # the option that the next word may belong to
    for at, word in enumerate(arguments):
        if word == "--":  # no options follow
            groups.append([*arguments[at:]])
            break
        if not re.match("--?[A-Za-z]", word):
            _check_no_url(word, owner)
            values.append(word)
            owner = owner if owner is not None and owner.several else None
            continue
        written, _, value = word.partition("=")
        key = written.lstrip("-").replace("_", "-").removeprefix("no-")
        if key not in known and key in common:
            switches.add(common[key])
            continue
        if key not in known and aliases.get(key) in known:
            key = aliases[key]
            word = f"--{key}" + word[len(written) :]
        if key not in known and key != "config":
            raise UserError(f"unknown option {written}{_closest(key, known, '--')}")
        owner = known.get(key)
        _check_no_url(value, owner)
        several, name = owner is not None and owner.several, owner.key if owner else key
        if name not in first:
            values = [word.partition("=")[0], *([value] if value else [])] if several else [word]
            groups.append(values)
            first[name] = values
        elif several:
            values = first[name]
            values += [value] if value else []
        else:
            earlier = first[name][0].partition("=")[0]
            which = f"{earlier} once" if written == earlier else f"{earlier} or {written}"
            raise UserError(f"give {which}: this option takes one value")
    path = "=".join(first.get("config", [""])).partition("=")[2]
    if "config" in first and ("config" not in known or path.endswith(CONFIG_SUFFIXES)):
        at = groups.index(first["config"])
        groups[0] += groups.pop(at)[1 if "=" in first["config"][0] else 2 :]
        taken = config_words(Path(path), options)
        groups[0] = (groups[0] or taken[0]) + taken[1]
    return Words([w for group in groups for w in group], "quiet" in switches, "verbose" in switches)


def _closest(name: str, known: Iterable[str], dashes: str = "") -> str:
    """Return a question for the known name that is closest to an unknown one, or nothing."""
    close = get_close_matches(name, known, 1)
    return f"; did you mean {dashes}{close[0]}?" if close else ""


def config_words(path: Path, options: Sequence[Option]) -> tuple[list[str], list[str]]:
    """Return the arguments and the options that a config file holds, as words.

    Args:
        path: names of options, with or without the groups of the help, and values; or the folder of
            an earlier run (``read_config``).
        options: of the command.

    Raises:
        UserError: the file is invalid, or a name is not that of an option.
    """
    flat: dict[str, Any] = {}
    for name, value in read_config(path).items():
        flat |= value if isinstance(value, dict) else {name: value}
    known = {option.key: option for option in options}
    arguments, words = {}, []
    for name, value in flat.items():
        key = name.replace("_", "-")
        option = known.get(key)
        if option is None:
            raise UserError(f"{path}: unknown option {name}{_closest(key, known)}")
        values = value if isinstance(value, list) else [value]
        if any(re.match("--?[A-Za-z]", str(one)) for one in values):
            raise UserError(f"{path}: {name}: {value!r} is not a valid value of an option")
        if option.positional:
            arguments[key] = [str(one) for one in values]
        elif isinstance(value, bool) and option.choices:  # YAML's on and off
            words += [f"--{key}", "on" if value else "off"]
        elif isinstance(value, bool):
            words.append(f"--{key}" if value else f"--no-{key}")
        elif value is not None:
            words += [f"--{key}", *map(str, values)]
    return [word for key in known for word in arguments.get(key, ())], words


def _check_no_url(word: str, owner: Option | None) -> None:
    if re.match("[a-z][a-z0-9+]+://", word) and (owner is None or owner.path or not owner.values):
        is_file = re.search(r"//.+/.*\.\w+$", word)
        fetched = "" if is_file else ", or fetch its shards: gamba data fetch --address"
        raise UserError(f"{word} is a URL; download it, and give the file's name{fetched}")


def completions(command: Callable, given: Sequence[str], last: str) -> list[str]:
    """Return what the last word may become: names of options, or values of the option before it.

    Args:
        command: function of the command.
        given: words after its name, without the last.
        last: the unfinished word.
    """
    options = [option for option in options_of(command) if not option.positional]
    if last.startswith("-"):
        common = re.findall("--[a-z]+", " ".join(COMMON))
        return [word for option in options for word in option.names] + _offs(options) + common
    at = next((at for at, word in enumerate(given[::-1]) if word.startswith("-")), None)
    if at is None:
        return []
    owner = next((o for o in options if given[-1 - at] in o.names), None)
    return [*owner.choices] if owner is not None and (owner.several or at == 0) else []
