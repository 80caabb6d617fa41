"""Assertions of a one-line ``UserError``."""

import pytest

from gamba_warp.cli import run
from gamba_warp.errors import UserError


def refused(match, function, *arguments, **options):
    """Call a function, which must raise a one-line UserError that matches; return the line."""
    with pytest.raises(UserError, match=match) as caught:
        function(*arguments, **options)
    message = str(caught.value)
    assert len(message.splitlines()) == 1, message
    return message


def refused_at(source, reason, function, *arguments):
    """Call a function, which must raise a line of under 400 letters with source and reason."""
    message = refused(None, function, *arguments)
    assert message.startswith(f"{source}: ") and reason in message and len(message) < 400, message


def refused_command(capsys, command, words, *reasons):
    """Run a command, which must end with code 2 and one line with the reasons."""
    capsys.readouterr()
    assert run(command, [*map(str, words)]) == 2
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if not line.startswith("Warp")]
    assert len(lines) == 1 and lines[0].startswith("gamba: "), said
    assert all(str(reason) in lines[0] for reason in reasons), said
