"""Refusal of forward-mode derivatives, which torch would take for zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor
from torch.autograd import forward_ad


def has_tangent(*values: Any) -> bool:
    """Return whether a value carries a tangent, of ``torch.func.jvp`` or of a dual number.

    Values that are no tensors, and tensors within lists, are passed over.
    """
    if forward_ad._current_level < 0:  # outside of forward mode, where nothing has one
        return False
    return any(
        forward_ad.unpack_dual(x).tangent is not None for x in values if isinstance(x, Tensor)
    )


def reverse_only(name: str, operator: Callable) -> Any:
    """Return the operator behind a check that no argument carries a tangent.

    torch calls a ``custom_op`` with the plain values and returns them without a tangent, so that
    the derivative would be zero without a word.

    Args:
        name: of the public function, for the message.
        operator: a ``torch.library.custom_op`` with all its registrations.

    Returns:
        A function of the same arguments, which raises ``NotImplementedError`` for a tangent.
    """

    def call(*args: Any) -> Any:
        if has_tangent(*args):
            raise NotImplementedError(
                f"{name}: forward-mode derivatives (torch.func.jvp, jacfwd, dual numbers) are not "
                "supported; only backward() is"
            )
        return operator(*args)

    return call
