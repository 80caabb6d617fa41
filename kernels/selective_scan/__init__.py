"""Mamba's selective scan, on CUDA and on the CPU."""

from .api import selective_scan, selective_scan_fn, selective_scan_state

__all__ = ["selective_scan", "selective_scan_fn", "selective_scan_state"]
