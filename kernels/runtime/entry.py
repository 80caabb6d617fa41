"""A kernel's compiled function, and the C structures that it takes, found by a recorded launch.

``wp.launch`` checks and packs its arguments anew each time, which takes as long as a short kernel
runs. A launch that is recorded once says what it has made of them; later launches of the kernel
have the same kinds of arguments and fill the same structures.
"""

import copy
import ctypes
import threading
from typing import Any

import warp as wp

_MOST_EXTENTS = 1024  # that a kernel keeps


class Entry:
    """Compiled function and argument structures of a kernel's launches.

    They are attributes of Warp's that are not documented.

    Args:
        kernel: the kernel.
        command: of ``wp.launch(..., record_cmd=True)``.
        dim: of that launch.
        arguments: likewise.

    Raises:
        AttributeError: this Warp has no such attributes; also TypeError, where they are others.
    """

    def __init__(self, kernel: wp.Kernel, command: Any, dim: tuple[int, ...], arguments: list):
        self.rank = kernel.adj.kernel_dim
        self._command, self._own = command, threading.local()
        self.call = command.hooks.forward
        self.executable = command.module_exec  # keeps the function loaded
        self.bounds: Any = type(command.bounds)
        self.names = [arg.label for arg in kernel.adj.args]
        fields = [(name, type(x)) for name, x in zip(self.names, command.params[1:])]
        self.record: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.offsets = [getattr(self.record, name).offset for name in self.names]
        self.addresses: Any = ctypes.c_void_p * (1 + len(fields))
        self._empty = [kind() for _, kind in fields]
        self._structs = [i for i, x in enumerate(arguments) if hasattr(x, "__ctype__")]
        self._extents: dict[tuple[int, ...], Any] = {}
        self.extent(dim)  # so that an error comes now and not in a later launch
        self.pack(arguments)

    def command(self) -> Any:
        """The recorded command, a copy for each thread, to be changed before it is launched."""
        own = getattr(self._own, "command", None)
        if own is None:
            own = self._own.command = copy.copy(self._command)
        return own

    def pack(self, arguments: list) -> ctypes.Structure:
        """The arguments as the compiled function takes them; an array that is None is empty."""
        values = [y if x is None else x for x, y in zip(arguments, self._empty)]
        for i in self._structs:
            values[i] = values[i].__ctype__()
        return self.record(*values)

    def extent(self, dim: tuple[int, ...]) -> ctypes.Structure:
        """The dimensions as the compiled function takes them; not to be changed."""
        known = self._extents.get(dim)  # looked up once: another thread may clear them
        if known is None:
            if len(self._extents) >= _MOST_EXTENTS:
                self._extents.clear()
            known = self.bounds((*dim, *(1,) * (self.rank - len(dim))))
            self._extents[dim] = known
        return known
