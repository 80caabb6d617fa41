"""The first call of an operator, without torch's compiler."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any, TypeVar

_DISABLED = "__dynamo_disable"  # where torch keeps a function that its compiler passes over
Operator = TypeVar("Operator")


def without_compiler(operator: Operator) -> Operator:
    """Lets an operator run without torch's compiler while nobody has loaded that.

    The body of a ``torch.library.custom_op`` is hidden from ``torch._dynamo``, and for that the
    first call imports it: 1.1 of the 3.9 s of processor time that ``gamba reconstruct`` then takes.
    Until something else imports it, the body is called as it is; from then on everything is as
    torch made it. Where a release of torch keeps these things elsewhere, nothing changes.

    Args:
        operator: what ``torch.library.custom_op`` returns.

    Returns:
        The same operator.
    """
    for hidden in getattr(operator, "_backend_fns", {}).values():
        body = getattr(hidden, "__wrapped__", None)
        if body is not None and not hasattr(body, _DISABLED):
            setattr(body, _DISABLED, partial(_call, body, hidden))
    return operator


def _call(body: Any, hidden: Any, *args: Any, **kwargs: Any) -> Any:
    if "torch._dynamo" not in sys.modules:
        return body(*args, **kwargs)
    vars(body).pop(_DISABLED, None)  # torch puts its own there, once
    return hidden(*args, **kwargs)
