"""Shared by the tests: comparisons that name what differs."""

import struct

import torch


def rel_rms(got: torch.Tensor, want: torch.Tensor) -> float:
    """Root mean square of the difference over that of ``want``, in float64."""
    got, want = got.detach().double(), want.detach().double()
    scale = want.square().mean().sqrt().item()
    return (got - want).square().mean().sqrt().item() / max(scale, 1e-300)


def assert_rel_rms(got, want, limit: float, name: str) -> None:
    """Fails with the name and both figures where the relative rms error is over ``limit``."""
    assert got.shape == want.shape, f"{name}: shape {tuple(got.shape)}, want {tuple(want.shape)}"
    assert torch.isfinite(got).all(), f"{name}: not finite"
    error = rel_rms(got, want)
    assert error <= limit, f"{name}: relative rms error {error:.3g} > {limit:.3g}"


def resources(cubin: bytes) -> tuple[int, int]:
    """Registers and bytes of stack per thread: the largest in the ``.nv.info`` attributes."""
    offset, size, count = (
        *struct.unpack_from("<Q", cubin, 40),
        *struct.unpack_from("<HH", cubin, 58),
    )
    registers = stack = 0
    for i in range(count):
        kind, start, length = (
            struct.unpack_from("<I", cubin, offset + i * size + 4)[0],
            *struct.unpack_from("<QQ", cubin, offset + i * size + 24),
        )
        if kind != 0x70000000:  # SHT_CUDA_INFO
            continue
        at = start
        while at < start + length:
            form, attribute, payload = struct.unpack_from("<BBH", cubin, at)
            if form == 4 and attribute == 0x2F:  # EIATTR_REGCOUNT: symbol, registers
                registers = max(registers, struct.unpack_from("<II", cubin, at + 4)[1])
            if form == 4 and attribute == 0x11:  # EIATTR_FRAME_SIZE: symbol, bytes
                stack = max(stack, struct.unpack_from("<II", cubin, at + 4)[1])
            at += 4 + (payload if form == 4 else 0)
    return registers, stack


def shared_bytes(cubin: bytes) -> int:
    """Static shared memory of a kernel, in bytes: the largest ``.nv.shared`` section."""
    offset, size, count, names = (
        *struct.unpack_from("<Q", cubin, 40),
        *struct.unpack_from("<HHH", cubin, 58),
    )
    strings = struct.unpack_from("<Q", cubin, offset + names * size + 24)[0]
    most = 0
    for i in range(count):
        name = strings + struct.unpack_from("<I", cubin, offset + i * size)[0]
        if cubin.startswith(b".nv.shared.", name):
            most = max(most, struct.unpack_from("<Q", cubin, offset + i * size + 32)[0])
    return most
