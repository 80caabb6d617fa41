"""Ranges of numbers, declared with a field or option and checked before a command starts.

A range is a ``msgspec.Meta``, so the same declaration also applies to JSON files.
"""

from __future__ import annotations

import functools
import inspect
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from ..errors import UserError

if TYPE_CHECKING:
    from msgspec import Meta as Meta
else:
    try:
        from msgspec import Meta
    except ImportError:  # `make gpu` needs only torch, numpy, warp-lang and pytest

        @dataclass(frozen=True, kw_only=True)
        class Meta:
            """Replacement of ``msgspec.Meta`` with optional bounds of a number."""

            ge: float | None = None
            gt: float | None = None
            le: float | None = None
            lt: float | None = None


Function = TypeVar("Function", bound=Callable)

# Types of options of several commands.
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Threads = Annotated[int, Meta(ge=1, le=4096)]
Minutes = Annotated[float, Meta(gt=0, le=1e6)]
Frames = Annotated[int, Meta(ge=2, le=10_000)]
Side = Annotated[int, Meta(ge=16, le=4096)]
Opacity = Annotated[float, Meta(ge=0, le=1)]
Elevation = Annotated[float, Meta(ge=-90, le=90)]  # degrees
Fov = Annotated[float, Meta(ge=1, le=160)]  # degrees
Distance = Annotated[float, Meta(ge=0.05, le=1000)]  # object units
Rate = Annotated[float, Meta(gt=0, le=1000)]  # images a second


def range_error(value: float, limits: Meta) -> str | None:
    """Describe the required range of a number outside it or not finite; None if it is valid.

    Args:
        value: any number.
        limits: its range; missing bounds are ignored.

    Returns:
        For example "must be above 0 and at most 10".
    """
    fits = (
        (limits.ge is None or value >= limits.ge)
        and (limits.gt is None or value > limits.gt)
        and (limits.le is None or value <= limits.le)
        and (limits.lt is None or value < limits.lt)
    )
    if fits and abs(value) < float("inf"):
        return None
    bounds = {"at least": limits.ge, "above": limits.gt, "at most": limits.le, "below": limits.lt}
    words = [f"{word} {bound:,}" for word, bound in bounds.items() if bound is not None]
    return f"must be {' and '.join(words) or 'finite'}"


def check_range(label: str, value: float, limits: Meta) -> None:
    """Check that a number is within its range.

    Args:
        label: start of the message, such as "--lr" or "p.json: seed is".
        value: any number.
        limits: its range.

    Raises:
        UserError: one line, such as "--lr inf: must be above 0 and at most 10".
    """
    reason = range_error(value, limits)
    if reason:
        huge = isinstance(value, int) and abs(value) > 10**30  # one may have a million digits
        shown, mark = "huge" if huge else value, "," if label.endswith(" is") else ":"
        raise UserError(f"{label} {shown}{mark} {reason}")


def check_kinds(values: Mapping[str, Any], owner: Callable, label: Callable[[str], str]) -> None:
    """Check values against plain types and ``Literal``s.

    Args:
        values: by name; an integer is accepted as a float, True and False only as a bool.
        owner: the dataclass that declares the types.
        label: start of the message, from a value's name.

    Raises:
        UserError: one line with the value and the expected type.
    """
    for name, kind in typing.get_type_hints(owner).items():
        value, choices = values[name], typing.get_args(kind)
        if typing.get_origin(kind) is typing.Literal:
            fits, words = value in choices, f"not one of {', '.join(choices)}"
        else:
            fits = isinstance(value, (int, float) if kind is float else kind)
            fits = fits and (kind is bool or not isinstance(value, bool))
            words = f"it must be of type {kind.__name__}"
        if not fits:
            raise UserError(f"{label(name)} {repr(value)[:100]}, {words}")


def check_values(values: Mapping[str, Any], owner: Callable, label: Callable[[str], str]) -> None:
    """Check values against the ranges declared by their types.

    Args:
        values: by name; a list or tuple is checked item by item, None is accepted.
        owner: the dataclass or function that declares the types; those without ranges accept all.
        label: start of the message, from a value's name.

    Raises:
        UserError: as for ``check_range``.
    """
    for name, ranges in _ranges(owner).items():
        value = values.get(name)
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(item, (int, float)) and not isinstance(item, bool):
                for limits in ranges:
                    check_range(label(name), item, limits)


@functools.cache
def _ranges(owner: Callable) -> dict[str, list[Meta]]:
    """Ranges declared by a dataclass's fields or a function's arguments, by name."""
    hints = typing.get_type_hints(owner, include_extras=True)
    return {name: limits for name, hint in hints.items() if (limits := _limits(hint))}


def _limits(hint: Any) -> list[Meta]:
    """All ranges in a type: its own and its parts'."""
    ranges = [part for part in getattr(hint, "__metadata__", ()) if isinstance(part, Meta)]
    return ranges + [limits for part in typing.get_args(hint) for limits in _limits(part)]


def option(name: str) -> str:
    """Convert a name of a field or argument: ``warmup_steps`` to ``--warmup-steps``."""
    return "--" + name.replace("_", "-")


def check_options(group: Any) -> None:
    """Check the fields of a dataclass of options against their ranges.

    Raises:
        UserError: as for ``check_range``; the message names the option.
    """
    check_values(vars(group), type(group), option)


def ranged(command: Function) -> Function:
    """Decorate a command to check its arguments against their ranges before it starts.

    Dataclass arguments are checked by the ranges of their fields. The attribute ``check`` is the
    check alone.
    """

    def check(*args: Any, **kwargs: Any) -> None:
        values = inspect.signature(command).bind(*args, **kwargs).arguments
        check_values(values, command, option)
        for value in values.values():
            if is_dataclass(value) and not isinstance(value, type):
                check_options(value)

    @functools.wraps(command)
    def checked(*args: Any, **kwargs: Any) -> Any:
        check(*args, **kwargs)
        return command(*args, **kwargs)

    vars(checked)["check"] = check
    return typing.cast(Function, checked)


def shard_numbers(text: str) -> tuple[int, int]:
    """Return i and n of ``--shard i/n``, which takes every n-th object from the i-th.

    Raises:
        UserError: the text is not of the form i/n with 0 <= i < n.
    """
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    if not match or not int(match[1]) < int(match[2]):
        raise UserError(f"--shard {text[:40]}: expected i/n with 0 <= i < n, such as 0/4")
    return int(match[1]), int(match[2])
