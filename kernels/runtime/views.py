"""Checked views of tensors as Warp arrays, without copies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast, get_type_hints, overload

import warp as wp
from torch import Tensor

from . import gpu

_Class = TypeVar("_Class")
_INT32_MAX = 2**31 - 1  # Warp keeps shapes and byte strides as int32


def view(tensor: Tensor, dtype=None, name: str = "tensor"):
    """A Warp array descriptor on the memory and strides of a tensor, which it keeps alive.

    Args:
        tensor: float32, float64, bfloat16, float16 or integer, at most 4 dimensions.
        dtype: a Warp dtype; a vector or matrix type takes up trailing, contiguous dimensions.
        name: the argument's name in errors.

    Raises:
        TypeError: the dtype has no Warp counterpart or is not the one asked for.
        ValueError: too many dimensions, a broken vector dimension, or over 2^31 bytes per stride.
        OSError: Warp's folder of compiled kernels cannot be made.
    """
    key = (tensor.dtype, tensor.shape, tensor.stride(), dtype)
    known = _descriptors.get(key)  # looked up once: another thread may clear them at any time
    if known is None:
        known = _describe(tensor.detach(), dtype, name)
        if len(_descriptors) >= _MOST_DESCRIPTORS:
            _descriptors.clear()
        _descriptors[key] = known
    descriptor = type(known).from_buffer_copy(known)  # a tenth of the time of making it
    descriptor.data = tensor.data_ptr()
    descriptor.owner = tensor
    return descriptor


_MOST_DESCRIPTORS = 4096
_descriptors: dict[tuple, Any] = {}  # one for each dtype, shape and strides


def cache_error(error: OSError) -> OSError:
    """The error of Warp's folder of compiled kernels, which also says how to choose another."""
    advice = "WARP_CACHE_PATH names another folder for compiled kernels"
    return OSError(error.errno, f"{error.strerror}; {advice}", error.filename)


def _start() -> None:
    try:
        wp.init()
    except OSError as error:
        raise cache_error(error) from error


def _describe(tensor: Tensor, dtype, name: str) -> Any:
    _start()
    reach = max((s * tensor.element_size() for s in tensor.stride()), default=0)
    if max(reach, *tensor.shape, 0) > _INT32_MAX:
        raise ValueError(
            f"{name} has shape {tuple(tensor.shape)} and strides {tensor.stride()}; "
            "each length, and each stride in bytes, must be below 2^31"
        )
    if dtype is not None:
        scalar = wp.dtype_to_torch(getattr(dtype, "_wp_scalar_type_", dtype))
        if tensor.dtype != scalar:
            raise TypeError(f"{name} must have dtype {scalar}, got {tensor.dtype}")
    try:
        descriptor: Any = wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)
    except RuntimeError as error:
        raise ValueError(f"{name}: {error}") from error
    return type(descriptor).from_buffer_copy(
        descriptor
    )  # a copy that does not keep the tensor alive


class StructValue:
    """A Warp struct of tensors and numbers, as a launch takes it.

    An instance of the struct itself would take 10 µs for each array that it is given; this takes
    what ``view`` does, so that kernels may have structs of arrays. Its parts stay in ``values``.

    Args:
        cls: from ``struct``.
        *values: of its fields, in their order: numbers, contiguous tensors (each is viewed with the
            leading dimensions that the field's array does not have as one), or None: no array.
    """

    def __init__(self, cls: Any, *values: Any) -> None:
        self.values = values
        of = [(x.dtype, x.shape, x.stride()) if isinstance(x, Tensor) else x for x in values]
        key = (cls, *of)
        known = _structs.get(key)
        if known is None:
            if len(_structs) >= _MOST_DESCRIPTORS:
                _structs.clear()
            known = _structs[key] = _filled_with(cls, values)
        # A struct of the same shapes and numbers is copied, and only its addresses are others.
        self._made = type(known).from_buffer_copy(known)
        for name, x in zip(cls.vars, values):
            if isinstance(x, Tensor):
                getattr(self._made, name).data = x.data_ptr()

    def __ctype__(self) -> Any:
        return self._made


_structs: dict[tuple, Any] = {}  # one for each struct, and its arrays' dtypes, shapes and strides


def _filled_with(cls: Any, values: tuple) -> Any:
    """Return the C structure of a struct with these values."""
    structure = cls.ctype()
    for x, (name, var) in zip(values, cls.vars.items(), strict=True):
        if isinstance(x, Tensor):
            dtype = var.type.dtype
            inner = var.type.ndim - 1 + len(getattr(dtype, "_shape_", ()))
            if x.dim() != inner + 1:
                x = x.view(-1, *x.shape[x.dim() - inner :]) if inner else x.view(-1)
            x = view(x, dtype)
        if x is not None:
            setattr(structure, name, x)
    return structure


@functools.lru_cache(1024)
def filled(cls: type[_Class], *values: float) -> _Class:
    """An instance of a struct of numbers, in the order of its fields; shared: do not modify it.

    It is kept, because to fill one takes as long as a short launch.
    """
    instance = cls()
    for name, value in zip(cast(Any, cls).vars, values, strict=True):
        setattr(instance, name, value)
    return instance


def struct(cls: type[_Class]) -> type[_Class]:
    """``wp.struct``; a type checker sees the class unchanged."""
    return cast(type[_Class], wp.struct(cls))


@functools.cache
def struct_of(record: type) -> Any:
    """The Warp struct of a record: a NamedTuple of tensors, each ``Annotated`` with its array."""
    hints = get_type_hints(record, include_extras=True)
    fields = {name: hint.__metadata__[0] for name, hint in hints.items()}
    names = {"__module__": record.__module__, "__doc__": record.__doc__}
    return wp.struct(type(record.__name__, (), {"__annotations__": fields, **names}))


def as_struct(record: Any) -> StructValue:
    """A record of tensors, or None, as a launch takes it; kernels call its type ``struct_of``."""
    return StructValue(struct_of(type(record)), *record)


def lane_contiguous(tensor: Tensor) -> Tensor:
    """The tensor itself if its last dimension is dense (rows may be strided), else a dense copy."""
    return tensor if tensor.stride(-1) == 1 or tensor.shape[-1] == 1 else tensor.contiguous()


def is_transposed(x: Tensor) -> bool:
    """True if a CPU's kernels read ``[B, L, D]`` along its tokens: these are dense, channels not.

    It is a view of mamba-ssm's ``[B, D, L]``. CUDA's kernels have none.
    """
    _, tokens, channels = x.stride()
    return tokens == 1 and channels != 1 and x.shape[2] != 1 and gpu.kind_of(x.device) == "cpu"


def dense(x: Tensor) -> Tensor:
    """The tensor itself if it is transposed or its channels are dense, else a dense copy."""
    return x if is_transposed(x) else lane_contiguous(x)


def laid_as(x: Tensor, make: Callable[[tuple[int, ...]], Tensor]) -> Tensor:
    """Result of the shape ``[B, L, D]`` of x, transposed if x is; ``make`` gives dense memory."""
    if not is_transposed(x):
        return make(tuple(x.shape))
    batch, length, channels = x.shape
    return make((batch, channels, length)).transpose(1, 2)


@overload
def tokens_first(x: Tensor, name: str) -> Tensor: ...
@overload
def tokens_first(x: Tensor | None, name: str) -> Tensor | None: ...
def tokens_first(x: Tensor | None, name: str) -> Tensor | None:
    """A view ``[B, L, D]`` of mamba-ssm's layout ``[B, D, L]``; other values are returned.

    Raises:
        ValueError: the tensor, called ``name``, has not three dimensions.
    """
    if isinstance(x, Tensor) and x.dim() != 3:
        raise ValueError(f"{name} must have shape [B, D, L], got {tuple(x.shape)}")
    return x.transpose(1, 2) if isinstance(x, Tensor) else x
