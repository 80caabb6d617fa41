"""``gamba doctor``: what this machine has and can run; what is missing, and how to get it."""

from __future__ import annotations

from collections.abc import Iterable

from ..versions import used_versions


def doctor_command(warm_up: bool = False) -> int:
    """Says what this machine has and can run, and what is missing.

    Args:
        warm_up: Also compile the kernels for this machine's devices, and print the time.
    """
    from ..measure import health

    _print("Versions", used_versions().items())
    _print("Devices", health.devices())
    _print("Folders", health.folders())
    abilities = list(health.abilities())
    _print("Can run", ((name, value) for name, value, _ in abilities))
    if warm_up:
        print("Kernels")
        for device, first, again in health.warm_up_kernels():
            print(f"  {device:<18} {first:.1f} s to compile or load, then {1000 * again:.0f} ms")
    else:
        print("Kernels compile on first use; 'gamba doctor --warm-up' does it now")
    return 1 if any(fault for _, _, fault in abilities) else 0


def _print(title: str, lines: Iterable[tuple[str, str]]) -> None:
    print(title)
    for name, value in lines:
        print(f"  {name:<18} {value}")
