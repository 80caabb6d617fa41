"""Helpers of several test files; in this module, threads and comparisons."""

import contextlib

import torch


@contextlib.contextmanager
def on_threads(count):
    """Run the body with ``count`` threads of torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def assert_same_on_threads(function, *counts) -> None:
    """Fail unless the tensors of ``function`` have the same bits for all numbers of threads."""
    first = None
    for count in counts:
        with on_threads(count):
            made = list(function())
        first = first or made
        assert all(map(torch.equal, made, first)), f"{count} threads"


def rel_rms(got: torch.Tensor, want: torch.Tensor) -> float:
    """Return the root mean square of the difference over that of ``want``, in float64."""
    got, want = got.detach().double(), want.detach().double()
    scale = want.square().mean().sqrt().item()
    return (got - want).square().mean().sqrt().item() / max(scale, 1e-300)


def assert_rel_rms(got, want, limit: float, name: str) -> None:
    """Fail with the name and both figures if the relative rms error is over ``limit``."""
    assert got.shape == want.shape, f"{name}: shape {tuple(got.shape)}, want {tuple(want.shape)}"
    assert torch.isfinite(got).all(), f"{name}: not finite"
    error = rel_rms(got, want)
    assert error <= limit, f"{name}: relative rms error {error:.3g} > {limit:.3g}"


def assert_all_rel_rms(got, want, limit: float, **limits: float) -> None:
    """Compare all results by name; ``limits`` are those of some names."""
    for name, value in want.items():
        assert_rel_rms(got[name], value, limits.get(name, limit), name)


def in_default_float64(function):
    """Return the result of a function with torch's default dtype float64."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        return function()
    finally:
        torch.set_default_dtype(before)


def assert_default_dtype_changes_nothing(function):
    """Assert that a function returns the same bits and dtypes with any default dtype."""
    for want, got in zip(function(), in_default_float64(function), strict=True):
        assert got.dtype == want.dtype
        torch.testing.assert_close(got, want, rtol=0, atol=0, equal_nan=True)
