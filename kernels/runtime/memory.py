"""Large tensors on the CPU."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence

import torch
from torch import Tensor

_HUGE = 4 << 20  # bytes from which huge pages are worth it


_libc = ctypes.CDLL(None) if sys.platform == "linux" else None


def empty(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Makes a tensor as ``torch.empty`` does on the CPU; a large one asks for huge pages.

    The first touch of a page costs more than filling it, and with rows of 4 KiB each row would be a
    page of its own.
    """
    tensor = torch.empty(*shape, dtype=dtype)
    size = tensor.numel() * tensor.element_size()
    if _libc is not None and size >= _HUGE:
        begin = -(-tensor.data_ptr() // 4096) * 4096
        end = (tensor.data_ptr() + size) // 4096 * 4096
        # 14 is MADV_HUGEPAGE; a kernel without huge pages refuses, which does no harm
        _libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), 14)
    return tensor
