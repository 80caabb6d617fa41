"""What is refused: a ``UserError`` of one line."""

import pytest

from gamba_warp.errors import UserError


def refused(match, function, *arguments, **options):
    """Calls a function, which must refuse it by a line that matches; returns the line."""
    with pytest.raises(UserError, match=match) as caught:
        function(*arguments, **options)
    message = str(caught.value)
    assert len(message.splitlines()) == 1, message
    return message
